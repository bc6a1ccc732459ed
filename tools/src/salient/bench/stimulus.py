"""Every act on a drive and its test bench, from the frames of hosts: commands, parameters, variables, faults.

The frames are the only record of the acts, so that a report, a plot and a page show what was sent, and nothing else.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import can
from cantools.database.can import Message
from cantools.database.errors import DecodeError
from cantools.database.namedsignalvalue import NamedSignalValue

from salient.bench.arming import response_to
from salient.bench.xcp import AREA_PARAMETERS
from salient.bus import e2e
from salient.bus.signals import FrameKey, drive_database, frame_key, rig_database
from salient.dbc import PHASES
from salient.machine.file import load_machine, machine_path
from salient.machine.parameter_table import read_table, value_name
from salient.machine.scaling import Exponents, scaling_of

if TYPE_CHECKING:
    from salient.bench.session import Session

STIMULI = "stimuli"
"""Key of the acts in the notes of a failure: time_s and text, in order."""
_HOST = "HOST"
_ONLY_TIME = ("RIG_RUN_UNTIL", "RIG_STAMP")
"""Messages of a host that are no act."""
_ANSWERS = ("DRIVE_ARMING", "PARAMETER_RESPONSE", "RIG_SET_REPLY", "RIG_FAULT_REPLY")
_REFERENCES = {"DRIVE_COMMAND": ("speed", "speed_reference_rpm"),
               "DRIVE_TORQUE_COMMAND": ("torque", "torque_reference_Nm"),
               "DRIVE_POSITION_COMMAND": ("position", "position_deg")}
_WRITING = ("write", "save", "restore_defaults")
"""Operations of PARAMETER_REQUEST that do not only read."""
_XCP_SET_MTA, _XCP_DOWNLOAD, _XCP_DOWNLOAD_BYTES = 0xF6, 0xF0, 6
"""Commands of XCP (firmware/comms/xcp_code.h), and the bytes of one that writes a parameter."""
_SILENT_PERIODS = 3
"""Periods of the commands, after which they have ceased."""


@dataclass(slots=True)
class Stimulus:
    """An act. time_s: virtual time of its effect; the time of one that still waits may be to come."""

    time_s: float
    text: str

    def __str__(self) -> str:
        return f"{self.time_s:.6f} s {self.text}"


def stimuli_of(session: Session) -> list[Stimulus]:
    """The acts on the drives and test benches of a session until now, in the order of their effects: its own ones,
    even those that are not on the bus yet, and other clients'."""
    sent = Counter(_content(message) for _, message in session.sent)
    hosts = _messages_from(_HOST, session.machine, session.nodes)
    frames = list(session.sent)
    for timed in session.log:
        if _key(timed[1]) in hosts and sent[_content(timed[1])] > 0:
            sent[_content(timed[1])] -= 1
        else:
            frames.append(timed)
    frames.sort(key=lambda timed: timed[0])  # keeps a request before its reply at the same time
    unknown = [message for _, message in session.sent if _key(message) not in hosts]
    return stimuli(frames, session.time_ns, session.machine, session.nodes, {id(message) for message in unknown})


def stimuli(frames: Iterable[tuple[int, can.Message]], end_ns: int, machine: str | None,
            nodes: Sequence[int], unknown: Iterable[int] = ()) -> list[Stimulus]:
    """The acts of the hosts among the frames of a bus, which are in the order of time up to end_ns; in the order of
    their effects. machine: None with SI units. unknown: id() of the frames that no host of the databases sends and
    that are an act all the same."""
    prefixes = [f"node {node}: " if len(nodes) > 1 else "" for node in nodes]
    readers = [_Reader(machine, node, prefix) for node, prefix in zip(nodes, prefixes, strict=True)]
    of_key = {key: (reader, message) for reader in readers for key, message in reader.messages.items()}
    others, found = frozenset(unknown), list[Stimulus]()
    for time_ns, frame in frames:
        if id(frame) in others:
            found.append(Stimulus(time_ns / 1e9, f"frame {_frame_text(frame)}"))
        elif (known := of_key.get(_key(frame))) is not None:
            known[0].take(time_ns, known[1], frame)
    for reader in readers:
        found += reader.end(end_ns)
    return sorted(found, key=lambda stimulus: stimulus.time_s)


def last_before(found: Sequence[Stimulus], time_s: float) -> Stimulus | None:
    """The latest act that had its effect by a time; None without one."""
    return next((stimulus for stimulus in reversed(found) if stimulus.time_s <= time_s), None)


