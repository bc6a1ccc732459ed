"""A drive and its test bench from a shell: `tools/salient command ACTION`.

One sender commands a drive (firmware/comms/commands.h). `speed`, `torque`, `clear` and `arm` therefore refuse a drive
that another one commands; `stop` takes its place, in the sequence of its counter, and a `speed` or `torque` that sees a
command of another sender sends no more.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import can
from cantools.database.can.signal import Signal

from salient.bench.arming import ArmingSequence, response_to
from salient.bench.drive import COMMAND_PERIOD_NS
from salient.bench.session import SILENCE_MAX_S, Session
from salient.bus.signals import LatestSignals, signal_range
from salient.errors import RunFailed, UsageError
from salient.paths import COMMAND

_LISTEN_S = 0.12
"""More than the longest period of telemetry that has the state, and than a sender's pause between commands."""
_START_S = 2.5
"""Time for the attempts to arm (ArmingSequence)."""
_CLEAR_S = 0.5
_TIMEOUT_S = 1.0
"""More than the silence after which the drive ends a run; and for an answer of the test bench."""
_OWN_FRAMES = 64
"""Sent in the longest time that the bus takes for a frame; fewer than the values of the counter."""
_FOREIGN_MAX = 3
"""Commands of another sender, sent before it has seen that its place is taken."""
_REFERENCES = {"speed": ("DRIVE_COMMAND", "speed_reference_rpm"),
               "torque": ("DRIVE_TORQUE_COMMAND", "torque_reference_Nm"),
               "position": ("DRIVE_POSITION_COMMAND", "position_deg")}


class _Shell(Session):
    """A session of any length on a bus that has its own time. foreign: commands of other senders in the last step."""

    foreign: list[can.Message]

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__(options.can, lockstep=False, machine=options.machine, node=options.node,
                         silence_max_s=SILENCE_MAX_S, signals=LatestSignals, machine_option="--machine")
        self.foreign = []
        self._own: deque[tuple[int, bytes]] = deque(maxlen=_OWN_FRAMES)  # the bus returns them
        self._commands = {self.drive_database.get_message_by_name(name).frame_id for name, _ in _REFERENCES.values()}

    def step(self, duration_s: float = COMMAND_PERIOD_NS * 1e-9) -> None:
        """Lets time pass; commands go out as they fall due."""
        self.run_for(duration_s)
        self._own.extend((m.arbitration_id, bytes(m.data)) for _, m in self.sent)
        self.foreign = [m for _, m in self.log if m.arbitration_id in self._commands and not m.is_extended_id
                        and (m.arbitration_id, bytes(m.data)) not in self._own]
        self.log.clear()
        self.sent.clear()

    def receive_until(self, matches: Callable[[can.Message], bool]) -> can.Message:
        """RunFailed when no frame matches for long."""
        deadline_ns = self.time_ns + round(_TIMEOUT_S * 1e9)

        def bounded(message: can.Message) -> bool:
            if self.time_ns > deadline_ns:
                raise RunFailed(f"{self.address}: no test bench answers on this bus")
            return matches(message)

        return super().receive_until(bounded)

    def listen(self) -> None:
        """Learns the state of the drive, and whether another sender commands it. RunFailed: no such drive."""
        self.step(_LISTEN_S)
        if self.drive.state == "unknown":
            raise RunFailed(f"{self.address}: no drive with node number {self.nodes[0]} on this bus")

    def require_no_sender(self) -> None:
        """RunFailed while another sender commands the drive."""
        if self.foreign:
            raise RunFailed(f"{self.address}: another sender commands the drive; '{COMMAND} command stop' takes its "
                            "place")

    def require_ready(self) -> None:
        """RunFailed, with the reason, unless the drive may be armed."""
        self.require_no_sender()
        self.drive.check_ready()
        if self.drive.state == "fault":
            raise RunFailed(f"the drive is in state fault ({self.drive.fault}); '{COMMAND} command clear' clears it")
        if self.drive.state != "ready":
            raise RunFailed(f"the drive is in state {self.drive.state} without a sender; its command timeout ends that")


def run(options: argparse.Namespace) -> int:
    """The action of a command line; its exit code."""
    actions: dict[str, Callable[[_Shell, Any], int]] = {
        "speed": _run_drive, "torque": _run_drive, "position": _run_drive,
        "load": _load, "stop": _stop, "clear": _clear, "arm": _arm}
    with _Shell(options) as shell:
        _check_range(shell, options)
        return actions[options.action](shell, options)


def _reference(shell: _Shell, action: str) -> Signal:
    message, name = _REFERENCES[action]
    return shell.drive_database.get_message_by_name(message).get_signal_by_name(name)


def _check_range(shell: _Shell, options: argparse.Namespace) -> None:
    """UsageError for a reference beyond the range of the machine that the drive carries."""
    if options.action in _REFERENCES:
        reference = _reference(shell, options.action)
        low, high = signal_range(reference)
        if not low <= options.value <= high:
            raise UsageError(f"{options.action} {options.value:g}: must be {low:g} to {high:g} {reference.unit}")


@contextlib.contextmanager
def _interrupts() -> Iterator[list[int]]:
    """The interrupts and requests to terminate that have come, which end nothing by themselves."""
    seen: list[int] = []
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(number, lambda received, _: seen.append(received)) for number in numbers]
    try:
        yield seen
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


