"""Every bit of the drive's memory flipped, one at a time, for each controller in four states.

    python -m salient.experiments.campaign.flips DIR [--stride N] [--seed S] [--shard I/N] [--jobs N] [--page FILE]

brings the drive into each state and flips each N-th bit of drive_t there (emulator/campaign/flips.h), from a first one
that the seed chooses, and with salient every bit of the members that decide whether it runs. Results go to DIR, where
an interrupted run goes on; DIR/summary.json has the counts, and the members in which a flip is not safe. --page writes
them as a page. Exit code 1 when a flip is unsafe.
"""

from __future__ import annotations

import json
import random
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from salient.cli import shard
from salient.drive_layout import Layout, layout_file
from salient.errors import UsageError, exit_code
from salient.experiments.campaign import names
from salient.experiments.campaign.arguments import count
from salient.experiments.campaign.arguments import parser as parser_of
from salient.experiments.campaign.runner import Result, commit, digest, flips
from salient.experiments.tasks import Task, check_build, run

CONTROLLERS = ("traditional", "paper", "salient")
STATES = ("ready", "armed", "run", "fault")
"""As flips_state_t."""
CLASSES = ("none", "within", "fault", "brief", "untrue", "stuck", "crash", "unsafe")
MEANINGS = {
    "none": "the course, with every frame and the true state, is that without a flip",
    "within": "another course, in which every rule is kept",
    "fault": "the drive has latched a fault, or keeps the one that it has",
    "brief": "likewise, within 10 ms, before which a rule of safety was broken",
    "untrue": "another course, in which telemetry tells what is not so",
    "stuck": "the drive does not do as commanded, or is reset by the watchdog; the switches are as they may be",
    "crash": "the program of the host has crashed or does not return: on a processor its fault handler or the watchdog",
    "unsafe": "a rule of safety is broken, and no fault within 10 ms",
}
SAFETY = {"over_current", "over_voltage", "over_speed", "gate_on", "no_command", "resumed", "cleared", "wrong_way",
          "overshoot", "above_limit", "torque_in_silence", "not_stopped", "wrong_torque", "misled", "reversed"}
"""Rules whose violation is a hazard: the checkers of that name (emulator/campaign/checkers), and that a drive which is
commanded forwards does not drive backwards."""
TELLING = {"wrong_status", "wrong_telemetry", "wrong_snapshot", "wrong_torque_telemetry", "wrong_current",
           "wrong_voltage", "wrong_temperature", "wrong_angle"}
NAMING = {"false_alarm", "wrong_cause", "not_first"}
"""Rules about the name of a fault: the fault of a flip has none among the bench's."""
REACTION_US = 10_000
"""Time for a fault after a change of memory, as fault_effects.c has it."""
RING = "sampler.ring"
DECIDING = ("command", "control.state_machine", "control.duty_q15", "comms.commands", "comms.command", "ramping")
"""Members that decide whether the drive runs, whatever its controller: every bit of them flips with one of them."""
PARTS = ("sample", "deciding")
CHUNK = 500
STRIDE = 97
_SALIENT = 2
_FAULT = 3
_LISTED = ("unsafe", "brief")
_ROWS_MAX = 40
"""Members that the page lists of a class."""


def classify(flip: Result, without: Result) -> str:
    """Class of a course with a flip; without: the course of the same world without one."""
    if flip["signal"]:
        return "crash"
    broken = hazards(flip, without)
    faulty = flip["state"] == _FAULT or flip["fault_us"]
    if broken:
        end_us = without["begin_us"] + REACTION_US
        begin_us = flip["fault_us"] or (0 if flip["state"] == _FAULT else end_us + 1)
        in_time = begin_us <= end_us and all(at_us <= end_us for _, at_us in broken)
        return "brief" if in_time else "unsafe"
    if faulty:
        return "fault"
    rules = {violation["rule"] for violation in flip["violations"]} - NAMING
    if flip["reset"] or rules - TELLING or flip["state"] != without["state"]:
        return "stuck"
    return "untrue" if rules else "within"


