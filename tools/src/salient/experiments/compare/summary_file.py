"""summary.toml: how many runs of each condition failed, and of which commit; small enough to be committed.

    command = "tools/salient compare robustness"
    commit = "0123abc"                  # git describe --always --dirty; "unknown" outside of a repository
    [[study]]                           # one per condition and controller
    group = "robustness"
    condition = "random drives"
    controller = "salient"
    first = "drive 000"                 # the samples
    last = "drive 499"
    runs = 500
    failed = 1
    failures = ["drive 017: fault over_current"]
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from salient.experiments.compare.runner import RunMetrics
from salient.paths import IS_WHEEL, ROOT
from salient.version import VERSION

NAME = "summary.toml"


def write(path: Path, runs: Sequence[RunMetrics], command: str) -> None:
    """Writes the summary of `runs`. Strings of JSON are strings of TOML."""
    lines = [f"command = {json.dumps(command)}", f"commit = {json.dumps(_commit())}"]
    ordered = sorted(runs, key=_study)
    for (group, condition, controller), of in groupby(ordered, key=_study):
        study = list(of)
        failed = [f"{run.case.sample}: {run.failed}".removeprefix(": ") for run in study if run.failed]
        lines += ["", "[[study]]",
                  *(f"{key} = {json.dumps(value)}" for key, value in (
                      ("group", group), ("condition", condition), ("controller", controller),
                      ("first", study[0].case.sample), ("last", study[-1].case.sample), ("runs", len(study)),
                      ("failed", len(failed)), ("failures", failed)))]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _study(run: RunMetrics) -> tuple[str, str, str]:
    return run.case.group, run.case.condition, run.case.controller


def _commit() -> str:
    if IS_WHEEL:
        return f"version {VERSION}"
    described = subprocess.run(["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--exclude", "*"],
                               capture_output=True, text=True, check=False)
    return described.stdout.strip() or "unknown"
