"""Arming by a client, with a drive made of its telemetry."""

from __future__ import annotations

import can
import pytest

from salient.bench.arming import ATTEMPTS, ArmingSequence, response_to
from salient.bench.drive import Drive
from salient.bus.signals import SignalTable, drive_database

MS = 1_000_000
STATUS_PERIOD_MS = 4  # of the drive's time
CHALLENGE = 0x12345678


class DriveOfTelemetry:
    """A session in which a drive answers a request to arm after `answer_ms` of its time, and confirms likewise; its
    time passes `slowness` times as slowly as the session's. None: it never answers."""

    def __init__(self, answer_ms: int | None, slowness: int = 1, switched_on_ms: int = 0) -> None:
        self.drive_database = drive_database()
        self.telemetry = SignalTable(self.drive_database, "DRIVE")
        self.time_ns = 0
        self.steps: list[tuple[float, str]] = []
        self._answer_ms, self._slowness, self._switched_on_ms = answer_ms, slowness, switched_on_ms
        self._due: list[tuple[float, dict[str, int]]] = []

    def require_drive_database(self) -> None:
        pass

    def send(self, message: can.Message) -> None:
        arm = self.drive_database.get_message_by_name("DRIVE_ARM")
        if message.arbitration_id != arm.frame_id:  # a command
            return
        values = arm.decode_simple(bytes(message.data))
        now_ms = self.time_ns / MS
        self.steps.append((now_ms, str(values["step"])))
        if self._answer_ms is None or now_ms < self._switched_on_ms:
            return
        report = {"challenge": CHALLENGE + len(self.steps), "attempt": ATTEMPTS["run"], "armed": 0}
        if values["step"] == "confirm_run":
            expected = [due["challenge"] for _, due in self._due][-1:]
            report |= {"attempt": 0, "armed": int([values["response"]] == [response_to(c) for c in expected])}
        self._due.append((now_ms + self._answer_ms * self._slowness, report))

    def pass_time(self, client: ArmingSequence | Drive, until_ms: int) -> None:
        for now_ms in range(self.time_ns // MS + 1, until_ms + 1):
            self.time_ns = now_ms * MS
            if now_ms >= self._switched_on_ms and now_ms % (STATUS_PERIOD_MS * self._slowness) == 0:
                self._report("DRIVE_STATUS", {})
            for due_ms, values in self._due:
                if due_ms == now_ms:
                    self._report("DRIVE_ARMING", values)
            if isinstance(client, Drive):
                client.send_due()
            elif not (client.armed or client.given_up) and client.due_ns <= self.time_ns:
                client.step()

    def _report(self, name: str, values: dict[str, int]) -> None:
        message = self.drive_database.get_message_by_name(name)
        data = message.encode({signal.name: values.get(signal.name, 0) for signal in message.signals})
        self.telemetry.add(self.time_ns, can.Message(arbitration_id=message.frame_id, is_extended_id=False, data=data))


@pytest.mark.parametrize(("answer_ms", "slowness"), [(1, 1), (9, 100), (240, 1)])
def test_a_drive_in_slow_motion_is_armed_by_one_request(answer_ms, slowness):
    drive = DriveOfTelemetry(answer_ms, slowness)
    sequence = ArmingSequence(drive, 0)
    drive.pass_time(sequence, 2 * answer_ms * slowness + 10)
    assert sequence.armed and not sequence.given_up
    assert [step for _, step in drive.steps] == ["request_run", "confirm_run"]


def test_a_drive_that_takes_no_request_has_four_of_them_half_a_second_apart():
    drive = DriveOfTelemetry(None)
    sequence = ArmingSequence(drive, 0)
    drive.pass_time(sequence, 10_000)
    assert sequence.given_up and not sequence.armed
    assert [step for _, step in drive.steps] == ["request_run"] * 4
    assert [time_ms for time_ms, _ in drive.steps] == pytest.approx([0, 500, 1000, 1500], abs=3 * STATUS_PERIOD_MS)


def test_a_drive_that_is_switched_on_after_two_seconds_of_silence_is_not_armed():
    drive = DriveOfTelemetry(1, switched_on_ms=2_001)
    sequence = ArmingSequence(drive, 0)
    drive.pass_time(sequence, 10_000)
    assert sequence.given_up and not sequence.armed
    assert [step for _, step in drive.steps] == ["request_run"]


def test_a_refused_response_is_followed_by_another_request_at_once():
    drive = DriveOfTelemetry(5)
    sequence = ArmingSequence(drive, 0)
    drive.pass_time(sequence, 6)
    drive._due[-1][1]["armed"] = 0
    drive.pass_time(sequence, 40)
    assert sequence.armed
    assert [step for _, step in drive.steps] == ["request_run", "confirm_run", "request_run", "confirm_run"]


def test_a_drive_that_is_not_armed_says_so_until_the_next_request():
    on_bus = DriveOfTelemetry(None)
    drive = Drive(on_bus)
    drive.speed_reference_rpm = 150
    on_bus.pass_time(drive, 1_900)
    assert not drive.hindrance
    on_bus.pass_time(drive, 2_100)
    assert drive.hindrance == "not armed: the requests to arm were refused or had no answer"
    drive.speed_reference_rpm = 150
    assert not drive.hindrance
