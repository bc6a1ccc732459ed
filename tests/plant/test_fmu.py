"""The functional mock-up units: valid, bit-identical to the plant, strict about invalid calls."""

from __future__ import annotations

import ctypes
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from fmpy import extract, read_model_description, simulate_fmu
from fmpy.fmi1 import FMICallException
from fmpy.fmi3 import FMU3Slave
from fmpy.model_description import ModelDescription
from fmpy.validation import validate_fmu
from reference_plant import Compare, State, load_library, machine_from

from salient.machine.file import load_machine, machine_path
from salient.paths import BUILD, MACHINES, ROOT

OUTPUTS = (
    "current_a_A",
    "current_b_A",
    "current_c_A",
    "torque_Nm",
    "speed_rad_s",
    "rotor_angle_rad",
    "energy_drawn_J",
    "energy_returned_J",
    "energy_copper_J",
    "energy_converter_J",
    "bus_voltage_V",
)
SPEED_RAD_S = 100.0
ANGLE_RAD = 0.9
START = {"initial_angle_rad": ANGLE_RAD, "initial_speed_rad_s": SPEED_RAD_S}


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    return load_library()


def unit_path(name: str) -> Path:
    return BUILD / "host" / "fmu" / f"{name}.fmu"


# --- Runs ---


def chopping(steps: int, step_s: float) -> np.ndarray:
    """Each of three phases conducts for a third of 90 degrees, its lower switch on, its upper one chopping; load and
    supply voltage move in ramps."""
    names = [f"{side}_{letter}" for letter in "abc" for side in ("upper", "lower")]
    dtype = [("time", np.float64), *((name, np.bool_) for name in names)]
    signals = np.zeros(steps + 1, [*dtype, ("load_torque_Nm", np.float64), ("supply_voltage_V", np.float64)])
    count = np.arange(steps + 1)
    signals["time"] = count * step_s
    pitches = (ANGLE_RAD + SPEED_RAD_S * signals["time"]) / (np.pi / 2.0)
    for phase, letter in enumerate("abc"):
        conducts = (pitches - phase / 3.0) % 1.0 > 0.5
        conducts &= (pitches - phase / 3.0) % 1.0 < 0.5 + 1.0 / 3.0
        signals[f"lower_{letter}"] = conducts
        signals[f"upper_{letter}"] = conducts & ((count + phase) % 7 < 4)
    signals["load_torque_Nm"] = 10.0 + 400.0 * signals["time"]
    signals["supply_voltage_V"] = 240.0 - 1000.0 * signals["time"]
    return signals


def native(library: ctypes.CDLL, form: str, signals: np.ndarray, step_ns: int, inertia_kg_m2: float | None = None
           ) -> np.ndarray:
    """The same steps through libsalient_plant.so; one row of OUTPUTS per communication point."""
    machine = machine_from(load_machine(machine_path(form)))
    if inertia_kg_m2 is not None:
        machine.inertia_kg_m2 = inertia_kg_m2
    plant = library.plant_library_create(ctypes.byref(machine), ANGLE_RAD)
    library.plant_library_set_motion(plant, SPEED_RAD_S, ANGLE_RAD)
    rows = []
    state = State()
    for index, inputs in enumerate(signals):
        library.plant_library_read(plant, ctypes.byref(state))
        rows.append((*state.current_A[:3], state.torque_Nm, state.speed_rad_s, state.rotor_angle_rad,
                     state.energy_drawn_J, state.energy_returned_J, state.energy_copper_J, state.energy_converter_J,
                     state.bus_voltage_V))
        compare = Compare()
        for phase, letter in enumerate("abc"):
            compare.upper[phase] = int(inputs[f"upper_{letter}"])
            compare.lower[phase] = int(inputs[f"lower_{letter}"])
        library.plant_library_set_inputs(plant, inputs["load_torque_Nm"], inputs["supply_voltage_V"])
        library.plant_set_switches(plant, ctypes.byref(compare), 1)
        library.plant_advance(plant, (index + 1) * step_ns)
    library.plant_library_destroy(plant)
    return np.array(rows)


