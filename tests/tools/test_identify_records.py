"""Records that a drive may send, and the identification by them (of the drive: tests/hil/test_identify.py)."""

from __future__ import annotations

import hashlib
import math
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest
from scipy import linalg

from salient.identify import fit as electrical
from salient.identify.basis import FluxBasis
from salient.identify.fit import Fit
from salient.identify.link import CHARGES, IDLE, OFF, ON, RECORD, ZERO, IdentifyError, Link
from salient.identify.readings import inductance_of
from salient.identify.result import _earlier_maps
from salient.identify.sequence import Findings, Pulse, Sequence
from salient.identify.shaft import shaft_of

RESPONSE_ID = 0x123


class Received:
    """A session that has received frames."""

    def __init__(self) -> None:
        self.log: list[tuple[int, can.Message]] = []
        self.sent: list[tuple[int, can.Message]] = []
        self.time_s = 1.25


@pytest.fixture
def link(monkeypatch) -> Link:
    """A link of a drive that has no reason of its own."""
    of = object.__new__(Link)
    of._session, of._response_id, of._parts, of._pending = Received(), RESPONSE_ID, [], None
    of._time_us = of._turn = 0
    of._current_A, of._voltage_V, of._middle_rev = 1.0 / 512.0, 1.0 / 64.0, 0.0
    monkeypatch.setattr(Link, "check_limits", lambda _: None)
    return of


def frames_of(*times_us: int) -> list[tuple[int, can.Message]]:
    """Two frames of each record of an idle drive."""
    frames = []
    for time_us in times_us:
        data = [bytes([0]) + time_us.to_bytes(2, "little") + bytes(4), bytes([1]) + bytes(4)]
        frames += [(0, can.Message(arbitration_id=RESPONSE_ID, is_extended_id=False, data=each)) for each in data]
    return frames


def test_records_a_millisecond_apart_are_taken_over_the_wrap_of_their_time(link):
    link._session.log = frames_of(*((63_000 + 1000 * k) % 65536 for k in range(8)))
    assert np.diff(link._take()["time_us"]).tolist() == [1000] * 7
    link._session.log = frames_of(70_000 % 65536 + 1000)
    assert len(link._take()) == 1
    assert len(link.log) == 9


@pytest.mark.parametrize("lost", [[0], [1], [4], [2, 3], [3, 4], [2, 3, 4, 5]])
def test_a_lost_frame_is_an_error_never_another_record(link, lost):
    frames = frames_of(*range(1000, 6000, 1000))
    link._session.log = [frame for number, frame in enumerate(frames) if number not in lost]
    with pytest.raises(IdentifyError, match=r"is missing at 1\.250 s"):
        link._take()


def test_a_limit_that_the_tools_do_not_know_is_told_by_its_number(link, monkeypatch):
    monkeypatch.undo()
    link._session.drive = type("Ready", (), {"state": "run"})
    link._member = lambda path: 77 if path == "identify.limit" else 0
    with pytest.raises(IdentifyError, match="its limit 77, which these tools do not know"):
        link.check_limits()


# --- legal records from which nothing follows ------------------------------------------------------------------------

def log_of(current_A, action=ON, turn=0.1, state=CHARGES) -> np.ndarray:
    """Records at intervals of 0.1 ms, the first one with all switches off."""
    log = np.zeros(len(current_A), RECORD)
    log["time_us"] = 100 * np.arange(1, len(log) + 1)
    log["current_A"], log["dc_link_V"], log["turn"], log["state"] = current_A, 240.0, turn, state
    log["action"][1:] = action
    return log


def findings(phases: int = 3, noise_A: float = 0.0) -> Findings:
    found = Findings(list(range(phases)), 4, np.zeros(phases), np.full(phases, noise_A))
    found.position = {phase: phase / 12.0 for phase in range(phases)}
    return found


RISING = log_of([0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 2.0, 0.0], [ON] * 4 + [OFF] * 3)


@pytest.mark.parametrize("log", [RISING[:0], RISING[:1], log_of([0.0, 1.0]), log_of([0.0] * 5, ZERO), log_of([0.0] * 5),
                                 log_of([3.0, 2.0, 1.0, 0.0])], ids=len)
def test_a_pulse_without_a_rise_shows_no_inductance(log):
    assert inductance_of(log) == []


def test_a_pulse_shows_its_inductance():
    assert inductance_of(RISING) == [(pytest.approx(0.1), pytest.approx(240.0 * 0.4e-3 / 4.0))]