def act_frames(machine: str | None, nodes: Sequence[int]) -> dict[FrameKey, Message]:
    """The messages that `stimuli` reads, by identifier and whether it has 29 bits."""
    return {key: message for sender in (_HOST, "DRIVE", "RIG")
            for key, message in _messages_from(sender, machine, nodes).items()
            if message.name not in _ONLY_TIME and (sender == _HOST or message.name in _ANSWERS)}


def _key(frame: can.Message) -> FrameKey:
    return frame.arbitration_id, frame.is_extended_id


def _content(frame: can.Message) -> tuple[int, bool, bool, bool, bytes]:
    return frame.arbitration_id, frame.is_extended_id, frame.is_remote_frame, frame.is_fd, bytes(frame.data)


def _messages_from(sender: str, machine: str | None, nodes: Sequence[int]) -> dict[FrameKey, Message]:
    return {frame_key(message): message for node in nodes
            for database in (drive_database(machine, node), rig_database(node)) for message in database.messages
            if sender in message.senders}


def _frame_text(frame: can.Message) -> str:
    kind = "remote" if frame.is_remote_frame else bytes(frame.data).hex(" ") or "without data"
    return f"{frame.arbitration_id:0{8 if frame.is_extended_id else 3}X}: {kind}"


def _with_unit(number: float, unit: str | None) -> str:
    return f"{number:.10g} {unit or ''}".rstrip()


