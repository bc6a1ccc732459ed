"""compare.json: the metrics of a comparison, for scripts and as a baseline of later comparisons.

    {"schema": 1,
     "quick": true when made with --quick, whose statistics are of fewer runs,
     "rows": [{"group", "condition", "figure", "statistic",         # these four identify a row; figure: the metric
               "values": {CONTROLLER: number or null},              # null: the event did not occur
               "failed": {CONTROLLER: why metrics are missing},
               "wanted": target, "wanted_of": its controller,       # null: no target
               "bound": theoretical limit,                          # null: none
               "printed": {CONTROLLER: published value or null},
               "reached": true or false}],                          # null: not judged
     "runs": [{"group", "condition", "controller", "sample", "figures": {FIGURE: number or null}, "failed"}],
     "traces": [{"condition", "controller", "time_s": [...], "torque_Nm": [...]}]}

Units are the suffixes of the metrics' names, ratios have none. Equal runs give equal bytes, independent of the number
of jobs.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, ValidationError

from salient.errors import UsageError
from salient.experiments.compare.runner import RunMetrics
from salient.experiments.compare.table import Row
from salient.experiments.results import rounded
from salient.toml_file import TextFileError, read_text

SCHEMA = 1
NAME = "compare.json"
_FILE_BYTES_MAX = 100_000_000


def content(rows: Sequence[Row], runs: Sequence[RunMetrics], quick: bool) -> dict[str, Any]:
    """The content of the file."""
    return {
        "schema": SCHEMA,
        "quick": quick,
        "rows": [_row(row) for row in rows],
        "runs": [{"group": run.case.group, "condition": run.case.condition, "controller": run.case.controller,
                  "sample": run.case.sample, "figures": run.metrics, "failed": run.failed} for run in runs],
        "traces": [{"condition": run.case.condition, "controller": run.case.controller,
                    "time_s": run.trace[0], "torque_Nm": run.trace[1]} for run in runs if run.trace],
    }


def _row(row: Row) -> dict[str, Any]:
    group, condition, metric, statistic = row.key
    target = row.target
    content: dict[str, Any] = rounded({
        "group": group, "condition": condition, "figure": metric, "statistic": statistic,
        "values": row.values, "failed": row.failed,
        "wanted": target.limit, "wanted_of": None if target.limit is None else target.controller,
        "bound": target.bound, "printed": target.published, "reached": row.reached,
    })  # fmt: skip
    return content


def write(path: Path, stored: Mapping[str, Any]) -> None:
    """Writes one line per row, run or trace, for readable diffs."""
    parts = []
    for key, value in stored.items():
        if isinstance(value, list):
            lines = ",\n  ".join(json.dumps(one, allow_nan=False) for one in value)
            parts.append(f' "{key}": [\n  {lines}]' if value else f' "{key}": []')
        else:
            parts.append(f' "{key}": {json.dumps(value)}')
    path.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="utf-8")


class _StoredRow(BaseModel):
    """The part of a row that a comparison reads."""

    group: str
    condition: str
    figure: str
    statistic: str
    values: dict[str, float | None]
    failed: dict[str, str]


class _Stored(BaseModel):
    """The part of a file that a comparison reads."""

    schema_number: Annotated[Literal[1], Field(alias="schema")]
    quick: bool
    rows: list[_StoredRow]


def read(path: Path, quick: bool) -> dict[str, Any]:
    """A baseline from its folder or file; UsageError when the file is invalid or its runs are not comparable."""
    file = path / NAME if path.is_dir() else path
    try:
        stored = _Stored.model_validate(json.loads(read_text(file, _FILE_BYTES_MAX)), strict=True)
    except TextFileError as error:
        raise UsageError(f"--baseline {file}: {error}") from None
    except ValidationError as error:
        place = ".".join(str(part) for part in error.errors()[0]["loc"])
        raise UsageError(f"--baseline {file}: not a {NAME} of schema {SCHEMA}{f': {place}' if place else ''}") from None
    except (ValueError, RecursionError):
        raise UsageError(f"--baseline {file}: not JSON; pass the folder or the {NAME} of an earlier run") from None
    if stored.quick != quick:
        raise UsageError(f"--baseline {file}: made {'without' if quick else 'with'} --quick; both runs must agree")
    return stored.model_dump()