class Unit:
    """An instance of a unit, stepped explicitly."""

    def __init__(self, folder: str, description: ModelDescription, name: str) -> None:
        self.messages: list[str] = []
        self.references = {variable.name: variable.valueReference for variable in description.modelVariables}
        self.booleans = [variable.name for variable in description.modelVariables if variable.type == "Boolean"]
        self.fmu = FMU3Slave(
            instanceName=name,
            guid=description.guid,
            unzipDirectory=folder,
            modelIdentifier=description.coSimulation.modelIdentifier,
        )
        self.fmu.instantiate(logMessage=lambda _, __, ___, message: self.messages.append(message.decode()))

    def set(self, **values: float) -> None:
        for name, value in values.items():
            setter = self.fmu.setBoolean if name in self.booleans else self.fmu.setFloat64
            setter([self.references[name]], [value])

    def get(self, *names: str) -> tuple[float, ...]:
        return tuple(self.fmu.getFloat64([self.references[name] for name in names]))

    def start(self, start_s: float = 0.0, stop_s: float | None = None, **values: float) -> None:
        self.fmu.enterInitializationMode(startTime=start_s, stopTime=stop_s)
        self.set(**values)
        self.fmu.exitInitializationMode()

    def step(self, inputs: np.void, step_s: float) -> None:
        self.set(**{name: inputs[name] for name in inputs.dtype.names if name != "time"})
        self.fmu.doStep(float(inputs["time"]), step_s)

    def rejection(self, action: Callable[[], object]) -> str:
        """Log message of a rejected `action`."""
        self.messages.clear()
        with pytest.raises(FMICallException):
            action()
        assert len(self.messages) == 1
        return self.messages[0]


@pytest.fixture(scope="module")
def units(tmp_path_factory: pytest.TempPathFactory) -> Callable:
    """Creates instances of one unpacked unit."""
    path = unit_path("saturating")
    folder = extract(str(path), str(tmp_path_factory.mktemp("unit")))
    description = read_model_description(str(path))

    @contextmanager
    def make(count: int) -> Iterator[list[Unit]]:
        made = [Unit(folder, description, f"unit {number}") for number in range(count)]
        components = [unit.fmu.component for unit in made]
        yield made
        for unit, component in zip(made, components, strict=True):
            # FMPy's freeInstance would unload the library that other instances still use.
            unit.fmu.fmi3FreeInstance(component)

    return make


# --- Tests ---


@pytest.mark.parametrize("name", sorted(path.stem for path in MACHINES.glob("*.toml")))
def test_unit_is_valid(name):
    assert validate_fmu(str(unit_path(name))) == []


@pytest.mark.in_turns
@pytest.mark.parametrize(("form", "step_ns"), [("saturating", 5000), ("linear_cosine", 25000),
                                               ("linear_trapezoid", 25000), ("finite_element", 25000)])
def test_run_in_fmpy_is_bit_identical_to_the_native_run(library, form, step_ns):
    steps, step_s = 20_000_000 // step_ns, step_ns * 1e-9
    signals = chopping(steps, step_s)
    # FMPy applies inputs at, and interpolates to, the communication points that it has computed.
    signals["time"] = [index * step_s for index in range(steps + 1)]
    seen = simulate_fmu(str(unit_path(form)), stop_time=steps * step_s, output_interval=step_s, input=signals,
                        output=OUTPUTS, start_values=START, validate=False)
    expected = native(library, form, signals, step_ns)
    assert np.ptp(expected[:, 0]) > 5.0 and np.ptp(expected[:, 6]) > 1.0 and np.ptp(expected[:, 7]) > 0.1
    for column, name in enumerate(OUTPUTS):
        assert np.array_equal(seen[name], expected[:, column]), name


def test_simultaneous_instances_are_independent(library, units):
    step_ns, steps = 25000, 400
    signals = chopping(steps, step_ns * 1e-9)
    other = signals.copy()
    other["load_torque_Nm"] += 30.0
    with units(2) as (first, second):
        first.start(**START)
        second.start(**START, inertia_kg_m2=0.001)
        seen = [[], []]
        for inputs, others in zip(signals, other, strict=True):
            seen[0].append(first.get(*OUTPUTS))
            seen[1].append(second.get(*OUTPUTS))
            first.step(inputs, step_ns * 1e-9)
            second.step(others, step_ns * 1e-9)
    assert np.array_equal(seen[0], native(library, "saturating", signals, step_ns))
    assert np.array_equal(seen[1], native(library, "saturating", other, step_ns, inertia_kg_m2=0.001))


def test_restored_state_continues_bit_identically_in_any_instance(units):
    step_s = 5e-6
    signals = chopping(600, step_s)
    with units(2) as (first, second):
        first.start(**START)
        second.start()
        for inputs in signals[:300]:
            first.step(inputs, step_s)
        state = first.fmu.getFMUState()
        ends = []
        for unit in (first, first, second):
            unit.fmu.setFMUState(state)
            for inputs in signals[300:]:
                unit.step(inputs, step_s)
            ends.append(unit.get("time", *OUTPUTS))
        first.fmu.freeFMUState(state)
    assert ends[0] == ends[1] == ends[2]
    assert ends[0][0] == pytest.approx(601 * step_s)


def test_reset_restores_the_initial_state(units):
    signals = chopping(50, 5e-6)
    with units(2) as (used, fresh):
        used.start(**START, resistance_ohm=1.0)
        for inputs in signals:
            used.step(inputs, 5e-6)
        used.fmu.reset()
        ends = []
        for unit in (used, fresh):
            unit.start(start_s=3.0)
            for inputs in signals:
                later = inputs.copy()
                later["time"] += 3.0
                unit.step(later, 5e-6)
            ends.append(unit.get(*OUTPUTS, "bus_current_A"))
    assert ends[0] == ends[1]
    assert ends[0][0] != 0.0 or ends[0][1] != 0.0


