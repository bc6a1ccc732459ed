"""The finished runs of a comparison, in a file that an interrupted comparison continues from."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from salient.bench.load_profile import load_profile_path
from salient.bench.programs import executable, reference_executable
from salient.experiments import metrics as run_metrics
from salient.experiments.compare import every_machine, reference
from salient.experiments.compare import metrics as compare_metrics
from salient.experiments.compare.case import Case
from salient.experiments.compare.metrics import Metrics
from salient.experiments.tasks import file_digest
from salient.machine.cache import machine_image

NAME = "runs.jsonl"
METRICS_FILES = tuple(Path(str(module.__file__)) for module in (run_metrics, compare_metrics, every_machine, reference))


def programs_digest(case: Case) -> str:
    """Of the programs that the run of a case executes."""
    files = (executable(), *((reference_executable(),) if case.extractor == "every_machine" else ()))
    return hashlib.sha256(" ".join(map(file_digest, files)).encode()).hexdigest()


class FinishedRuns:
    """Results by run, which its description, the executable, the image of its machine, its load profile and the code of
    the metrics identify.

    The file has a line per run, [key, metrics, why it failed, trace], written as soon as the run has finished; a line
    that is cut off at the end is ignored.
    """

    def __init__(self, path: Path) -> None:
        self._results: dict[str, tuple[Metrics, str, Any]] = {}
        self._images: dict[str, Path] = {}
        self._path = path
        if not path.exists():
            return
        complete = [line for line in path.read_text(encoding="utf-8").splitlines(keepends=True) if line.endswith("\n")]
        path.write_text("".join(complete), encoding="utf-8")
        for line in complete:
            key, metrics, failed, trace = json.loads(line)
            self._results[key] = (metrics, failed, trace)

    def get(self, case: Case, description: str) -> tuple[Metrics, str, Any] | None:
        """The results of a run, None when it has not finished."""
        return self._results.get(self._key(case, description))

    def add(self, case: Case, description: str, metrics: Metrics, failed: str, trace: Any) -> None:
        """Appends a run to the file."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps([self._key(case, description), metrics, failed, trace], allow_nan=False) + "\n")

    def _key(self, case: Case, description: str) -> str:
        machine, profile = case.scenario.machine, case.scenario.load_profile
        if machine not in self._images:
            self._images[machine] = machine_image(machine)
        files = (executable(), self._images[machine], *METRICS_FILES,
                 *((reference_executable(),) if case.extractor == "every_machine" else ()),
                 *(() if profile is None else (load_profile_path(profile),)))
        return hashlib.sha256(" ".join([*map(file_digest, files), description]).encode()).hexdigest()