def _say(line: str) -> None:
    print(line, flush=True)


def _run_drive(shell: _Shell, options: argparse.Namespace) -> int:
    """speed, torque: until the drive has stopped. RunFailed: it was not armed, or ended by itself."""
    shell.listen()
    shell.require_ready()
    drive, name = shell.drive, _REFERENCES[options.action][1]
    with _interrupts() as interrupts, _switched_off(shell):
        setattr(drive, name, options.value)
        started_ns = shell.time_ns
        while drive.state != "run":
            shell.step()
            if interrupts:
                drive.off()
                _say("interrupted before it ran")
                return 1
            _check_run(shell)
            if shell.time_ns - started_ns > _START_S * 1e9:
                raise RunFailed(f"the drive does not arm: it has refused "
                                f"{shell.telemetry['DRIVE_ARMING.refused'].last:.0f} frames")
        unit = _reference(shell, options.action).unit
        until = "until Ctrl-C" if options.duration_s is None else f"for {options.duration_s:g} s"
        _say(f"running: {options.action} {options.value:g} {unit}, {until}")
        end_ns = None if options.duration_s is None else started_ns + round(options.duration_s * 1e9)
        while not interrupts and (end_ns is None or shell.time_ns < end_ns):
            shell.step()
            if shell.foreign:
                drive.silence()
                _say("another sender has taken the place of this command")
                return 0 if end_ns is None else 1
            _check_run(shell)
            if drive.state != "run":
                raise RunFailed(f"the run has ended: state {drive.state}")
        _say(f"stopping from {shell.telemetry['speed_rpm'].last:.1f} r/min")
        _ramp_down(shell, interrupts)
    return 0


@contextlib.contextmanager
def _switched_off(shell: _Shell) -> Iterator[None]:
    """A failure in between opens the switches of a drive that this session commands."""
    try:
        yield
    except BaseException:
        if shell.drive.command_due_ns is not None:
            with contextlib.suppress(Exception):
                shell.drive.off()
                shell.step()  # a client that leaves with unread frames may lose what it has sent last
        raise


def _check_run(shell: _Shell) -> None:
    if shell.drive.state == "fault":
        shell.drive.silence()
        raise RunFailed(f"the drive has ended in the fault {shell.drive.fault}")


def _ramp_down(shell: _Shell, interrupts: list[int]) -> None:
    """Commands stop until the drive does not run; the next interrupt opens the switches at once."""
    before = len(interrupts)
    shell.drive.stop()
    foreign = 0
    while shell.drive.state == "run":
        shell.step()
        foreign += len(shell.foreign)
        if foreign > _FOREIGN_MAX:
            shell.drive.silence()
            raise RunFailed("another sender keeps commanding the drive; end it there")
        if len(interrupts) > before:
            before = len(interrupts)
            shell.drive.off()
    shell.drive.silence()
    _check_run(shell)
    _say(f"state {shell.drive.state}")


def _load(shell: _Shell, options: argparse.Namespace) -> int:
    shell.rig.load_torque_Nm = options.value
    _say(f"load {options.value:g} N m")
    return 0


def _stop(shell: _Shell, options: argparse.Namespace) -> int:
    shell.listen()
    if shell.drive.state != "run":
        _say(f"the drive does not run: state {shell.drive.state}")
        return 0
    if not shell.foreign:
        shell.step(_TIMEOUT_S)
        _say(f"without a sender the drive has ended by its command timeout: state {shell.drive.state}")
        return 0 if shell.drive.state != "run" else 1
    shell.drive.continue_from(shell.foreign[-1].data[2])
    with _interrupts() as interrupts, _switched_off(shell):
        _ramp_down(shell, interrupts)
    return 0


def _clear(shell: _Shell, options: argparse.Namespace) -> int:
    shell.listen()
    shell.require_no_sender()
    fault = shell.drive.fault
    if shell.drive.state != "fault":
        _say(f"no fault: state {shell.drive.state}")
        return 0
    shell.drive.clear_fault()
    end_ns = shell.time_ns + round(_CLEAR_S * 1e9)
    while shell.drive.state == "fault" and shell.time_ns < end_ns:
        shell.step()
    shell.drive.silence()
    if shell.drive.state == "fault":
        raise RunFailed(f"the fault {fault} stays: its cause has not gone")
    _say(f"cleared {fault}: state {shell.drive.state}")
    return 0


def _arm(shell: _Shell, options: argparse.Namespace) -> int:
    shell.listen()
    shell.require_ready()
    shell.drive.off()  # a drive is armed for a sender
    sequence = ArmingSequence(shell, 0)
    challenge = 0
    while not sequence.armed and not sequence.given_up:
        shell.advance_to(sequence.due_ns)
        challenge = int(shell.telemetry["DRIVE_ARMING.challenge"].last) or challenge
        sequence.step()
    shell.drive.silence()
    if not sequence.armed:
        raise RunFailed(f"the drive does not arm: it has refused {shell.telemetry['DRIVE_ARMING.refused'].last:.0f} "
                        "frames")
    _say(f"armed: challenge 0x{challenge:08X}, response 0x{response_to(challenge):08X}; the drive disarms itself, "
         "because no run follows")
    return 0
