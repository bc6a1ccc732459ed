"""Every fault at every control tick of an electrical period, at three operating points, by branching.

    python -m salient.experiments.campaign.branching DIR [EVERY]

forks the campaign's program before each control interrupt (each EVERY-th, default 1) of an electrical period at
150 r/min with load and at 1500 r/min, and at the beginning of a start from 360 positions of the rotor, and lets each
fault begin there (emulator/campaign/branch.h). Writes DIR/branches-POINT.jsonl and DIR/summary.json and prints a table.
An operating point whose results DIR has is not run again. Exit code 1 when a property is violated.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from salient.errors import exit_code
from salient.experiments.campaign import names
from salient.experiments.campaign.arguments import count
from salient.experiments.campaign.arguments import parser as parser_of
from salient.experiments.campaign.runner import branches, commit, processor_s

SALIENT = 2
POINTS = {"150": (SALIENT, 150, 8, 0, 2000), "1500": (SALIENT, 1500, 6, 0, 200), "start": (SALIENT, 0, 0, 0, 360)}
"""Controller, speed in r/min (0: starts), load in N m, first tick, ticks: an electrical period at 40 kHz."""
TITLES = {"150": "150 r/min, 8 N m", "1500": "1500 r/min, 6 N m", "start": "start to 150 r/min from 360 positions"}

SUMMARY = "summary.json"
HEADING = "Longest time, wherever a fault begins"
ANCHOR = "longest-time-wherever-a-fault-begins"
_INTRODUCTION = """\
Measured by [branching](../testing/campaigns.md#every-fault-at-every-control-tick): `salient` on the machine
`saturating`, 40 kHz, sensors of 12 and 17 bits, phase a.

- The fault begins at every control tick of an electrical period at two speeds, and at a start from 360 positions.
- A fault that was once answered late (100 ms) or never begins at every 50th tick and every tenth position only.
- A time is the longest from the start of the fault to the first cause. In parentheses: branches answered within 1 s,
  where not all were.
- A violation breaks one of the rules of [the checkers](checkers.md).
"""

Rows = dict[str, list[dict[str, Any]]]


def run(out: Path, every: int) -> Rows:
    """Results of each operating point, and in summary.json where they are from and what they took."""
    out.mkdir(parents=True, exist_ok=True)
    notes = read_summary(out)
    for point, setting in POINTS.items():
        file = out / f"branches-{point}.jsonl"
        if not file.exists():
            begin_s, of = processor_s(), commit()
            lines = branches(*setting, every)
            notes[point] = {"commit": of, "every": every, **totals(lines),
                            "processor_s": round(processor_s() - begin_s, 1)}
            file.write_text("".join(f"{json.dumps(line)}\n" for line in lines), encoding="utf-8")
            (out / SUMMARY).write_text(json.dumps(notes, indent=2) + "\n", encoding="utf-8")
    return read(out)


def read(out: Path) -> Rows:
    """The results of a folder, by operating point."""
    files = {point: out / f"branches-{point}.jsonl" for point in POINTS}
    return {point: [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
            for point, file in files.items()}


def read_summary(out: Path) -> dict[str, dict[str, Any]]:
    """By operating point; empty when the folder has none."""
    file = out / SUMMARY
    return dict(json.loads(file.read_text(encoding="utf-8"))) if file.exists() else {}


def totals(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Sums over the faults."""
    return {"faults": len(lines), "branches": sum(line["branches"] for line in lines),
            "virtual_s": round(sum(line["virtual_ms"] for line in lines) / 1000, 1),
            "violations": sum(line["violations"] for line in lines)}


def label(row: dict[str, Any]) -> str:
    """Fault, its leg where it has one, and the value of its attribute."""
    leg = f" {('low', 'high')[row['leg']]}" if row["fault"] in ("switch_open", "switch_shorted", "diode_open") else ""
    return f"{row['fault']}{leg}" + (f", {row['value']:g}" if row["value"] else "")


def cell(row: dict[str, Any]) -> str:
    """Longest time, detected of branches when not all are."""
    if row["detected"] == 0:
        return f"runs on ({row['branches']})"
    text = f"{row['longest_us'] / 1000:.3g} ms"
    return text if row["detected"] == row["branches"] else f"{text}, {row['detected']} of {row['branches']}"


def table(rows: Rows) -> list[str]:
    """Markdown: a line for each fault."""
    head = ["fault", "branches", *TITLES.values(), "first causes", "violations"]
    lines = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for of_fault in zip(*rows.values(), strict=True):
        causes = sorted({cause for row in of_fault for cause in row["causes"]})
        violations = sum(row["violations"] for row in of_fault)
        fields = [f"`{label(of_fault[0])}`", str(sum(row["branches"] for row in of_fault)), *map(cell, of_fault),
                  ", ".join(f"`{names.causes()[cause]}`" for cause in causes),
                  "" if violations == 0 else f"{violations}: {next(row['rule'] for row in of_fault if row['rule'])}"]
        lines.append(f"| {' | '.join(fields)} |")
    return lines


def section(rows: Rows) -> str:
    """Section of docs/reference/drive-faults.md."""
    return f"## {HEADING}\n\n{_INTRODUCTION}\n" + "".join(f"{line}\n" for line in table(rows))


def draw(axes: Any, rows: Rows) -> None:
    """Longest time to the reaction of each fault, on a logarithmic axis."""
    labels = [label(row) for row in next(iter(rows.values()))]
    for (point, lines), marker, colour in zip(rows.items(), "os^", ("#1f77b4", "#d62728", "#2ca02c"), strict=True):
        shown = [(index, max(row["longest_us"], 25) / 1000) for index, row in enumerate(lines) if row["detected"]]
        axes.plot([time for _, time in shown], [index for index, _ in shown], marker, color=colour, label=TITLES[point],
                  linestyle="none", markersize=5)
    axes.set_yticks(range(len(labels)), labels, fontsize="small")
    axes.set_ylim(len(labels) - 0.4, -0.6)
    axes.set_xscale("log")
    axes.set_xlim(left=0.0001)  # room for the legend
    axes.set_xlabel("longest time from the start of a fault until the drive has reacted, ms")
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", fontsize="x-small")


def main(arguments: list[str]) -> int:
    parser = parser_of("branching", __doc__)
    parser.add_argument("every", type=count, nargs="?", default=1, metavar="EVERY", help="interrupts (default 1)")
    options = parser.parse_args(arguments)
    out: Path = options.out
    rows = run(out, options.every)
    print("\n".join(table(rows)))
    of_all = totals([row for lines in rows.values() for row in lines])
    print(f"{of_all['branches']} branches, {of_all['virtual_s']:.0f} s of virtual time, "
          f"{sum(note['processor_s'] for note in read_summary(out).values()):.0f} processor s, "
          f"{of_all['violations']} with a violation")
    return 1 if of_all["violations"] else 0


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