def test_bus_current_follows_the_switches_of_the_step(units):
    with units(1) as (unit,):
        unit.start(initial_angle_rad=0.1)
        unit.set(upper_b=True, lower_b=True)
        unit.fmu.doStep(0.0, 200e-6)
        driven = unit.get("current_b_A", "bus_current_A")
        unit.set(upper_b=False)
        unit.fmu.doStep(200e-6, 50e-6)
        freewheeling = unit.get("current_b_A", "bus_current_A")
        unit.set(lower_b=False)
        unit.fmu.doStep(250e-6, 50e-6)
        returning = unit.get("current_b_A", "bus_current_A")
    assert driven[0] > freewheeling[0] > returning[0] > 1.0
    assert (driven[1], freewheeling[1], returning[1]) == (driven[0], 0.0, -returning[0])


def test_before_the_first_step_the_outputs_follow_the_parameters(units):
    with units(1) as (unit,):
        unit.set(initial_angle_rad=0.25)
        assert unit.get("rotor_angle_rad") == (0.25,)
        unit.start(initial_speed_rad_s=-3.0)
        assert unit.get("rotor_angle_rad", "speed_rad_s", "current_a_A") == (0.25, -3.0, 0.0)


def test_rounding_of_communication_points_to_nanoseconds_does_not_accumulate(units):
    step_s = 1.0 / 48000.0
    with units(1) as (unit,):
        unit.start(initial_speed_rad_s=100.0, friction_Nm_s=0.0)
        for index in range(480):
            unit.fmu.doStep(index * step_s, step_s)
        assert unit.get("rotor_angle_rad")[0] == pytest.approx(1.0, abs=1e-7)


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (lambda unit: unit.set(supply_voltage_V=-1.0), "supply_voltage_V: -1 is not a finite number from 0 to inf"),
        (lambda unit: unit.set(load_torque_Nm=float("nan")), "load_torque_Nm: nan is not a finite number"),
        (lambda unit: unit.set(inertia_kg_m2=0.01), "not allowed between steps"),
        (lambda unit: unit.set(torque_Nm=1.0), "torque_Nm is not an input or a parameter"),
        (lambda unit: unit.fmu.getFloat64([999]), "value reference 999: no variable of this type"),
        (lambda unit: unit.fmu.getInt32([0]), "fmi3GetInt32: there are no variables of this type"),
        (lambda unit: unit.fmu.doStep(1e-3, 1e-3), "a step from 0.001 s, but the last one ended at 0 s"),
        (lambda unit: unit.fmu.doStep(0.0, 0.0), "step size 0 s is not above 0"),
        (lambda unit: unit.fmu.doStep(0.0, float("nan")), "step size nan s is not above 0"),
        (lambda unit: unit.fmu.doStep(0.0, 2.0), "a step to 2 s is beyond the stop time"),
        (lambda unit: unit.fmu.enterEventMode(), "fmi3EnterEventMode: there is no event mode"),
        (lambda unit: unit.fmu.exitInitializationMode(), "fmi3ExitInitializationMode: not allowed between steps"),
    ],
)
def test_rejected_calls_are_named_and_change_nothing(units, action, message):
    with units(1) as (unit,):
        unit.start(stop_s=1.0, **START)
        before = unit.get("time", "load_torque_Nm", "supply_voltage_V", *OUTPUTS)
        assert message in unit.rejection(lambda: action(unit))
        assert unit.get("time", "load_torque_Nm", "supply_voltage_V", *OUTPUTS) == before


def test_description_of_another_unit_is_rejected(units):
    with units(1) as (unit,):
        unit.fmu.guid = "0" * 64
        messages: list[bytes] = []
        with pytest.raises(Exception, match="Failed to instantiate"):
            unit.fmu.instantiate(logMessage=lambda _, __, ___, message: messages.append(message))
        assert len(messages) == 1 and b"instantiation token" in messages[0]


@pytest.mark.in_turns
def test_the_build_of_a_unit_is_deterministic(tmp_path):
    """Packing the same inputs again gives the same bytes, independent of file name and time."""
    unit = unit_path("saturating")
    folder = Path(extract(str(unit), str(tmp_path / "unit")))
    (binary,) = folder.glob("binaries/*/*.so")
    library = tmp_path / "another_name.so"
    library.write_bytes(binary.read_bytes())
    again = tmp_path / "again.fmu"
    command = [sys.executable, "-m", "salient.generate.fmu", "pack", again, folder / "modelDescription.xml", library,
               binary.parent.name, ROOT / "LICENSE"]
    subprocess.run(command, check=True)
    assert again.read_bytes() == unit.read_bytes()
