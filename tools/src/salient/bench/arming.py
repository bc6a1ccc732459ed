"""Arming a drive in two steps (firmware/comms/arming.h): request, challenge, response."""

from __future__ import annotations

import can
from cantools.database.can import Message

from salient.bench.client import Client
from salient.bus import e2e
from salient.bus.signals import drive_database, value_numbers

_ARM = drive_database().get_message_by_name("DRIVE_ARM")
_REPORT = "DRIVE_ARMING"
_STATUS = drive_database().get_message_by_name("DRIVE_STATUS")
assert _STATUS.cycle_time is not None  # GenMsgCycleTime in drive.dbc
STEPS = value_numbers(drive_database(), "DRIVE_ARM", "step")
ATTEMPTS = value_numbers(drive_database(), "DRIVE_ARMING", "attempt")

RETRY_NS = 500_000_000
"""Time without a challenge or its result after which the request is repeated: that in which a challenge is valid. It
passes for the session and for the drive, by the frames that it has sent: in slow motion on SocketCAN, where a session
has the time of the interface, the drive's result takes longer, and a request that is repeated too early makes it
void."""
_RETRY_FRAMES = RETRY_NS // (_STATUS.cycle_time * 1_000_000)
ATTEMPTS_MAX = 4
_SILENCE_MAX_NS = ATTEMPTS_MAX * RETRY_NS
"""A drive that has sent nothing for so long is off, and must not be armed when it is switched on."""
_FAST_POLL_NS = 50_000
_FAST_POLL_FOR_NS = 2_000_000
_SLOW_POLL_NS = 1_000_000


def arm_frame(counter: int, step: str, response: int = 0, message: Message = _ARM) -> can.Message:
    """A DRIVE_ARM with its checksum. counter 0..255; step one of STEPS; response 0..2^32-1; message: of the
    node."""
    return e2e.protected_frame(message, counter % 256, {"step": STEPS[step], "response": response})


def response_to(challenge: int) -> int:
    """The response that confirms a challenge: every bit inverted."""
    return ~challenge & 0xFFFFFFFF


class ArmingSequence:
    """Arms a drive as virtual time advances: call `step` at `due_ns`. given_up: the drive has not taken ATTEMPTS_MAX
    requests, or has been silent for 2 s."""

    due_ns: int
    armed: bool
    given_up: bool

    def __init__(self, session: Client, counter: int) -> None:
        self._session = session
        self._counter = counter
        self._attempts = 0
        self._answered: int | None = None
        self.armed = self.given_up = False
        self._seen = session.telemetry.count(_REPORT)
        self._request()

    @property
    def counter(self) -> int:
        """Sequence counter of the next DRIVE_ARM."""
        return self._counter

    def step(self) -> None:
        """Answers a challenge that has come, repeats a request that has had no result, sets due_ns."""
        count = self._session.telemetry.count(_REPORT)
        if count > self._seen:
            self._seen = count
            self._take_report()
        elapsed_ns = self._session.time_ns - self._sent_ns
        frames = self._session.telemetry.count(_STATUS.name) - self._frames
        is_over = self._refused or (elapsed_ns >= RETRY_NS and frames >= _RETRY_FRAMES)
        if is_over and not self.armed and self._attempts < ATTEMPTS_MAX:
            self._request()
            elapsed_ns = 0
        elif is_over or (elapsed_ns >= _SILENCE_MAX_NS and not frames):
            self.given_up = not self.armed
        self.due_ns = self._session.time_ns + (_FAST_POLL_NS if elapsed_ns < _FAST_POLL_FOR_NS else _SLOW_POLL_NS)

    def _take_report(self) -> None:
        present, armed, challenge = (int(self._session.telemetry[f"{_REPORT}.{name}"].last)
                                     for name in ("attempt", "armed", "challenge"))
        attempt = present == ATTEMPTS["run"]
        if armed and self._answered is not None:
            self.armed = True
        elif attempt and challenge != self._answered:
            self._answered = challenge
            self._send("confirm_run", response_to(challenge))
        elif not attempt and self._answered is not None:
            self._refused = True

    def _request(self) -> None:
        self._attempts += 1
        self._answered = None
        self._refused = False
        self._sent_ns = self._session.time_ns
        self._frames = self._session.telemetry.count(_STATUS.name)
        self._send("request_run")
        self.due_ns = self._sent_ns + _FAST_POLL_NS

    def _send(self, step: str, response: int = 0) -> None:
        message = self._session.drive_database.get_message_by_name(_ARM.name)
        self._session.send(arm_frame(self._counter, step, response, message))
        self._counter = (self._counter + 1) % 256