@pytest.mark.parametrize(("pulses", "noise_A", "reason"), [
    ([], 0.0, "phase a: 0 pulses with a current; its angle needs 4"),
    ([Pulse(0, RISING, True)] * 4 + [Pulse(1, RISING, True)] * 9, 0.0, "phase c: 0 pulses"),
    ([Pulse(0, RISING, True)] * 4 + [Pulse(1, RISING, True)] * 3, 0.0, "phase b: 3 pulses"),
    ([Pulse(phase, RISING, True) for phase in (0, 1, 2)] * 9, 1.1, "phase a: 0 pulses"),  # all of it within the noise
    ([Pulse(phase, log_of([0.0] * 6), True) for phase in (0, 1, 2)] * 9, 0.0, "phase a: 0 pulses"),
    ([Pulse(phase, RISING[1:], True) for phase in (0, 1, 2)] * 9, 0.0, "phase a: 0 pulses"),  # without its start
    ([Pulse(phase, RISING[:3], True) for phase in (0, 1, 2)] * 9, 0.0, "phase a: 0 pulses"),  # one sample
])
def test_pulses_that_do_not_suffice_are_refused_by_phase(pulses, noise_A, reason):
    with pytest.raises(IdentifyError, match=reason):
        electrical.rows_of(findings(noise_A=noise_A), pulses)


def test_pulses_none_of_which_is_of_the_map_are_refused():
    with pytest.raises(IdentifyError, match="no pulse of the map"):
        electrical.common_current_A([Pulse(0, RISING, False)] * 9)


def test_pulses_of_which_a_fourth_cannot_be_left_out_are_refused(monkeypatch):
    rows = electrical.rows_of(findings(), [Pulse(phase, RISING, True) for phase in (0, 1, 2)] * 4)
    basis = FluxBasis(4, 5.0, 8, 4)
    problem = electrical._problem(rows, 3, replace(still_fit(), coefficients=np.zeros(basis.size)), linear=True)

    def undetermined(*_):
        raise linalg.LinAlgError

    monkeypatch.setattr(electrical, "_solved", undetermined)
    with pytest.raises(IdentifyError, match="3 of 4 pulses do not determine the machine"):
        electrical._smoothness(problem, electrical._folds(problem, rows), (1.0,), (1.0,))


def sequence_of(turns_rev) -> tuple[Sequence, list[tuple[float, float]]]:
    of = object.__new__(Sequence)
    of.found = findings()
    return of, [(turn, 0.01 + 0.005 * math.cos(2.0 * math.pi * 4.0 * (turn - 0.02))) for turn in turns_rev]


@pytest.mark.parametrize("turns", [[0.1] * 8, [0.1, 0.1001] * 4, [0.35, 0.6, 0.85] * 3, np.linspace(0.1, 0.12, 12)])
def test_equal_angles_show_no_aligned_position(turns):
    sequence, shown = sequence_of(turns)
    with pytest.raises(IdentifyError, match="phase b: all its pulses are near the same angle"):
        sequence._aligned(1, shown)


@pytest.mark.parametrize("turns", [np.linspace(0.0, 0.25, 24), [0.01, 0.07, 0.13, 0.19] * 2])
def test_few_angles_far_apart_show_the_aligned_position(turns):
    sequence, shown = sequence_of(turns)
    assert sequence._aligned(1, shown) == pytest.approx(0.02, abs=1e-3)


def still_fit() -> Fit:
    basis = FluxBasis(4, 5.0, 8, 4)
    return Fit(basis, np.full(basis.size, 0.01), 1.0, 0.0, np.zeros(3), np.zeros(2), 0.0, np.zeros(3), 0.0, np.zeros(0))


@pytest.mark.parametrize(("records", "reason"), [
    (0, "no record of the turning rotor"), (1, "no record of the turning rotor"), (20, "too short for its inertia"),
    (3000, "does not follow the torque")])
def test_a_rotor_that_did_not_move_has_no_inertia(records, reason):
    log = log_of([0.0] * (records + 1), OFF, state=IDLE)
    log["time_us"] = 1000 * np.arange(records + 1)
    found = findings()
    with pytest.raises(IdentifyError, match=reason):
        shaft_of(found, still_fit(), log)


def test_only_maps_that_an_identification_has_written_are_removed(tmp_path):
    """Neither a file of the user whose name has a date, nor a map of a copy of the machine file."""
    out = tmp_path / "motor[1].toml"

    def table(content: str) -> Path:
        path = tmp_path / f"motor[1]_{hashlib.sha256(content.encode()).hexdigest()[:8]}.csv"
        path.write_text(content, encoding="utf-8")
        return path

    earlier, copied = table("of the first"), table("of the second")
    (tmp_path / "motor[1]_20261130.csv").write_text("of the user", encoding="utf-8")
    (tmp_path / "plate.toml").write_text(f'file = "{copied.name}"', encoding="utf-8")
    out.write_text(f'file = "{earlier.name}"', encoding="utf-8")
    assert _earlier_maps(out) == [earlier]