def hazards(flip: Result, without: Result) -> list[tuple[str, int]]:
    """Rules of safety that are broken, with their times in us."""
    broken = [(names.violation(violation), int(violation["at_us"])) for violation in flip["violations"]
              if violation["rule"] in SAFETY]
    backwards = flip["reversed"] and not without["reversed"]
    return broken + ([("reversed", int(flip["end_us"]))] if backwards else [])


def serve(task: tuple[str, int, int, int, int, int, str]) -> Result:
    """Counts of the classes of a chunk of bits, and its flips of other classes than none, within and fault. For worker
    processes."""
    part, controller, state, first, number, stride, expected = task
    check_build(digest(), expected)
    without, *changed = flips(controller, state, first, number, stride)
    if without["violations"] or without["signal"]:
        raise UsageError(f"{CONTROLLERS[controller]}, {STATES[state]}: the course without a flip breaks "
                         f"{without['violations']}")
    classes: Counter[str] = Counter()
    found = []
    for flip in changed:
        of = classify(flip, without)
        classes[of] += 1
        if of not in ("within", "fault"):
            rules = sorted({rule for rule, _ in hazards(flip, without)}) or sorted(
                {names.violation(violation) for violation in flip["violations"]})
            found.append({"bit": flip["bit"], "class": of, "rules": rules})
    flipped = min(number, len(range(first, without["bits"], stride)))
    classes["none"] = flipped - len(changed)
    causes = Counter(names.causes().get(flip["cause"], "unknown") for flip in changed if flip["state"] == _FAULT)
    return {"part": part, "controller": controller, "state": state, "bits": flipped, "classes": classes,
            "causes": causes, "found": found}


def sampled(layout: Layout, first: int, stride: int) -> tuple[range, range]:
    """Every stride-th bit from the first on, but for the ring of the recorder: half of the memory, which decides
    nothing."""
    ring = layout.bits(RING)
    return (range(first, ring.start, stride),
            range(ring.stop + (first - ring.stop) % stride, 8 * layout.size, stride))


def tasks(stride: int, seed: int, layout: Layout, controllers: Iterable[int] = range(len(CONTROLLERS))) -> list[Task]:
    """Chunks of the bits for each controller and state. UsageError: an even stride."""
    if stride % 2 == 0:
        raise UsageError(f"--stride {stride}: must be odd, to meet every bit of a word")
    made = []
    for controller in controllers:
        for state in range(len(STATES)):
            first = random.Random(f"{seed} {controller} {state}").randrange(stride)
            deciding = DECIDING if controller == _SALIENT else ()
            places = [*(("sample", bits) for bits in sampled(layout, first, stride)),
                      *(("deciding", layout.bits(member)) for member in deciding)]
            for part, bits in places:
                for begin in range(0, len(bits), CHUNK):
                    chunk = bits[begin: begin + CHUNK]
                    arguments = (part, controller, state, chunk.start, len(chunk), chunk.step, digest())
                    made.append(Task(" ".join(map(str, arguments)), arguments))
    return made


def summary(results: Iterable[Result], layout: Layout, stride: int, seed: int) -> dict[str, Any]:
    """Counts by part, controller and state, and by class the members with a flip of it, the most frequent one first."""
    classes: dict[str, dict[str, Counter[str]]] = {part: defaultdict(Counter) for part in PARTS}
    causes: Counter[str] = Counter()
    members: dict[str, Counter[str]] = defaultdict(Counter)
    for result in results:
        combination = f"{CONTROLLERS[result['controller']]}, {STATES[result['state']]}"
        classes[result["part"]][combination].update(result["classes"])
        causes.update(result["causes"])
        for flip in result["found"]:
            member = re.sub(r"\[\d+\]", "[]", layout.member(flip["bit"]))
            members[flip["class"]][f"{member}: {', '.join(flip['rules']) or combination}"] += 1
    every = [counts for found in classes.values() for counts in found.values()]
    return {"commit": commit(), "stride": stride, "seed": seed, "bits": 8 * layout.size - len(layout.bits(RING)),
            "flips": sum(counts.total() for counts in every), "unsafe": sum(counts["unsafe"] for counts in every),
            "classes": {part: {name: {of: counts[of] for of in CLASSES} for name, counts in sorted(found.items())}
                        for part, found in classes.items()},
            "causes": dict(causes.most_common()),
            "members": {of: dict(sorted(found.items(), key=lambda item: (-item[1], item[0])))
                        for of, found in sorted(members.items())}}


