"""Build step: a machine with its converter as a functional mock-up unit (FMI 3.0, co-simulation).

    python -m salient.generate.fmu describe FILE.toml OUTDIR SOURCE...      modelDescription.xml and fmu_variables.c
    python -m salient.generate.fmu pack OUT.fmu modelDescription.xml LIBRARY PLATFORM LICENSE

Both files of `describe` come from `variables()`, the list of inputs, outputs and parameters of the unit. The
instantiation token that they share is a hash of them, the machine and the C sources, so that a library and a
description that do not belong together are recognised. The unit is a function of the inputs, to the last byte.
"""

from __future__ import annotations

import hashlib
import math
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from salient.dbc import PHASES
from salient.generate.files import write_files
from salient.machine.file import Machine, MachineError, load_machine
from salient.machine.scaling import scaling_of
from salient.machine.sources import plant_source

# Base units and display units (name, factor: display value = factor * value) of each unit.
UNITS: dict[str, tuple[dict[str, int], dict[str, float]]] = {
    "s": ({"s": 1}, {}),
    "A": ({"A": 1}, {}),
    "V": ({"kg": 1, "m": 2, "s": -3, "A": -1}, {}),
    "Ohm": ({"kg": 1, "m": 2, "s": -3, "A": -2}, {}),
    "J": ({"kg": 1, "m": 2, "s": -2}, {}),
    "N.m": ({"kg": 1, "m": 2, "s": -2}, {}),
    "N.m.s/rad": ({"kg": 1, "m": 2, "s": -1, "rad": -1}, {}),
    "kg.m2": ({"kg": 1, "m": 2}, {}),
    "rad": ({"rad": 1}, {"deg": 180.0 / math.pi}),
    "rad/s": ({"rad": 1, "s": -1}, {"r/min": 30.0 / math.pi}),
}
CO_SIMULATION = {
    "canHandleVariableCommunicationStepSize": "true",
    "canGetAndSetFMUState": "true",
    "canBeInstantiatedOnlyOncePerProcess": "false",
    "maxOutputDerivativeOrder": "0",
    "hasEventMode": "false",
}
LOG_CATEGORY = "logStatusError"
DESCRIPTION = (
    "Switched reluctance machine '{name}', {stator}/{rotor} poles, with asymmetric half bridges and shaft. Inputs are"
    " held over a communication step, so a switch edge lies where a step ends; communication points are rounded to"
    " whole nanoseconds. Outputs do not depend directly on inputs."
)


@dataclass(frozen=True)
class Variable:
    """A variable of the unit; its value reference is its index in the list."""

    name: str
    member: str
    """Member of fmu_values_t in emulator/fmi/fmu_model.h."""
    causality: str
    description: str
    unit: str | None = None
    """None: a Boolean."""
    start: float | bool | None = None
    minimum: float = -math.inf
    maximum: float = math.inf


