"""The commands `campaign` and `replay`."""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import sys
from collections import defaultdict
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

from salient.dbc import PHASES
from salient.errors import UsageError
from salient.experiments import planted
from salient.experiments.campaign import known, names
from salient.experiments.campaign.failure import Failure, classes, load, replay, save
from salient.experiments.campaign.runner import (
    ALL_EVENTS,
    FAULTS,
    HEALTHY,
    MOTION,
    Result,
    commit,
    digest,
    processor_s,
    serve,
    world,
)
from salient.experiments.tasks import Task, read_results, run
from salient.paths import BUILD, make_folder
from salient.progress import Progress

_SHOWN_MAX = 8
"""Failures that are shrunk, one of each class, and seeds that a summary lists of a class."""
_LINES = 20
_WORLDS = {FAULTS: "worlds with faults", HEALTHY: "healthy worlds", MOTION: "worlds of positions"}


def run_campaign(options: argparse.Namespace) -> int:
    """`campaign`; returns the exit code."""
    seeds = range(options.first, options.first + options.seeds)
    kind = options.kind
    tasks = [Task(f"{kind} {seed} {digest()}", (seed, kind, digest())) for seed in seeds]
    mine = tasks[options.shard[0] - 1::options.shard[1]]
    results: list[Result] = []
    new: list[Result] = []
    earlier, begin_s = read_results(options.out).keys(), processor_s()
    with Progress(_LINES, sys.stderr, len(mine)) as progress:
        done = run(tasks, serve, options.out, options.shard, options.scheduler, options.jobs)
        for number, (task, result) in enumerate(done, start=1):
            results.append(result)
            new += [] if task.key in earlier else [result]
            progress.item(f"{number} of {len(mine)} seeds")
    note = summary(results, options.first, options.seeds, kind)
    spent_s = processor_s() - begin_s
    part = "" if options.shard == (1, 1) else "-{}-of-{}".format(*options.shard)
    (options.out / f"summary{part}.json").write_text(json.dumps(note, indent=2) + "\n", encoding="utf-8")
    for line in report(note):
        print(line)
    if new and options.scheduler is None:
        rate = {"kind": kind, "commit": note["commit"], "worlds": len(new), "virtual_s": round(_virtual_s(new), 1),
                "processor_s": round(spent_s, 1)}
        (options.out / f"rate{part}.json").write_text(json.dumps(rate, indent=2) + "\n", encoding="utf-8")
        print(f"{rate['worlds'] / spent_s:.0f} worlds, {rate['virtual_s'] / spent_s:.1f} s of virtual time a processor "
              "second")
    saved_seeds: set[int] = set()
    for violation, entry in list(note["violations"].items())[:0 if options.no_shrink else _SHOWN_MAX]:
        seed = entry["seeds"][0]
        folder = options.out / "failures" / _folder_name(seed, violation, saved_seeds)
        saved_seeds.add(seed)
        saved = save(seed, violation, folder, kind)
        events = ", ".join(f"{event['event']} at {event['begin_us']} us" for event in saved["world"]["events"])
        print(f"{violation}: seed {seed} needs {len(saved['world']['events'])} events ({events or 'none'}); "
              f"{saved['replay']}")
    return 1 if note["violations"] else 0


def _folder_name(seed: int, violation: str, saved_seeds: Collection[int]) -> str:
    """SEED; for the further classes of a seed SEED-CLASS."""
    return f"{seed}-{re.sub('[^a-z0-9_]+', '-', violation.lower())}" if seed in saved_seeds else f"{seed}"


def summary(results: Iterable[Result], first: int, seeds: int, kind: str) -> dict[str, Any]:
    """Totals of the results of a range of seeds."""
    found: dict[str, list[int]] = defaultdict(list)
    deviations: dict[str, list[int]] = defaultdict(list)
    gone: list[str] = []
    cells: set[int] = set()
    content = hashlib.sha256()
    virtual_us = finished = recovered = held = rejected = 0
    for result in sorted(results, key=lambda result: int(result["seed"])):
        content.update(f"{json.dumps(result, sort_keys=True)}\n".encode())
        finished += 1
        virtual_us += result.get("virtual_us", 0)
        recovered += result.get("recovered", False)
        held += result.get("held", False)
        rejected += result.get("rejected", False)
        cells.update(result.get("cells", ()))
        classes = {names.violation(violation) for violation in result.get("violations", ())}
        listed = known.of_world(int(result["seed"]), kind)
        for violation in classes:
            (deviations if violation in listed else found)[violation].append(result["seed"])
        gone += [f"{result['seed']} {violation}" for violation in sorted(listed - classes)]
    missing = [] if kind != FAULTS else [cell for cell in names.cells() if cell not in cells]
    return {
        "kind": kind, "first": first, "seeds": seeds, "finished": finished, "commit": commit(),
        "program_and_machines": digest(), "results_sha256": content.hexdigest(),
        "virtual_hours": round(virtual_us / 3.6e9, 4), "rejected": rejected,
        "recovered": recovered, "held_by_the_encoder": held,
        "violations": _by_number(found), "known_deviations": _by_number(deviations), "known_and_gone": gone,
        "cells_reached": len(cells), "cells": 0 if kind != FAULTS else len(names.cells()),
        "cells_not_reached": [names.cell(cell) for cell in missing],
    }


