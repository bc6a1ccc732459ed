"""Variables of the drive's memory as the page of a tab has them (page/variables.js): names, places and units, and for
each machine their factors."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from salient.bench.a2l import is_short
from salient.bench.sampler import CHANNELS_MAX
from salient.bench.variables import SIGNALS, Quantity, Variables, short_names
from salient.config import WASM_BUILD


def variables_data() -> dict[str, Any]:
    """shared, rest: of each path the number of characters that it shares with the one before, and the others; step: of
    its address from that one; kind: its row of kinds, [bytes, signed, unit, names by value or null]; short: paths by
    short name; ring: address and words of the triggered buffer."""
    variables = Variables(WASM_BUILD)
    listed = _listed(variables)
    kinds = _kinds(listed)
    paths = [each.variable.path for each in listed]
    shared = [_shared(*pair) for pair in zip(["", *paths], paths, strict=False)]
    addresses = [each.variable.address for each in listed]
    ring = variables.layout.bits("sampler.ring")
    return {
        "shared": shared, "rest": "\n".join(path[count:] for path, count in zip(paths, shared, strict=True)),
        "step": [after - before for before, after in zip([0, *addresses], addresses, strict=False)],
        "kind": [list(kinds).index(_kind(each)) for each in listed],
        "kinds": [[size, signed, unit, short_names(dict(names)) or None] for size, signed, unit, _, names in kinds],
        "short": {name: path for name, path in SIGNALS.items() if path in variables.paths},
        "ring": [ring.start // 8, len(ring) // 32 - CHANNELS_MAX],
    }


def factors(machines: Iterable[str]) -> list[list[float]]:
    """For each machine the factors of the kinds of variables_data, by its exponents."""
    firsts = _kinds(_listed(Variables(WASM_BUILD))).values()
    of_machines = [_listed(Variables(WASM_BUILD, machine)) for machine in machines]
    return [[listed[first].factor for first in firsts] for listed in of_machines]


def _listed(variables: Variables) -> list[Quantity]:
    return [each for each in variables.quantities() if is_short(each.variable.path)]


def _shared(before: str, path: str) -> int:
    """Characters with which both begin."""
    pairs = enumerate(zip(before, path, strict=False))
    return next((at for at, (a, b) in pairs if a != b), min(len(before), len(path)))


def _kinds(quantities: Iterable[Quantity]) -> dict[tuple[Any, ...], int]:
    """Kinds, with the number of the first variable of each."""
    kinds: dict[tuple[Any, ...], int] = {}
    for number, each in enumerate(quantities):
        kinds.setdefault(_kind(each), number)
    return kinds


def _kind(quantity: Quantity) -> tuple[Any, ...]:
    """Factor in SI units: variables that differ in nothing have the same factor with any machine."""
    of = quantity.variable
    return of.bytes, of.is_signed, quantity.unit, quantity.factor, tuple(of.names.items())