def variables(machine: Machine) -> list[Variable]:
    """Inputs, outputs and parameters of a unit of this machine. Limits are the plant's, wider than a machine
    file's: the firmware's number formats do not matter here."""
    phases = [(phase, PHASES[phase]) for phase in range(machine.phases)]
    return [
        Variable("time", "time_s", "independent", "time", "s"),
        *(
            Variable(f"{side}_{letter}", f"{side}[{phase}]", "input", f"{side} switch of phase {letter} is on",
                     start=False)
            for phase, letter in phases
            for side in ("upper", "lower")
        ),
        Variable("load_torque_Nm", "load_torque_Nm", "input", "load, positive against the forward direction", "N.m",
                 0.0),
        Variable("supply_voltage_V", "supply_voltage_V", "input", "of the source that feeds the link", "V",
                 machine.supply_voltage_V, 0.0),
        Variable("initial_angle_rad", "initial_angle_rad", "parameter", "rotor angle at the start", "rad", 0.0),
        Variable("initial_speed_rad_s", "initial_speed_rad_s", "parameter", "speed at the start", "rad/s", 0.0),
        Variable("resistance_ohm", "resistance_ohm", "parameter", "of one phase winding", "Ohm",
                 machine.resistance_ohm, 1e-4, 100.0),
        Variable("inertia_kg_m2", "inertia_kg_m2", "parameter", "of everything on the shaft", "kg.m2",
                 machine.inertia_kg_m2, 1e-4),
        Variable("friction_Nm_s", "friction_Nm_s", "parameter", "viscous friction", "N.m.s/rad",
                 machine.friction_Nm_s, 0.0),
        *(
            Variable(f"current_{letter}_A", f"current_A[{phase}]", "output",
                     f"current of phase {letter}, never negative", "A")
            for phase, letter in phases
        ),
        Variable("torque_Nm", "torque_Nm", "output", "electromagnetic torque of all phases", "N.m"),
        Variable("speed_rad_s", "speed_rad_s", "output", "speed of the shaft", "rad/s"),
        Variable("rotor_angle_rad", "rotor_angle_rad", "output", "not wrapped; phase a is aligned at 0", "rad"),
        Variable("bus_voltage_V", "bus_voltage_V", "output",
                 "of the link: the supply's, unless the machine file has a capacitor", "V"),
        Variable("bus_current_A", "bus_current_A", "output",
                 "drawn from the link, at the end of the last step with the switches of that step", "A"),
        Variable("energy_drawn_J", "energy_drawn_J", "output", "drawn from the link since the start", "J"),
        Variable("energy_returned_J", "energy_returned_J", "output", "returned to the link since the start", "J"),
        Variable("energy_copper_J", "energy_copper_J", "output", "lost in the windings since the start", "J"),
        Variable("energy_converter_J", "energy_converter_J", "output",
                 "lost in the half bridges' devices since the start", "J"),
    ]


def description(machine: Machine, token: str) -> bytes:
    """modelDescription.xml."""
    table = variables(machine)
    text = DESCRIPTION.format(name=machine.name, stator=machine.stator_poles, rotor=machine.rotor_poles)
    root = ElementTree.Element(
        "fmiModelDescription", fmiVersion="3.0", modelName=machine.name, instantiationToken=token, description=text,
        license="MIT", generationTool="Salient", variableNamingConvention="structured",
    )
    ElementTree.SubElement(root, "CoSimulation", {"modelIdentifier": f"salient_{machine.name}", **CO_SIMULATION})
    units = ElementTree.SubElement(root, "UnitDefinitions")
    for name, (base, displays) in UNITS.items():
        unit = ElementTree.SubElement(units, "Unit", name=name)
        ElementTree.SubElement(unit, "BaseUnit", {key: str(exponent) for key, exponent in base.items()})
        for display, factor in displays.items():
            ElementTree.SubElement(unit, "DisplayUnit", name=display, factor=repr(factor))
    categories = ElementTree.SubElement(root, "LogCategories")
    ElementTree.SubElement(categories, "Category", name=LOG_CATEGORY, description="what was refused, and why")
    ElementTree.SubElement(root, "DefaultExperiment", startTime="0.0", stopTime="0.1", stepSize="5e-06")
    model_variables = ElementTree.SubElement(root, "ModelVariables")
    for reference, variable in enumerate(table):
        _describe(model_variables, reference, variable)
    structure = ElementTree.SubElement(root, "ModelStructure")
    outputs = [reference for reference, variable in enumerate(table) if variable.causality == "output"]
    for reference in outputs:
        ElementTree.SubElement(structure, "Output", valueReference=str(reference), dependencies="")
    for reference in outputs:
        ElementTree.SubElement(structure, "InitialUnknown", valueReference=str(reference))
    ElementTree.indent(root)
    encoded: bytes = ElementTree.tostring(root, encoding="UTF-8", xml_declaration=True)
    return encoded + b"\n"


