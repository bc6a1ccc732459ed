"""Settings of a scenario by name: parameters of the drive and variables of the test bench, as `--set` has them."""

from __future__ import annotations

import math

from salient.bench.rig import bench_variables, variable_range
from salient.errors import UsageError, close_names
from salient.machine.parameter_table import read_table

COUNT_MAX = 10_000


def parse_values(text: str) -> tuple[str, list[float]]:
    """NAME=VALUE, NAME=VALUE,VALUE,... or NAME=FIRST:LAST:COUNT, evenly spaced. UsageError names the option."""
    name, equals, values = text.partition("=")
    problem = f"--set {text}: must be NAME=VALUE[,VALUE...] or NAME=FIRST:LAST:COUNT"
    if not equals:
        raise UsageError(problem)
    check_name(name, text)
    try:
        if ":" in values:
            first, last, count = values.split(":")
            numbers = _spaced(float(first), float(last), int(count))
        else:
            numbers = [float(value) for value in values.split(",")]
    except ValueError:
        raise UsageError(problem) from None
    if not all(map(math.isfinite, numbers)) or len(set(numbers)) != len(numbers):
        raise UsageError(f"{problem}, finite and different")
    if name in bench_variables():
        low, high = variable_range(name)
        for number in numbers:
            if not low <= number <= high:
                raise UsageError(f"--set {text}: {number:g}: must be a number from {low:g} to {high:g}")
    return name, numbers


def _spaced(first: float, last: float, count: int) -> list[float]:
    if not 2 <= count <= COUNT_MAX:
        raise ValueError(count)
    return [float(f"{first + (last - first) * n / (count - 1):.12g}") for n in range(count)]


def check_name(name: str, text: str) -> None:
    """UsageError for a name that neither a parameter nor a variable of the bench has."""
    parameters = [row.name for row in read_table()]
    if name not in parameters and name not in bench_variables():
        raise UsageError(f"--set {text}: {name}: neither a parameter of the drive nor a variable of the test "
                         f"bench; {close_names(name, [*parameters, *bench_variables()])}")
