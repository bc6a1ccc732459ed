"""The campaign's page and picture, and the longest reaction times in docs/reference/drive-faults.md.

    python -m salient.experiments.campaign.report

rewrites them from the results in tests/campaign, which the commands of the table have left.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from salient.experiments import fault_table, planted
from salient.experiments.campaign import branching, same_bits
from salient.experiments.campaign.runner import FAULTS
from salient.paths import REFERENCE, ROOT

PAGE = REFERENCE / "campaign.md"
PICTURE = ROOT / "docs" / "images" / "campaign.png"
RESULTS = ROOT / "tests" / "campaign"
_HEAD = """# Results of campaigns

Generated from `tests/campaign` and `tests/planted.json`; do not edit. The command is `python -m
salient.experiments.campaign.report`.

A row holds for the worlds and the rules of its commit. [Campaigns](../testing/campaigns.md) has the assumptions.

"""
_TAIL = """
![Longest time until the drive reacts to each fault](../images/campaign.png)
"""
_MODULE = "build/venv/bin/python -m salient.experiments.campaign"

Note = dict[str, Any]


def _note(name: str) -> Any:
    return json.loads((RESULTS / name).read_text(encoding="utf-8"))


def _seeds(note: Note) -> str:
    return f"{note['first']} to {note['first'] + note['seeds'] - 1}"


def _commits(notes: Iterable[Note]) -> str:
    return ", ".join(sorted({note["commit"] for note in notes}))


def _violations(note: Note) -> str:
    total = sum(entry["count"] for entry in note["violations"].values())
    listed = "; ".join(f"{entry['count']} `{name}`, seeds {', '.join(map(str, entry['seeds']))}"
                       for name, entry in note["violations"].items())
    known = sum(entry["count"] for entry in note.get("known_deviations", {}).values())  # a judge before had no list
    return (f"{total:,} violation{'' if total == 1 else 's'}" + (f" ({listed})" if listed else "")
            + (f", {known:,} known deviations" if known else ""))


def _rate(name: str) -> list[str]:
    """None of a summary whose worlds were not run in one go."""
    if not (RESULTS / name).exists():
        return []
    rate = _note(name)
    return [f"{rate['worlds'] / rate['processor_s']:.0f} worlds or {rate['virtual_s'] / rate['processor_s']:.0f} s of "
            "virtual time per CPU-second"]


def _worlds(name: str, what: str, sharding: str = "") -> tuple[str, str, str]:
    note = _note(f"{name}.json")
    parts = [f"seeds {_seeds(note)} at {note['commit']}", f"{note['virtual_hours']:.2f} h of virtual time",
             *_rate(f"{name}_rate.json"), f"**{_violations(note)}**"]
    if note["cells"]:
        all_reached = note["cells_reached"] == note["cells"]
        rest = "" if all_reached else f", the rest in `tests/campaign/{name}.json`"
        parts += [f"{note['cells_reached']:,} of {note['cells']:,} cells of fault, state and sector reached{rest}",
                  f"{note['held_by_the_encoder']} drives held at rest by their encoder"]
    kind = "" if note["kind"] == FAULTS else f" --{note['kind']}"
    return what, "; ".join(parts), f"`campaign{kind} --first {note['first']} --seeds {note['seeds']}{sharding}`"


def _branches() -> tuple[str, str, str]:
    rows, notes = branching.read(RESULTS / "branching"), branching.read_summary(RESULTS / "branching")
    of_all = branching.totals([row for lines in rows.values() for row in lines])
    processor_s = sum(note["processor_s"] for note in notes.values())
    longest = max((row for lines in rows.values() for row in lines), key=lambda row: int(row["longest_us"]))
    unanswered = sorted({branching.label(row) for lines in rows.values() for row in lines
                         if row["detected"] < row["branches"]})
    found = [row for lines in rows.values() for row in lines if row["violations"]]
    listed = "; ".join(sorted({f"`{branching.label(row)}`" for row in found}))
    return ("every fault at every control tick of an electrical period at 150 r/min with 8 N m and at 1500 r/min with "
            "6 N m, and at the beginning of a start from 360 positions",
            f"{of_all['branches']:,} branches at {_commits(notes.values())}; {of_all['virtual_s'] / 3600:.2f} h of "
            f"virtual time; {of_all['branches'] / processor_s:.0f} branches per CPU-second; longest reaction "
            f"{longest['longest_us'] / 1000:.0f} ms (`{branching.label(longest)}`), each in "
            f"[drive faults](drive-faults.md#{branching.ANCHOR}); not always answered: "
            f"{', '.join(f'`{label}`' for label in unanswered)}; **{of_all['violations']:,} violations**"
            + (f" ({listed})" if listed else ""), f"`{_MODULE}.branching DIR`")


def _planted() -> tuple[str, str, str]:
    note = json.loads(planted.SUMMARY.read_text(encoding="utf-8"))
    of = note["campaign"]
    least_s, middle_s, most_s = of["processor_s"]
    return ("planted bugs",
            f"**{of['found']} of {of['looked']} found** at {note['commit']} in {least_s:.1f} to {most_s:.1f} CPU-"
            f"seconds each, {middle_s:.1f} in the middle, by seeds from 1 to at most {of['last_seed']}; shrunk to at "
            f"most {of['events']} events in at most {of['shrinking_s']:.1f} CPU-seconds; {of['replayed']} "
            "replayed with equal bits, log and plots; the counts are in `tests/planted.json`",
            "`build/venv/bin/python -m salient.experiments.planted`")


def _cluster() -> tuple[str, str, str]:
    note = _note("cluster.json")
    return ("a Dask scheduler with two workers, one of them killed",
            f"seeds {_seeds(note)} at {note['commit']}, a worker killed after {note['killed_after']:,} results; the "
            "summary, with the digest of all results, " + ("equals" if note["equal"] else "**differs from**")
            + " one computer's byte for byte", f"`{_MODULE}.cluster DIR`")


def _bits() -> tuple[str, str, str]:
    note = _note(f"same_bits/{same_bits.SUMMARY}")
    good = note["seeds"] - len(note["different"])
    return ("equal bits", f"{good} of {note['seeds']} seeds at {note['commit']}: twice on the host, on the bench and "
            f"on {note['target']} in QEMU", f"`{_MODULE}.same_bits DIR`")


def table() -> str:
    """Markdown."""
    rows = [_worlds("faults", "worlds with faults, in one go"),
            _worlds("shards", "worlds with faults, in ten shards, interrupted and resumed", " --shard I/10"),
            _worlds("healthy", "healthy worlds"), _branches(), _planted(), _cluster(), _bits()]
    return "".join(f"| {' | '.join(row)} |\n" for row in [("", "measured", "command"), ("---",) * 3, *rows])


def page() -> str:
    """The page of the committed results."""
    return _HEAD + table() + _TAIL


def plot(path: Path) -> None:
    """Reaction times of the branches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 10), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    rows = branching.read(RESULTS / "branching")
    branching.draw(axes, rows)
    of_all = branching.totals([row for lines in rows.values() for row in lines])
    axes.set_title(f"{of_all['branches']:,} branches, {of_all['violations']:,} with a violation\n"
                   "salient, machine saturating, 40 kHz, sensors of 12 and 17 bits, phase a, default parameters",
                   fontsize="medium")
    figure.savefig(path, dpi=80)


def write_pages() -> None:
    """Writes the pages of the committed results."""
    PAGE.write_text(page(), encoding="utf-8")
    fault_table.PAGE.write_text(fault_table.with_branches(fault_table.PAGE.read_text(encoding="utf-8")),
                                encoding="utf-8")


def main() -> int:
    """Writes pages and picture; returns the exit code."""
    write_pages()
    plot(PICTURE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
