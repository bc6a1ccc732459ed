"""The commands of a page: which there are, what they take, and what they do with drive and test bench."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from salient.bench.drive import DriveError
from salient.bench.faults import FaultError, fault_kind
from salient.bench.recording import Recording
from salient.bench.rig import Fault, RigError
from salient.bench.sampler import Scope, ScopeError, arm
from salient.bench.variables import SIGNALS, short_names
from salient.bench.xcp import XcpError
from salient.bus.identity import OtherDatabase
from salient.errors import UsageError
from salient.machine.parameter_table import CHOICES, value_number
from salient.view.link import Link

COMMANDS: dict[str, dict[str, type]] = {
    "speed_reference": {"rpm": float},
    "torque_reference": {"Nm": float},
    "stop": {},
    "off": {},
    "clear_fault": {},
    "load_torque": {"Nm": float},
    "truth_period": {"us": float},
    "fault": {"kind": str},
    "end_fault": {"kind": str},
    "end_faults": {},
    "parameters": {},
    "set_parameters": {"values": dict},
    "save_parameters": {},
    "fault_trace": {},
    "fault_log": {},
    "scope_names": {},
    "scope_arm": {"signals": list},
    "scope_trigger": {},
    "scope_read": {},
}
"""Commands of page/source.js that a drive on a bus carries out, with the arguments that each must have."""
_OPTIONAL: dict[str, dict[str, type]] = {
    "fault": {"phase": str, "leg": str, "value": object, "duration_s": float},
    "end_fault": {"phase": str, "leg": str},
    "scope_arm": {"trigger": str, "before": float, "divider": float},
}
_PART_WORDS = 256
"""A part of the buffer takes 30 ms of a bus: so long a command to stop waits at most."""


class Malformed(Exception):
    """No message that the page sends."""


def check_command(name: Any, arguments: Any) -> None:
    """Malformed when no command has the name or the arguments."""
    if not isinstance(name, str) or name not in COMMANDS or not isinstance(arguments, dict):
        raise Malformed
    required, optional = COMMANDS[name], _OPTIONAL.get(name, {})
    if not required.keys() <= arguments.keys() <= required.keys() | optional.keys():
        raise Malformed
    for key, value in arguments.items():
        if not _is(value, {**optional, **required}[key]):
            raise Malformed
    if name == "scope_arm" and not all(isinstance(signal, str) for signal in arguments["signals"]):
        raise Malformed
    if name == "set_parameters" and not all(_is(value, float) or value in CHOICES.get(parameter, ())
                                            for parameter, value in arguments["values"].items()):
        raise Malformed


def _is(value: Any, kind: type) -> bool:
    if kind is float:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return is_number and abs(value) <= sys.float_info.max  # a whole number may be larger, which no float has
    return isinstance(value, kind)


class Commander:
    """Carries out commands, in the thread of the link."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._faults: list[Fault] = []
        self._scope: Scope | None = None
        self._parts: Iterator[Recording | None] | None = None

    def execute(self, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """The answer to a checked command: ok, message, and the value where there is one."""
        action: Callable[..., Any] = getattr(self, f"_{name}")
        try:
            value = action(**arguments)
        except (DriveError, OtherDatabase, RigError, FaultError, XcpError, ScopeError, UsageError) as error:
            return {"ok": False, "message": str(error)}
        except KeyError as error:
            return {"ok": False, "message": str(error.args[0])}
        return {"ok": True, "message": "", **({} if value is None else {"value": value})}

    def _speed_reference(self, rpm: float) -> None:
        self._link.drive.speed_reference_rpm = rpm

    def _torque_reference(self, Nm: float) -> None:
        self._link.drive.torque_reference_Nm = Nm

    def _stop(self) -> None:
        self._link.drive.stop()

    def _off(self) -> None:
        self._link.drive.off()

    def _clear_fault(self) -> None:
        self._link.drive.clear_fault()

    def _load_torque(self, Nm: float) -> None:
        self._link.rig.load_torque_Nm = Nm

    def _truth_period(self, us: float) -> None:
        self._link.rig.truth_period_us = us

    def _fault(self, kind: str, value: Any = None, duration_s: float | None = None, **places: str) -> None:
        definition = fault_kind(kind)
        arguments: dict[str, Any] = dict(places)
        if value is not None and definition.attribute is not None:
            arguments[definition.attribute[0]] = value
        fault = self._link.rig.fault(kind, duration_s=duration_s, **arguments)
        if duration_s is None:
            self._faults.append(fault)

    def _end_fault(self, kind: str, **places: str) -> None:
        self._link.rig.clear_fault(kind, **places)

    def _end_faults(self) -> None:
        while self._faults:
            self._faults.pop().clear()

    def _parameters(self) -> list[dict[str, Any]]:
        parameters = self._link.drive.parameters
        return [{**asdict(row), "value": parameters[name]} for name, row in parameters.rows.items()]

    def _set_parameters(self, values: dict[str, Any]) -> None:
        self._link.drive.parameters.update({name: value_number(name, value) for name, value in values.items()})

    def _save_parameters(self) -> None:
        self._link.drive.parameters.save()

    def _fault_trace(self) -> dict[str, Any]:
        trace = self._link.drive.fault_trace()
        return {name: np.asarray(column).tolist() for name, column in vars(trace).items()}

    def _fault_log(self) -> list[dict[str, Any]]:
        return [asdict(fault) for fault in self._link.drive.fault_log.read()]

    def _scope_names(self) -> list[str]:
        """Short names of variables; any path in the drive's memory is one, too."""
        return list(SIGNALS)

    def _scope_arm(self, signals: list[str], trigger: str = "", before: float = 0.25, divider: float = 1) -> None:
        with self._link.kept_log():
            self._scope = arm(self._link, signals, trigger or None, before=before, divider=int(divider))
        self._parts = None

    def _scope_trigger(self) -> None:
        with self._link.kept_log():
            self._armed.trigger()

    def _scope_read(self) -> dict[str, Any]:
        """state: "waits", "reads", of which each call does a part, or "complete", with the recording."""
        with self._link.kept_log():
            if self._parts is None:
                if not self._armed.is_complete():
                    return {"state": "waits"}
                self._parts = self._armed.parts(_PART_WORDS)
            parts, self._parts = self._parts, None  # after an error the next call begins anew
            recording = next(parts)
        if recording is None:
            self._parts = parts
            return {"state": "reads"}
        signals = [{"name": name, "unit": recording.units[name], "values": values.tolist(),
                    "choices": _choices(recording.names.get(name))} for name, values in recording.values.items()]
        return {"state": "complete", "title": self._armed.title, "time_s": recording.time_s.tolist(),
                "signals": signals}

    @property
    def _armed(self) -> Scope:
        if self._scope is None:
            raise ScopeError("the buffer is not armed")
        return self._scope


def _choices(names: Mapping[int, str] | None) -> dict[str, str] | None:
    return None if names is None else {str(number): text for number, text in short_names(names).items()}
