"""compare.json: what a comparison measured, for scripts and for later comparisons.

    {"schema": 1,
     "quick": whether it was made with --quick, whose statistics are of fewer runs,
     "rows": [{"group", "condition", "figure", "statistic",         # what it is; the four name a row
               "values": {CONTROLLER: number or null},              # null: never came about
               "failed": {CONTROLLER: why figures are missing},
               "wanted", "wanted_of", "bound", "printed": {CONTROLLER: number or null}, "reached"}],  # null: none
     "runs": [{"group", "condition", "controller", "sample", "figures": {FIGURE: number or null}, "failed"}],
     "traces": [{"condition", "controller", "time_s": [...], "torque_Nm": [...]}]}

Figures are in the units that end their names, ratios without one. Equal drives give equal bytes, whatever the number of
jobs.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from salient.errors import UsageError
from salient.experiments.compare.runner import Outcome
from salient.experiments.compare.table import Row
from salient.experiments.results import rounded

SCHEMA = 1
NAME = "compare.json"


def content(rows: Sequence[Row], outcomes: Sequence[Outcome], quick: bool) -> dict[str, Any]:
    """What the file holds."""
    return {
        "schema": SCHEMA,
        "quick": quick,
        "rows": [_row(row) for row in rows],
        "runs": [{"group": outcome.case.group, "condition": outcome.case.condition,
                  "controller": outcome.case.controller, "sample": outcome.case.sample, "figures": outcome.figures,
                  "failed": outcome.failed} for outcome in outcomes],
        "traces": [{"condition": outcome.case.condition, "controller": outcome.case.controller,
                    "time_s": outcome.trace[0], "torque_Nm": outcome.trace[1]}
                   for outcome in outcomes if outcome.trace],
    }


def _row(row: Row) -> dict[str, Any]:
    group, condition, figure, statistic = row.key
    target = row.target
    return rounded({
        "group": group, "condition": condition, "figure": figure, "statistic": statistic,
        "values": row.values, "failed": row.failed,
        "wanted": target.wanted, "wanted_of": None if target.wanted is None else target.controller,
        "bound": target.bound, "printed": target.printed, "reached": row.reached,
    })  # fmt: skip


def write(path: Path, stored: Mapping[str, Any]) -> None:
    """One line a row, run or trace, so that a difference can be read."""
    parts = []
    for key, value in stored.items():
        if isinstance(value, list):
            lines = ",\n  ".join(json.dumps(one, allow_nan=False) for one in value)
            parts.append(f' "{key}": [\n  {lines}]' if value else f' "{key}": []')
        else:
            parts.append(f' "{key}": {json.dumps(value)}')
    path.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")


def read(path: Path, quick: bool) -> dict[str, Any]:
    """An earlier run, from its folder or file; UsageError when it is none, or one of other runs."""
    file = path / NAME if path.is_dir() else path
    try:
        stored = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"--baseline {file}: {error.strerror}") from None
    except ValueError:
        raise UsageError(f"--baseline {file}: no JSON; give the folder or the {NAME} of an earlier run") from None
    if not isinstance(stored, dict) or stored.get("schema") != SCHEMA or not isinstance(stored.get("rows"), list):
        raise UsageError(f"--baseline {file}: no {NAME} of schema {SCHEMA}")
    if stored.get("quick") != quick:
        raise UsageError(f"--baseline {file}: made {'with' if not quick else 'without'} --quick, unlike this run")
    return stored