def _describe(parent: ElementTree.Element, reference: int, variable: Variable) -> None:
    attributes = {
        "name": variable.name,
        "valueReference": str(reference),
        "description": variable.description,
        "causality": variable.causality,
    }
    if variable.causality == "parameter":
        attributes["variability"] = "fixed"
    elif variable.unit is not None:
        attributes["variability"] = "continuous"
    if variable.unit is None:
        attributes["start"] = str(variable.start).lower()
        ElementTree.SubElement(parent, "Boolean", attributes)
        return
    attributes["unit"] = variable.unit
    displays = UNITS[variable.unit][1]
    if displays:
        attributes["displayUnit"] = next(iter(displays))
    if math.isfinite(variable.minimum):
        attributes["min"] = repr(variable.minimum)
    if math.isfinite(variable.maximum):
        attributes["max"] = repr(variable.maximum)
    if variable.start is not None:
        attributes["start"] = repr(variable.start)
    ElementTree.SubElement(parent, "Float64", attributes)


def variables_source(machine: Machine, token: str) -> str:
    """fmu_variables.c: the same list for emulator/fmi."""
    rows = []
    for variable in variables(machine):
        kind = "BOOLEAN" if variable.unit is None else "FLOAT64"
        rows.append(
            f'    {{"{variable.name}", FMU_{kind}, FMU_{variable.causality.upper()},'
            f" offsetof(fmu_values_t, {variable.member}), {float(variable.start or 0.0)!r},"
            f" {_number(variable.minimum)}, {_number(variable.maximum)}}},"
        )
    return "\n".join(
        [
            f"/* Generated from the machine file of '{machine.name}'. */",
            "#include <math.h>",
            "",
            '#include "fmi/fmu_model.h"',
            "",
            f'const char fmu_instantiation_token[] = "{token}";',
            "",
            "const fmu_variable_t fmu_variables[] = {",
            *rows,
            "};",
            "",
            "const size_t fmu_variable_count = sizeof fmu_variables / sizeof *fmu_variables;",
            "",
        ]
    )


def _number(value: float) -> str:
    return repr(value) if math.isfinite(value) else "INFINITY" if value > 0.0 else "-INFINITY"


def instantiation_token(machine: Machine, sources: list[Path]) -> str:
    """Hash of the contents of the unit; `sources` in any order, their folders do not matter."""
    plant = plant_source(machine, scaling_of(machine.name, machine))
    digest = hashlib.sha256(description(machine, "") + plant.encode())
    for source in sorted(sources, key=lambda path: path.name):
        digest.update(source.name.encode() + b"\0" + source.read_bytes())
    return digest.hexdigest()


def pack(unit: Path, description_file: Path, library: Path, platform: str, licence: Path) -> None:
    """Writes the unit: a ZIP archive without times or owners of the files. The library gets the name that the
    description gives it."""
    co_simulation = ElementTree.parse(description_file).find("CoSimulation")
    assert co_simulation is not None  # as description() writes it
    identifier = co_simulation.get("modelIdentifier")
    members = {
        "modelDescription.xml": description_file,
        f"binaries/{platform}/{identifier}{library.suffix}": library,
        "documentation/licenses/license.txt": licence,
    }
    unit.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(unit, "w") as archive:
        for name, file in members.items():
            entry = zipfile.ZipInfo(name, date_time=(1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, file.read_bytes())


def described(file: str, sources: list[Path]) -> dict[str, str]:
    """Contents of modelDescription.xml and fmu_variables.c of a machine file; MachineError."""
    machine = load_machine(file)
    token = instantiation_token(machine, sources)
    return {
        "modelDescription.xml": description(machine, token).decode("utf-8"),
        "fmu_variables.c": variables_source(machine, token),
    }


def main(arguments: list[str]) -> int:
    if len(arguments) >= 3 and arguments[0] == "describe":
        sources = [Path(source) for source in arguments[3:]]
        return write_files("salient", Path(arguments[2]), lambda: described(arguments[1], sources), MachineError)
    if len(arguments) == 6 and arguments[0] == "pack":
        unit, description_file, library, platform, licence = arguments[1:]
        pack(Path(unit), Path(description_file), Path(library), platform, Path(licence))
        return 0
    print("usage: python -m salient.generate.fmu describe FILE.toml OUTDIR SOURCE...\n"
          "       python -m salient.generate.fmu pack OUT.fmu modelDescription.xml LIBRARY PLATFORM LICENSE",
          file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
