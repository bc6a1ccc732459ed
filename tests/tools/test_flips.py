"""Flipped bits in the drive's memory: what they do to it, and that the judge sees an unsafe one."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from salient.drive_layout import Layout, layout_file, pointers
from salient.errors import UsageError
from salient.experiments import planted
from salient.experiments.campaign import flips
from salient.experiments.campaign.runner import digest
from salient.experiments.campaign.runner import flips as run_flips

SAMPLE = 25
"""Flips of each controller in each state."""
WITHOUT = {"begin_us": 1000, "state": 1, "reversed": False, "signal": 0}
FLIP = {**WITHOUT, "end_us": 50_000, "fault_us": 0, "reset": False, "violations": []}
NOT_ARMED = {"rule": "no_command", "number": 1, "at_us": 1100}


@pytest.fixture(scope="module")
def layout() -> Layout:
    return Layout(layout_file())


def test_sample_is_every_nth_bit_outside_of_the_ring(layout: Layout) -> None:
    ring = layout.bits("sampler.ring")
    for first, stride in ((0, 1), (4, 193), (192, 193), (0, 7)):
        found = [bit for part in flips.sampled(layout, first, stride) for bit in part]
        assert found == [bit for bit in range(first, 8 * layout.size, stride) if bit not in ring]


@pytest.mark.parametrize(("change", "of"), [
    ({}, "within"),
    ({"signal": 11}, "crash"),
    ({"state": 3, "fault_us": 2000}, "fault"),
    ({"state": 2}, "stuck"),
    ({"reset": True}, "stuck"),
    ({"violations": [{"rule": "mute", "number": 0, "at_us": 9000}]}, "stuck"),
    ({"violations": [{"rule": "wrong_telemetry", "number": 9, "at_us": 9000}]}, "untrue"),
    ({"violations": [NOT_ARMED]}, "unsafe"),
    ({"violations": [NOT_ARMED], "state": 3, "fault_us": 2000}, "brief"),
    ({"violations": [NOT_ARMED], "state": 3, "fault_us": 12_000}, "unsafe"),
    ({"violations": [{**NOT_ARMED, "at_us": 12_000}], "state": 3, "fault_us": 2000}, "unsafe"),
    ({"reversed": True}, "unsafe"),
])
def test_a_course_is_classified_by_the_rules_that_it_breaks(change: dict[str, object], of: str) -> None:
    assert flips.classify({**FLIP, **change}, WITHOUT) == of


def test_members_have_their_names_and_every_bit_has_one(layout: Layout) -> None:
    assert layout.bits("control.state_machine").start > layout.bits("command").start
    assert layout.member(layout.bits("control.state_machine.state").start) == "control.state_machine.state"
    assert layout.member(layout.bits("control.duty_q15").start + 33) == "control.duty_q15[1]"
    assert all(layout.member(bit) for bit in range(0, 8 * layout.size, 7))
    with pytest.raises(UsageError, match="control.no_such: drive_t has no member 'no_such' there"):
        layout.bits("control.no_such")


def test_the_drive_stores_no_pointer_but_two_that_each_pass_writes_before_it_uses_them(layout: Layout) -> None:
    assert layout.pointers() == ["comms.xcp.memory", "comms.xcp.sampler"]  # xcp_attach()
    assert pointers({"bytes": 8, "members": [(0, 64, "a", {"bytes": 8, "pointer": True})]}) == ["a"]


def test_an_even_stride_is_refused(layout: Layout) -> None:
    with pytest.raises(UsageError, match="--stride 8: must be odd"):
        flips.tasks(8, 1, layout)


@pytest.mark.in_turns
@pytest.mark.parametrize("controller", flips.CONTROLLERS)
def test_no_flip_of_a_sample_is_unsafe(layout: Layout, controller: str) -> None:
    bits = 8 * layout.size - len(layout.bits(flips.RING))
    flipped = 0
    for task in flips.tasks(bits // SAMPLE | 1, 1, layout, [flips.CONTROLLERS.index(controller)]):
        if task.arguments[0] == "sample":
            result = flips.serve(task.arguments)
            assert result["bits"] == sum(result["classes"].values())
            assert [flip for flip in result["found"] if flip["class"] == "unsafe"] == []
            flipped += result["bits"]
    assert len(flips.STATES) * (SAMPLE - 1) <= flipped <= len(flips.STATES) * (SAMPLE + 1)


@pytest.mark.in_turns
@pytest.mark.parametrize("state", flips.STATES)
def test_a_run_begins_by_no_flip_of_what_arms_the_drive(layout: Layout, state: str) -> None:
    arming = layout.bits("comms.commands.arming")
    result = flips.serve(("deciding", 2, flips.STATES.index(state), arming.start, 72, 1, digest()))
    assert [flip for flip in result["found"] if flip["class"] in ("unsafe", "brief")] == []


@pytest.mark.in_turns
def test_the_judge_sees_that_a_latch_without_its_check_is_unsafe(layout: Layout, tmp_path: Path) -> None:
    bug = planted.Bug("the latch is not looked at", "firmware/drive/background_checks.c",
                      "self_test_latch_intact(&drive->control)", "true", ())
    programs = planted.campaign_programs(bug, tmp_path)
    bit = layout.bits("control.state_machine.state").start
    classes = []
    for of in (None, programs):
        without, flipped = run_flips(2, flips.STATES.index("fault"), bit, 1, 1, programs=of)
        classes.append(flips.classify(flipped, without))
    assert classes == ["brief", "unsafe"]


def test_the_page_has_the_counts_and_names_the_members(layout: Layout) -> None:
    member = layout.bits("comms.commands.arming.armed").start
    result = {"part": "sample", "controller": 2, "state": 0, "bits": 3, "classes": {"none": 2, "unsafe": 1},
              "causes": {}, "found": [{"bit": member, "class": "unsafe", "rules": ["no_command: not armed"]}]}
    note = flips.summary([json.loads(json.dumps(result))], layout, 97, 1)
    page = flips.page(note)
    assert "| salient, ready | 3 | 2 | 0 | 0 | 0 | 0 | 0 | 0 | 1 |" in page
    assert "| `comms.commands.arming.armed` | no_command: not armed | 1 |" in page
