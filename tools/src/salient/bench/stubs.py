"""Writes salient/suite.pyi: the names that CAN databases, parameters and load profiles give a bench, for completion in
editors and for type checkers.

    python -m salient.bench.stubs
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

from salient.bench.faults import LEGS, FaultKind, fault_kinds
from salient.bench.rig import bench_variables, variable_range
from salient.bus.signals import SignalTable, drive_database, rig_database
from salient.dbc import PHASES
from salient.machine.parameter_table import read_table
from salient.paths import LOADS

FILE = Path(__file__).resolve().parents[1] / "suite.pyi"

_HEAD = '''\
# Written by python -m salient.bench.stubs from the CAN databases, firmware/storage/parameters.def and tools/loads.
# ruff: noqa
from collections.abc import Sequence
from typing import Any, Literal, overload

from salient.bench.bench import Bench as _Bench
from salient.bench.drive import Drive as _Drive
from salient.bench.drive import Parameters as _Parameters
from salient.bench.rig import Fault as Fault
from salient.bench.rig import Rig as _Rig
from salient.bus.signals import Signal as Signal
from salient.bus.signals import SignalTable
'''


def text() -> str:
    """The stub file."""
    parts = [
        _HEAD,
        _literal("LoadProfile", sorted(path.stem for path in LOADS.glob("*.csv"))),
        _literal("ParameterName", (row.name for row in read_table())),
        _literal("TelemetryName", SignalTable(drive_database(), "DRIVE")),
        _literal("TruthName", SignalTable(rig_database(), "RIG")),
        _table("Telemetry", "TelemetryName"),
        _table("Truth", "TruthName"),
        "class Parameters(_Parameters):\n"
        "    def __getitem__(self, name: ParameterName | str) -> float: ...\n"
        "    def __setitem__(self, name: ParameterName | str, value: float) -> None: ...\n",
        "class Drive(_Drive):\n"
        "    parameters: Parameters\n"
        "    @property\n"
        "    def telemetry(self) -> Telemetry: ...\n",
        "class Rig(_Rig):\n" + "".join(map(_variable, bench_variables())) + _AT
        + "    def set_load_profile(self, values: LoadProfile | str | Sequence[float]) -> None: ...\n" + _faults(),
        "class Bench(_Bench):\n    drive: Drive\n    rig: Rig\n    telemetry: Telemetry\n    truth: Truth\n" + _AT
        + _faults(),
    ]
    return "\n".join(parts)


_AT = "    def at(self, time_s: float) -> Rig: ...\n"


def _literal(name: str, values: Iterable[str]) -> str:
    return f"{name} = Literal[\n" + "".join(f'    "{value}",\n' for value in values) + "]\n"


def _table(name: str, names: str) -> str:
    return f"class {name}(SignalTable):\n    def __getitem__(self, name: {names} | str) -> Signal: ...\n"


def _variable(name: str) -> str:
    signal = bench_variables()[name]
    low, high = variable_range(name)
    about = " ".join((signal.comment or "").split()).replace('"', "'").replace("\\", "")
    return f'    {name}: float\n    """{low:g} to {high:g} {signal.unit or ""}. {about}"""\n'.replace(" . ", ". ")


def _faults() -> str:
    return "".join(map(_fault, fault_kinds().values()))


def _fault(kind: FaultKind) -> str:
    arguments = []
    for name in kind.arguments:
        values = {"phase": PHASES, "leg": LEGS}.get(name, kind.choices)
        arguments.append(f"{name}: " + (f"Literal[{', '.join(map(_quoted, values))}]" if values else "float"))
    last = kind is list(fault_kinds().values())[-1]
    any_kind = ("    @overload\n    def fault(self, kind: str, *, duration_s: float | None = None, **arguments: Any) "
                "-> Fault: ...\n")
    return (f'    @overload\n    def fault(self, kind: Literal["{kind.name}"], *, '
            + "".join(f"{argument}, " for argument in arguments) + "duration_s: float | None = None) -> Fault: ...\n"
            + (any_kind if last else ""))


def _quoted(value: str) -> str:
    return f'"{value}"'


def main() -> int:
    """Writes the file."""
    FILE.write_text(text(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