def _by_number(found: dict[str, list[int]]) -> dict[str, Any]:
    """Count and first seeds of each class, the most frequent one first."""
    by_number = sorted(found.items(), key=lambda item: (-len(item[1]), item[0]))
    return {name: {"count": len(seeds), "seeds": seeds[:_SHOWN_MAX]} for name, seeds in by_number}


def _virtual_s(results: list[Result]) -> float:
    return 1e-6 * sum(int(result.get("virtual_us", 0)) for result in results)


def report(note: dict[str, Any]) -> list[str]:
    """A summary to be read."""
    number, deviations = (sum(entry["count"] for entry in note[of].values())
                          for of in ("violations", "known_deviations"))
    lines = [f"{note['finished']} {_WORLDS[note['kind']]} "
             f"from seed {note['first']}, {note['virtual_hours']:g} h of virtual time, commit {note['commit']}: "
             f"{number} violations, {deviations} known deviations"]
    lines += [f"  {kind}{name}: {entry['count']}, first seeds {', '.join(map(str, entry['seeds']))}"
              for of, kind in (("violations", ""), ("known_deviations", "known: ")) for name, entry in note[of].items()]
    lines += [f"  no longer a deviation, to be removed from {known.FILE.name}: seed {each}"
              for each in note["known_and_gone"]]
    if note["cells"]:
        lines.append(f"cells of fault, state and sector: {note['cells_reached']} of {note['cells']} reached")
        left = note["cells_not_reached"]
        lines += [f"  not reached: {cell}" for cell in left[:_SHOWN_MAX]]
        if len(left) > _SHOWN_MAX:
            lines.append(f"  and {len(left) - _SHOWN_MAX} more, in summary.json")
    return lines


def run_replay(options: argparse.Namespace) -> int:
    """`replay`; returns the exit code."""
    folder = Path(options.what)
    if folder.is_dir():
        failure = load(folder)
    else:
        try:
            failure = Failure(int(options.what), ALL_EVENTS, options.kind, None)
        except ValueError:
            failure = Failure(-1, ALL_EVENTS, options.kind, None)
        if not 0 <= failure.seed < 2**63:
            raise UsageError(f"replay {options.what}: must be a seed, a whole number from 0, or the folder of a "
                             "failure")
        folder = options.out / str(failure.seed)
    seed, kept, kind = failure.seed, failure.kept, failure.kind
    programs = None
    if failure.bug is not None:
        if options.build != "host":
            raise UsageError(f"--target {options.build}: {folder} has a planted bug, which the host alone can have")
        programs = planted.campaign_programs(planted.named(failure.bug), BUILD / "campaign" / "planted")
        print(f"with the planted bug '{failure.bug}'")
    make_folder(folder)
    described = world(seed, kept, kind)
    print(f"seed {seed}: {described['machine']}, {described['controller']}, {described['control_rate_hz']} Hz, encoder "
          f"of {described['encoder_bits']} bits{' with edges' if described['encoder_edges'] else ''}")
    for event in described["events"]:
        until = f" to {event['end_us']}" if event["end_us"] else ""
        print(f"  {event['begin_us']}{until} us: {event['event']} {event['value']:g}"
              + (f", phase {PHASES[event['phase']]}, leg {('low', 'high')[event['leg']]}"
                 if event["phase"] or event["leg"] else ""))
    again = replay(seed, kept, kind, folder, options.build, programs)
    whole = kept == ALL_EVENTS and failure.bug is None
    listed = known.of_world(seed, kind) if whole else set()
    for violation in again.campaign["violations"]:
        word = "known deviation" if names.violation(violation) in listed else "violation"
        print(f"{word}: {names.violation(violation)} at {violation['at_us']} us")
    causes = ", ".join(names.causes().get(cause, str(cause)) for cause in again.campaign.get("causes", []))
    print(f"first causes: {causes or 'none'}")
    result = f"hash {again.hash}" if again.hash else "the emulator crashed"
    print(f"{result}, {'equal to' if again.equal else 'NOT equal to'} the campaign's; log and plot: {folder}")
    return 0 if again.equal and set(classes(again.campaign)) <= listed else 1

