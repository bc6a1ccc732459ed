"""Sets of parameters of a drive, staged and applied as a whole (firmware/comms/parameter_set.h)."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import can
from cantools.database.can import Database

from salient.bench.arming import ATTEMPTS, arm_frame, response_to
from salient.bench.client import Client
from salient.bus import e2e
from salient.bus.signals import drive_database, value_numbers

_DATABASE = drive_database()
_OPERATION = value_numbers(_DATABASE, "PARAMETER_RESPONSE", "operation")["set_control"]
SET_STEPS = value_numbers(_DATABASE, "PARAMETER_SET_CONTROL", "step")

_CHALLENGE_TIMEOUT_S = 0.012
"""Beyond the time in which a drive refuses another request to arm."""
_RESPONSE_TIMEOUT_S = 0.1
_TRIES = 20
"""A frame may be lost, and an attempt to arm for a run may be under way."""
_REPEATED = ("no_challenge", "no_response", "not_armed", "incomplete")


@dataclass(frozen=True)
class SetResult:
    """Status of a set, a name of the DBC, or no_challenge or no_response; parameters for which it is refused."""

    status: str
    index: int = 0
    other: int = 0


def write_frame(counter: int, index: int, raw: int, database: Database = _DATABASE) -> can.Message:
    """A PARAMETER_WRITE with its checksum; database: of the node."""
    message = database.get_message_by_name("PARAMETER_WRITE")
    return e2e.protected_frame(message, counter % 256, {"index": index, "value": raw})


def control_frame(counter: int, step: str, check: int = 0, database: Database = _DATABASE) -> can.Message:
    """A PARAMETER_SET_CONTROL with its checksum; step one of SET_STEPS; database: of the node."""
    message = database.get_message_by_name("PARAMETER_SET_CONTROL")
    return e2e.protected_frame(message, counter % 256, {"step": SET_STEPS[step], "check": check})


def set_frames(counter: int, writes: Mapping[int, int], begin: str = "begin",
               database: Database = _DATABASE) -> list[can.Message]:
    """The frames of a set from begin to apply, the first with this counter. writes: raw values by index; database: of
    the node."""
    frames = [control_frame(counter, begin, database=database)]
    check = 0
    for index, raw in writes.items():
        frames.append(write_frame(counter + len(frames), index, raw, database))
        check = zlib.crc32(bytes(frames[-1].data[e2e.HEADER_BYTES :]), check)
    return [*frames, control_frame(counter + len(frames), "apply", check, database)]


class ParameterSetWriter:
    """Arms a drive for configuration and sends it sets; lets virtual time pass until it has responded."""

    def __init__(self, session: Client) -> None:
        self._session = session
        self._database = session.drive_database
        self._arm, self._report, self._response = (self._database.get_message_by_name(name) for name in (
            "DRIVE_ARM", "DRIVE_ARMING", "PARAMETER_RESPONSE"))
        self._counter = 0

    def apply(self, writes: Mapping[int, int], defaults: bool = False) -> SetResult:
        """Applies raw values by index, over the present parameters or over the defaults."""
        return self._send(lambda counter: set_frames(counter, writes, "begin_defaults" if defaults else "begin",
                                                              self._database))

    def save(self) -> SetResult:
        """Requests that the parameters are stored."""
        return self._send(lambda counter: [control_frame(counter, "save", database=self._database)])

    def _send(self, frames_from: Callable[[int], list[can.Message]]) -> SetResult:
        """Sends frames of which the last one has the result, as often as they are lost."""
        result = SetResult("no_challenge")
        for _ in range(_TRIES):
            result = self._try(frames_from)
            if result.status not in _REPEATED:
                break
        return result

    def _try(self, frames_from: Callable[[int], list[can.Message]]) -> SetResult:
        counter = self._counter
        self._session.send(arm_frame(counter, "request_configuration", message=self._arm))
        try:
            report = self._session.advance_until_frame(self._is_challenge, _CHALLENGE_TIMEOUT_S)
        except TimeoutError:
            return SetResult("no_challenge")
        challenge = int.from_bytes(report.data[:4], "little")
        self._session.send(arm_frame(counter + 1, "confirm_configuration", response_to(challenge),
                                     self._arm))
        frames = frames_from(counter + 2)
        self._counter = (counter + 2 + len(frames)) % 256
        for frame in frames:
            self._session.send(frame)
        last = frames[-1].data
        value = (last[2] << 8 | last[3]).to_bytes(4, "little")
        try:
            response = self._session.advance_until_frame(
                lambda m: m.arbitration_id == self._response.frame_id and not m.is_extended_id
                and m.data[0] == _OPERATION and bytes(m.data[4:]) == value, _RESPONSE_TIMEOUT_S)
        except TimeoutError:
            return SetResult("no_response")
        status = str(self._response.decode_simple(bytes(response.data))["status"])
        return SetResult(status, index=response.data[1], other=response.data[2])

    def _is_challenge(self, message: can.Message) -> bool:
        return (message.arbitration_id == self._report.frame_id and not message.is_extended_id
                and message.data[4] & 3 == ATTEMPTS["configuration"])