class _Reader:
    """The acts on one drive and its test bench."""

    def __init__(self, machine: str | None, node: int, prefix: str) -> None:
        self.messages = act_frames(machine, (node,))
        self._rows = read_table()
        path = machine_path(machine) if machine is not None else None
        self._fraction_bits = ([Exponents().fraction_bits(row) for row in self._rows] if path is None
                               else scaling_of(path, load_machine(path)).fraction_bits())
        self._prefix = prefix
        self._found: list[Stimulus] = []
        self._command: tuple[object, ...] | None = None
        self._command_ns = 0
        self._command_period_ns = 0
        self._run_ns: int | None = None
        self._armings: list[Stimulus] = []
        self._challenge = 0
        self._staged: list[str] = []
        self._staged_ns = 0
        self._xcp_address = 0
        self._window_text = ""
        self._sets: dict[bytes, Stimulus] = {}
        self._profile: Stimulus | None = None
        self._unanswered: dict[tuple[str, int], deque[tuple[int, Stimulus]]] = defaultdict(deque)
        self._take = {"DRIVE_COMMAND": self._command_frame, "DRIVE_TORQUE_COMMAND": self._command_frame,
                      "DRIVE_POSITION_COMMAND": self._command_frame,
                      "DRIVE_IDENTIFY_COMMAND": self._experiment, "DRIVE_IDENTIFY_WINDOW": self._window,
                      "DRIVE_ARM": self._arm, "PARAMETER_WRITE": self._write, "PARAMETER_SET_CONTROL": self._control,
                      "PARAMETER_REQUEST": self._parameter_request, "DRIVE_ARMING": self._arming_report,
                      "PARAMETER_RESPONSE": self._parameter_response, "RIG_SET": self._rig_set,
                      "RIG_LOAD_PROFILE": self._load_profile, "RIG_FAULT": self._rig_fault,
                      "RIG_SET_REPLY": self._reply, "RIG_FAULT_REPLY": self._reply}

    def take(self, time_ns: int, message: Message, frame: can.Message) -> None:
        """Takes a frame of one of `messages`."""
        if message.name == "XCP_COMMAND":  # of any length
            self._xcp(time_ns, bytes(frame.data))
            return
        from_host = _HOST in message.senders
        is_whole = len(frame.data) == message.length and not (frame.is_remote_frame or frame.is_fd)
        is_protected = from_host and any(signal.name == "checksum" for signal in message.signals)
        values = self._decoded(message, frame) if is_whole else None
        if values is not None and not (is_protected and not e2e.check(e2e.data_id(message), bytes(frame.data))):
            self._take[message.name](time_ns, message, frame, values)
        elif from_host:
            reason = ("wrong length or format" if not is_whole else
                      "unknown content" if values is None else "wrong checksum")
            self._add(time_ns, f"{message.name}, {reason}: frame {_frame_text(frame)}")

    def end(self, end_ns: int) -> list[Stimulus]:
        """All acts, when no more frames come."""
        self._commands_ceased(end_ns)
        if self._staged:
            self._add(self._staged_ns, f"parameters staged, not applied: {', '.join(self._staged)}")
        for stimulus in self._found:
            if stimulus.time_s * 1e9 > end_ns:
                stimulus.text += " (not yet)"
            stimulus.text = self._prefix + stimulus.text
        return self._found

    @staticmethod
    def _decoded(message: Message, frame: can.Message) -> dict[str, Any] | None:
        """The signals, those with named values as text; None when the multiplexer selects none."""
        try:
            return dict(message.decode_simple(bytes(frame.data)))
        except DecodeError:
            return None

    def _add(self, time_ns: float, text: str) -> Stimulus:
        stimulus = Stimulus(time_ns / 1e9, text)
        self._found.append(stimulus)
        return stimulus

    # --- commands ---

    def _command_frame(self, time_ns: int, message: Message, frame: can.Message, values: dict[str, Any]) -> None:
        del frame
        self._commands_ceased(time_ns)
        mode, name = _REFERENCES[message.name]
        request = str(values["request"])
        command = (request, mode, values[name]) if request == "run" else (request,)
        self._command_ns, self._command_period_ns = time_ns, (message.cycle_time or 0) * 1_000_000
        if command == self._command:
            return
        self._command = command
        unit = message.get_signal_by_name(name).unit
        if request == "run":
            self._forget_arming()
            self._run_ns = time_ns
            self._add(time_ns, f"run in {mode} mode, {name} = {_with_unit(values[name], unit)}")
        else:
            self._add(time_ns, f"request {request}")

    def _experiment(self, time_ns: int, message: Message, frame: can.Message, values: dict[str, Any]) -> None:
        del frame
        self._commands_ceased(time_ns)
        request, kind = str(values["request"]), str(values["kind"])
        command = (request, "experiment", int(values["number"])) if request == "run" else (request,)
        self._command_ns, self._command_period_ns = time_ns, (message.cycle_time or 0) * 1_000_000
        if command == self._command:
            return
        self._command = command
        if request != "run":
            self._add(time_ns, f"request {request}")
            return
        self._forget_arming()
        self._run_ns = time_ns
        of = "" if kind == "rest" else f" of phase {PHASES[int(values['phase'])]} at {float(values['level']):.4f}"
        self._add(time_ns, f"experiment {int(values['number'])}: {kind}{of}{self._window_text}")
        self._window_text = ""

    def _window(self, time_ns: int, message: Message, frame: can.Message, values: dict[str, Any]) -> None:
        del time_ns, message, frame
        self._window_text = f", window {float(values['angle']):.5f} + {float(values['width']):.5f} rev"

    def _commands_ceased(self, time_ns: int) -> None:
        """Notes that there have been no commands for longer than their period: the drive stops for that."""
        period_ns = self._command_period_ns
        if self._command is not None and period_ns and time_ns - self._command_ns > _SILENT_PERIODS * period_ns:
            self._add(self._command_ns + period_ns, f"no more commands, the last one at {self._command_ns / 1e9:.6f} s")
            self._command = None

    def _forget_arming(self) -> None:
        """The requests to arm since the last act were a part of the one that comes now."""
        self._found = [stimulus for stimulus in self._found if all(stimulus is not part for part in self._armings)]
        self._armings = []

    def _arm(self, time_ns: int, message: Message, frame: can.Message, values: dict[str, Any]) -> None:
        del message, frame
        step = str(values["step"])
        if step == "request_run" and self._run_ns is not None and time_ns - self._run_ns <= self._command_period_ns:
            return  # a part of the request to run, which had priority on the bus
        if step.startswith("request"):
            self._armings.append(self._add(time_ns, f"arming: {step}"))
        elif values["response"] != response_to(self._challenge):
            self._add(time_ns, f"arming: {step} with a wrong response")

    def _arming_report(self, time_ns: int, message: Message, frame: can.Message, values: dict[str, Any]) -> None:
        del time_ns, message, frame
        self._challenge = int(values["challenge"])

    # --- parameters ---

    def _value(self, index: int, raw: int) -> str:
        if index >= len(self._rows):
            return f"parameter {index} = {raw}"
        row = self._rows[index]
        if (name := value_name(row.name, raw)) is not None:
            return f"{row.name} = {name}"
        return f"{row.name} = {_with_unit(math.ldexp(raw, -self._fraction_bits[index]), row.unit)}"

    def _write(self, time_ns: int, message: Message, frame: can.Message, values: dict[str, Any]) -> None:
        del message, frame
        self._forget_arming()
        self._staged.append(self._value(int(values["index"]), int(values["value"])))
        self._staged_ns = time_ns

    def _control(self, time_ns: int, message: Message, frame: can.Message, values: dict[str, Any]) -> None:
        del message
        self._forget_arming()
        step = str(values["step"])
        if step.startswith("begin"):
            self._staged = ["all others to their defaults"] if step == "begin_defaults" else []
            self._staged_ns = time_ns
            return
        texts = {"save": "parameters stored", "abandon": "parameter set abandoned",
                 "apply": f"parameters set: {', '.join(self._staged) or 'none'}"}
        stimulus = self._add(time_ns, texts.get(step, f"parameter set: {step}"))
        if step != "save":
            self._staged = []
        # The response repeats counter and step of its request.
        self._sets[bytes([frame.data[3], frame.data[2], 0, 0])] = stimulus

    def _parameter_request(self, time_ns: int, message: Message, frame: can.Message, values: dict[str, Any]) -> None:
        del message, frame
        if str(values["operation"]) in _WRITING:
            self._add(time_ns, f"unprotected parameter request: {values['operation']}, "
                      f"{self._value(int(values['index']), int(values['value']))}")

    def _parameter_response(self, time_ns: int, message: Message, frame: can.Message, values: dict[str, Any]) -> None:
        del time_ns, message
        stimulus = self._sets.pop(bytes(frame.data[4:]), None) if str(values["operation"]) == "set_control" else None
        if stimulus is not None and str(values["status"]) != "done":
            stimulus.text += f" (refused: {values['status']})"

    def _xcp(self, time_ns: int, data: bytes) -> None:
        """A write of a parameter; the rest of XCP reads and records."""
        if data[:1] == bytes([_XCP_SET_MTA]):
            self._xcp_address = int.from_bytes(data[4:8], "little")
        elif data[:1] == bytes([_XCP_DOWNLOAD]) and len(data) >= _XCP_DOWNLOAD_BYTES:
            index, rest = divmod(self._xcp_address - AREA_PARAMETERS, 4)
            self._xcp_address += data[1]
            if rest == 0 and 0 <= index < len(self._rows):
                value = int.from_bytes(data[2:6], "little", signed=True)
                self._add(time_ns, f"parameter by XCP: {self._value(index, value)}")

    # --- test bench ---

    def _rig_set(self, time_ns: int, message: Message, frame: can.Message, values: dict[str, Any]) -> None:
        number = frame.data[0]
        signal = next(signal for signal in message.signals if signal.multiplexer_ids == [number])
        value = values[signal.name]
        text = str(value) if isinstance(value, str | NamedSignalValue) else _with_unit(value, signal.unit)
        self._scheduled("RIG_SET", number, time_ns, values, f"{signal.name.replace('_coarse_', '_')} = {text}")

    def _rig_fault(self, time_ns: int, message: Message, frame: can.Message, values: dict[str, Any]) -> None:
        del message
        kind = str(values["kind"])
        begins = str(values[kind]) == "begins"
        parts = [f"{name.removeprefix(f'{kind}_')} {value}" for name, value in values.items()
                 if name.startswith(f"{kind}_") and (begins or name in (f"{kind}_phase", f"{kind}_leg"))]
        self._scheduled("RIG_FAULT", frame.data[0], time_ns, values,
                        ", ".join((f"fault {kind} {'begins' if begins else 'ends'}", *parts)))

    def _scheduled(self, message: str, number: int, time_ns: int, values: dict[str, Any], text: str) -> None:
        at_ns = int(values["at_us"]) * 1000
        asked = f" (scheduled at {time_ns / 1e9:.6f} s)" if at_ns > time_ns else ""
        stimulus = self._add(max(at_ns, time_ns), text + asked)
        self._unanswered[message, number].append((time_ns, stimulus))

    def _reply(self, time_ns: int, message: Message, frame: can.Message, values: dict[str, Any]) -> None:
        del time_ns
        waiting = self._unanswered[message.name.removesuffix("_REPLY"), frame.data[0]]
        if not waiting:
            return
        asked_ns, stimulus = waiting.popleft()
        if str(values["status"]) != "done":  # it never had an effect: its time is the attempt's
            stimulus.time_s = asked_ns / 1e9
            stimulus.text += f" (refused: {values['status']})"

    def _load_profile(self, time_ns: int, message: Message, frame: can.Message, values: dict[str, Any]) -> None:
        del message, frame
        text = f"load profile of {int(values['values'])} values"
        if int(values["index"]) == 0 or self._profile is None:
            self._profile = self._add(time_ns, text)
        else:
            self._profile.time_s = time_ns / 1e9
