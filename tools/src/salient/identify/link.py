"""Experiments of a drive over a session, and their record, which XCP sends while they last.

A record of a control period has current and voltage of the phase of the experiment, angle and switches: each period of
a pulse, and one in a millisecond between (firmware/control/identify.h). Lost records are an error: a drive without
room for one, a record of which one frame has come, and a gap that is longer than the drive's pauses.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING

import numpy as np

from salient.bench.drive import Experiment
from salient.bench.sampler import _control_rate_hz, _member, check_layout, variables_of
from salient.bench.session import Session
from salient.bench.xcp import connected
from salient.errors import RunFailed

if TYPE_CHECKING:
    from pyxcp.master.master import Master

RECORD = np.dtype([("time_us", "i8"), ("current_A", "f8"), ("dc_link_V", "f8"), ("turn", "f8"), ("phase", "u1"),
                   ("action", "u1"), ("state", "u1"), ("number", "u1")])
"""turn: angle of the encoder in revolutions, continuous over the whole session."""
IDLE, HOLDS, WAITS, CHARGES, FREEWHEELS, DISCHARGES, RESTS, ENDED = range(8)
"""identify_state_t."""
OFF, ZERO, ON, PART = range(4)
"""identify_action_t."""
LIMITS = ("none", "a current is more than 3 % beyond current_limit_A", "a winding has had its copper loss",
          "the rotor has turned by 256 revolutions", "they last longer than 120 s",
          "the parameter controller must be salient")
"""Reasons by identify_limit_t."""
HOLD_RECORD_S, LOSS_MS = 0.5e-3, 1000
"""Time between two records of a hold; IDENTIFY_ENERGY_MS."""
_EVENT_IDENTIFY = 3
_TIMESTAMP = 0x10
_ANGLE_BITS, _NUMBER_MASK = 20, 15
_STEP_NS = 500_000
_KEEP_ALIVE_NS = 4_000_000_000
_GAP_US = 1500
"""Time between two records beyond which one is missing: an idle drive has one in a millisecond."""
_ANSWER_NS = 50_000_000
"""Longest time to the first record of an experiment."""


class IdentifyError(RunFailed):
    """The drive has ended the experiments, or they tell nothing."""


class Link:
    """Experiments of the drive of a session. limit_A: the parameter current_limit_A, of which levels are parts;
    period_s: control period; log: all records."""

    def __init__(self, session: Session, master: Master) -> None:
        self._session, self._master = session, master
        variables = variables_of(session)
        self._variables = variables
        check_layout(master, variables)
        self.period_s = 1.0 / _control_rate_hz(session)
        self.limit_A = float(session.drive.parameters["current_limit_A"])
        self._current_A = variables.quantity("control.measurement.current_q9[0]").factor
        self._voltage_V = variables.quantity("control.measurement.dc_link_voltage_q6").factor
        self._middle_rev = self._member("control_parameters.encoder_middle") / (1 << 32)
        self._response_id = session.drive_database.get_message_by_name("XCP_RESPONSE").frame_id
        self._parts: list[np.ndarray] = []
        self._pending: bytes | None = None
        self._time_us = self._turn = 0
        self._kept_alive_ns = session.time_ns
        self._start_stream()

    @property
    def time_s(self) -> float:
        """Time of the session."""
        return self._session.time_s

    @property
    def log(self) -> np.ndarray:
        """All records so far."""
        if len(self._parts) > 1:
            self._parts = [np.concatenate(self._parts)]
        return self._parts[0] if self._parts else np.zeros(0, RECORD)

    def _start_stream(self) -> None:
        master = self._master
        master.freeDaq()
        master.allocDaq(1)
        master.allocOdt(0, 2)
        for odt in range(2):
            master.allocOdtEntry(0, odt, 1)
        for odt in range(2):
            address = self._variables.quantity(f"identify.record[{odt}]").variable.address
            master.setDaqPtr(0, odt, 0)
            master.writeDaq(0xFF, 4, 0, address)
        master.setDaqListMode(_TIMESTAMP, 0, _EVENT_IDENTIFY, 1, 0)
        self._session.log.clear()  # it may have records of another client's stream
        master.startStopDaqList(1, 0)

    def _member(self, path: str) -> int:
        return _member(self._master, self._variables, path)

    def loss_part(self, phases: Collection[int]) -> float:
        """Copper loss of the warmest winding so far, part of what the drive permits (firmware/control/identify.c)."""
        limit_q1 = round(self.limit_A / self._current_A) >> 8
        most = limit_q1**2 // 2 * round(1e-3 / self.period_s) * LOSS_MS
        return max(self._member(f"identify.energy[{phase}]") for phase in phases) / most

    def check(self) -> None:
        """IdentifyError: see check_limits; or a pause of the commands has ended the experiments. The drive is not armed
        again then: what the rotor did in between is in no record."""
        self.check_limits()
        if self._session.drive.state != "run":
            raise IdentifyError("the drive has ended the experiments: no command reached it for command_timeout_ms")

    def check_limits(self, earlier: int | None = 0) -> int:
        """The limit that the drive has. IdentifyError: a limit or a fault has ended the experiments, or records were
        lost. earlier: the limit of the run before, which the drive has until the next one begins; None: any."""
        drive = self._session.drive
        if drive.state == "fault":
            raise IdentifyError(f"the drive has ended the experiments by the fault {drive.fault}")
        limit = self._member("identify.limit")
        if limit and earlier is not None and limit != earlier:
            reason = LIMITS[limit] if limit < len(LIMITS) else f"its limit {limit}, which these tools do not know"
            raise IdentifyError(f"the drive has ended the experiments: {reason}")
        lost = self._member("sampler.lost")
        if lost:
            raise IdentifyError(f"{lost} records were lost: the bus has no room for them")
        return limit

    def _take(self) -> np.ndarray:
        """Records that have come since the last call; the session's log is emptied. IdentifyError: one is missing."""
        frames = [bytes(frame.data) for _, frame in self._session.log
                  if frame.arbitration_id == self._response_id and not frame.is_extended_id
                  and len(frame.data) and frame.data[0] < 2]
        self._session.log.clear()
        self._session.sent.clear()
        raw = bytearray()
        for frame in frames:
            if (frame[0] == 0) != (self._pending is None):
                raise self._missing("a frame of a record")
            if self._pending is None:
                self._pending = frame[1:7]
            else:
                raw += self._pending + frame[1:5]
                self._pending = None
        if not raw:
            return np.zeros(0, RECORD)
        words = np.frombuffer(bytes(raw), np.dtype([("time", "<u2"), ("first", "<u4"), ("second", "<u4")]))
        return self._decoded(words)

    def _missing(self, what: str) -> IdentifyError:
        """The error of records that do not fit together. IdentifyError: see check_limits; the drive has a reason."""
        self.check_limits()
        return IdentifyError(f"{what} is missing at {self.time_s:.3f} s: the bus had no room for it, or this computer "
                             "has not taken it in time")

    def _decoded(self, words: np.ndarray) -> np.ndarray:
        out = np.zeros(len(words), RECORD)
        times_us = np.concatenate([[self._time_us & 0xFFFF], words["time"].astype(np.int64)])
        steps = np.mod(np.diff(times_us), 65536)
        if (steps[0 if self._parts else 1:] > _GAP_US).any():
            raise self._missing("a record")
        out["time_us"] = self._time_us + np.cumsum(steps)
        second = words["second"]
        angle = (second >> 12).astype(np.int64)
        full = 1 << _ANGLE_BITS
        turned = np.mod(np.diff(np.concatenate([[self._turn % full], angle])) + full // 2, full) - full // 2
        turn = self._turn + np.cumsum(turned)
        out["turn"] = turn / full + self._middle_rev
        out["phase"] = second >> 9 & 7
        out["action"] = second >> 7 & 3
        out["state"] = second >> 4 & 7
        out["number"] = second & _NUMBER_MASK
        out["current_A"] = (words["first"] & 0xFFFF) * self._current_A
        out["dc_link_V"] = (words["first"] >> 16) * self._voltage_V
        self._time_us, self._turn = int(out["time_us"][-1]), int(turn[-1])
        self._parts.append(out)
        return out

    def _advance(self) -> np.ndarray:
        self._session.advance_to(self._session.time_ns + _STEP_NS)
        if self._session.drive.state != "run":
            self.check()
        if self._session.time_ns - self._kept_alive_ns > _KEEP_ALIVE_NS:
            self._kept_alive_ns = self._session.time_ns
            self.check()
        return self._take()

    def run(self, experiment: Experiment, timeout_s: float) -> np.ndarray:
        """Begins an experiment, and lets time pass until the drive is idle again, or until the timeout; returns its
        records. IdentifyError: see check."""
        if self._session.drive.state != "run":
            self.check()
        number = self._session.drive.begin_experiment(experiment) & _NUMBER_MASK
        begin_ns = self._session.time_ns
        parts: list[np.ndarray] = []
        end_ns = begin_ns + round(1e9 * timeout_s)
        while self._session.time_ns < end_ns or (not parts and self._session.time_ns < begin_ns + _ANSWER_NS):
            part = self._advance()
            part = part[part["number"] == number]
            if len(part):
                parts.append(part)
                if part["state"][-1] == IDLE and experiment.kind != "rest":
                    break
                if part["state"][-1] == ENDED:
                    self.check()
        if not parts:
            self.check()
            raise IdentifyError(f"no record of an experiment within {timeout_s:g} s; the drive is in state "
                                f"{self._session.drive.state}")
        return np.concatenate(parts)

    def interrupts(self, log: np.ndarray) -> bool:
        """Whether the experiment of these records has ended one with a current, whose flux its pulse then begins
        with."""
        before = self.log[:np.searchsorted(self.log["time_us"], log["time_us"][0])][-1:]
        return bool(np.isin(before["state"], (HOLDS, CHARGES, FREEWHEELS, DISCHARGES)).any())

    def rest(self, duration_s: float) -> np.ndarray:
        """All switches off."""
        return self.run(Experiment("rest"), duration_s)


@contextmanager
def linked(session: Session) -> Iterator[Link]:
    """Arms the drive of a session for experiments, without one yet; at the end, whatever happens, it is switched off.
    IdentifyError: it does not take them."""
    with ExitStack() as stack:
        master = stack.enter_context(connected(session))
        drive = session.drive
        drive.wait_until_ready()
        stack.callback(drive.off)
        link = Link(session, master)
        drive.begin_experiment(Experiment("rest"))
        deadline_s = session.time_s + 1.0
        earlier: int | None = None
        while drive.state != "run":
            earlier = link.check_limits(earlier)
            if session.time_s > deadline_s or drive.state == "fault":
                link.check_limits()
                raise IdentifyError(f"the drive does not begin: state {drive.state}, fault {drive.fault}"
                                    f"{'; ' + drive.hindrance if drive.hindrance else ''}")
            session.run_for(1e-3)
        yield link


def degrees(turn: float) -> float:
    """Angle of revolutions."""
    return math.degrees(2.0 * math.pi * turn)