def table(counted: dict[str, dict[str, int]]) -> list[str]:
    """Markdown: a line for each controller and state, and their sum."""
    rows = {**counted, "all": {of: sum(counts[of] for counts in counted.values()) for of in CLASSES}}
    lines = [f"| controller, state | flips | {' | '.join(CLASSES)} |", f"|{' --- |' * (2 + len(CLASSES))}"]
    return lines + [f"| {name} | {sum(counts.values())} | {' | '.join(str(counts[of]) for of in CLASSES)} |"
                    for name, counts in rows.items()]


_HEAD = """# Flipped bits

Written by `python -m salient.experiments.campaign.flips DIR --page FILE`; do not edit.

- A bit of the drive's memory (`drive_t`, {bits:,} bits on the host without the ring of the recorder) flips between two
  control periods; of all members one in {stride}, seed {seed}, and with `salient` every bit of those that decide
  whether it runs. Commit {commit}.
- Machine `saturating`, 40 kHz. To the [checkers](checkers.md) nothing is disturbed, so that every rule holds.
- `ready`: not armed. A set of parameters, arming, a run under load and `off` follow.
- `armed`: for a run, at standstill. Likewise.
- `run`: at 30 % of the base speed under load. After 50 ms `off` follows.
- `fault`: its cause has gone. `off`, `clear_fault`, arming and a run follow.
"""


def page(note: dict[str, Any]) -> str:
    """The page of a summary."""
    parts = [_HEAD.format(**note), "## A sample of all members", "", *table(note["classes"]["sample"]), "",
             "## Every bit of the members that decide about a run", "",
             ", ".join(f"`{member}`" for member in DECIDING) + ".", "", *table(note["classes"]["deciding"]), "",
             "## Classes", "", "| class | meaning |", "| --- | --- |"]
    parts += [f"| {of} | {meaning} |" for of, meaning in MEANINGS.items()]
    if note["causes"]:
        parts += ["", "Flips that end in a fault, by its name: "
                  + ", ".join(f"`{cause}` {number}" for cause, number in note["causes"].items()) + "."]
    for of in _LISTED:
        found = list(note["members"].get(of, {}).items())
        if found:
            parts += ["", f"## Members, {of}", "", "| member | broken rule | flips |", "| --- | --- | --- |"]
            parts += [f"| `{member.partition(': ')[0]}` | {member.partition(': ')[2]} | {number} |"
                      for member, number in found[:_ROWS_MAX]]
        if len(found) > _ROWS_MAX:
            parts += ["", f"And {len(found) - _ROWS_MAX} more, in `DIR/summary.json`."]
    return "\n".join(parts) + "\n"


def main(arguments: list[str]) -> int:
    parser = parser_of("flips", __doc__)
    parser.add_argument("--stride", type=count, default=STRIDE, metavar="N",
                        help=f"every N-th bit, odd (default {STRIDE}; 1: all of them)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of the first bits (default 1)")
    parser.add_argument("--shard", type=shard, default=(1, 1), metavar="I/N",
                        help="every N-th chunk of bits, from the I-th on")
    parser.add_argument("--jobs", type=count, metavar="N", help="simultaneous runs (default: number of cores)")
    parser.add_argument("--page", type=Path, metavar="FILE", help="write the counts as a page")
    options = parser.parse_args(arguments)
    layout = Layout(layout_file())
    listed = tasks(options.stride, options.seed, layout)
    results = [result for _, result in run(listed, serve, options.out, options.shard, jobs=options.jobs)]
    note = summary(results, layout, options.stride, options.seed)
    (options.out / "summary.json").write_text(json.dumps(note, indent=2) + "\n", encoding="utf-8")
    for part in PARTS:
        print("\n".join([part, *table(note["classes"][part])]))
    for of in ("unsafe", "brief"):
        for member, number in note["members"].get(of, {}).items():
            print(f"{of}: {number} {member}")
    if options.page:
        options.page.write_text(page(note), encoding="utf-8")
    return 1 if note["members"].get("unsafe") else 0


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
