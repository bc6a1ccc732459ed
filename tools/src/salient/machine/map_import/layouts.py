"""Makes points of the blocks of a text: long tables, matrices, columns by current as field solvers export them, blocks
by current and by phase."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from salient.machine.flux_map import FluxMapError
from salient.machine.map_import.columns import Column, column, condition
from salient.machine.map_import.text import Block, Row, number

_TITLE_MAX = 60
"""Characters of a title that is a quantity, not a description."""


@dataclass
class Points:
    """Points as a file has them, and what it says about their units."""

    rows: list[tuple[int, int, float, float, float]] = field(default_factory=list)
    """Line, phase, angle, current in A and flux linkage in Wb (both as stated where no unit is)."""
    angle_unit: str | None = None
    current_stated: bool = True
    flux_stated: bool = True
    layout: str = ""
    left_out: int = 0
    """Tables of other quantities."""

    def add(self, line: int, phase: int, angle: float, current: float, flux: float) -> None:
        if math.isfinite(angle) and math.isfinite(current) and math.isfinite(flux):
            self.rows.append((line, phase, angle, current, flux))

    def value(self, flux: Column | None, current_A: float, value: float) -> float:
        """The flux linkage of a value in a column, with the factor of `units`: an inductance is that by the current."""
        if flux is None or flux.role != "inductance":
            return value
        if "inductance" not in self.layout:
            self.layout += ", inductance times current"
        return value * current_A

    def units(self, angle: Column | None, current: Column | None, flux: Column | None) -> tuple[float, float]:
        """Notes the units, and returns the factors of current and flux linkage."""
        if angle is not None and angle.unit is not None:
            self.angle_unit = angle.unit
        self.current_stated &= current is not None and current.factor is not None
        self.flux_stated &= flux is not None and flux.factor is not None and (
            flux.role != "inductance" or self.current_stated)
        return (current and current.factor) or 1.0, (flux and flux.factor) or 1.0


def points_of(found: Sequence[Block]) -> Points:
    """The points of all blocks. FluxMapError."""
    points = Points()
    joined = _joined(found)
    blocks = _of_flux(joined)
    points.left_out = len(joined) - len(blocks)
    named: dict[str, int] = {}
    for at, block in enumerate(blocks):
        phase = _phase(block, named)
        if phase is None:
            phase = max((row[1] for row in points.rows), default=-1) + 1 if _repeats(points, block, at) else 0
        _add_block(points, block, phase)
    if not points.rows:
        raise FluxMapError("no table of angle, current and flux linkage found")
    return points


def _of_flux(blocks: Sequence[Block]) -> list[Block]:
    """The blocks without the ones of other quantities. FluxMapError: there is no other."""
    kept = [block for block in blocks if (of := _quantity(block)) is None or of.role != "other"]
    if blocks and not kept:
        raise FluxMapError(f"line {blocks[0].rows[0].line}: {blocks[0].titles[-1]!r:.60} above it: no flux linkage or"
                           " inductance")
    fluxes = [block for block in kept if (of := _quantity(block)) is not None and of.role == "flux"]
    return [block for block in kept if not fluxes or (of := _quantity(block)) is None or of.role == "flux"]


def _quantity(block: Block) -> Column | None:
    """The quantity that the corner of a matrix, or else the last title of a block without named columns states."""
    if sum(number(cell) is None for cell in block.header) > 1:
        return None
    corner = block.header[0] if block.header and number(block.header[0]) is None else ""
    titles = [title for title in block.titles if len(title) < _TITLE_MAX and (
        not block.header or title.split(",")[0] != block.header[0])]
    for text in (corner, *reversed(titles)):
        for part in re.split(r"[\\|;,]|(?<=[\])])\s", text):
            of = column(part) if part.strip() else None
            if of is not None and of.role in ("flux", "inductance", "other"):
                return of
    return None


def _joined(found: Sequence[Block]) -> list[Block]:
    """Blocks without a head of their own that continue the one before (a blank line between angles)."""
    joined: list[Block] = []
    for block in found:
        if joined and not block.titles and len(block.rows[0].cells) == len(joined[-1].rows[-1].cells) and (
                (joined[-1].header and not _is_matrix_head(joined[-1])) or len(block.rows[0].cells) <= 3):
            pair = {row.values[:2] for row in joined[-1].rows}
            if not any(row.values[:2] in pair for row in block.rows):
                joined[-1].rows.extend(block.rows)
                continue
        joined.append(Block(list(block.titles), block.header, list(block.rows)))
    return joined


def _is_matrix_head(block: Block) -> bool:
    values = [number(cell) for cell in block.header[1:]]
    return len(values) > 2 and all(value is not None for value in values)


def _phase(block: Block, named: dict[str, int]) -> int | None:
    """The phase that the titles of a block name."""
    for title in block.titles:
        found = re.search(r"\b(?:phase|winding|strang|coil)\s*[_:=#-]?\s*([A-Fa-f1-6])\b", title)
        if found and len(re.findall(r"(?:phase|winding|strang|coil)", title, re.IGNORECASE)) == 1:
            return named.setdefault(found[1].lower(), len(named))
        found = re.search(r"(?i)\bphase\s*[_:=#-]?\s*([a-f1-6])\b", title)
        if found and len(re.findall(r"(?i)phase", title)) == 1:
            return named.setdefault(found[1].lower(), len(named))
    return None


def _repeats(points: Points, block: Block, at: int) -> bool:
    if at == 0:
        return False
    trial = Points()
    _add_block(trial, block, 0)
    known = {(angle, current) for _, _, angle, current, _ in points.rows}
    return sum((angle, current) in known for _, _, angle, current, _ in trial.rows) > 0.5 * len(trial.rows)


def _add_block(points: Points, block: Block, phase: int) -> None:
    columns = [column(cell) for cell in block.header]
    width = max(len(row.cells) for row in block.rows)
    roles = [meaning.role if meaning else None for meaning in columns]
    conditions = [condition(cell) if re.search(r"\d", cell) else None for cell in block.header]
    stated = next((found for title in block.titles if (found := condition(title)) and len(title) < _TITLE_MAX and (
        not block.header or title != " ".join(block.header) or len(re.findall(r"\d[\d.,eE+-]*", title)) == 1)), None)
    if len(columns) == width and {"angle", "current"} <= set(roles) and {"flux", "inductance"} & set(roles):
        _long(points, block, columns, phase)
    elif len(columns) == width and {"angle", "current", "other"} <= set(roles):
        raise FluxMapError(f"line {block.rows[0].line}: the columns {', '.join(block.header)!r:.80} have no flux"
                           " linkage or inductance")
    elif len(columns) == width and sum(of is not None for of in conditions) >= 3:
        _by_condition(points, block, columns, conditions, phase)
    elif len(block.header) in (width, width - 1) and _is_matrix_head(block):
        _matrix_with_head(points, block, phase)
    elif stated is not None and width == 2:
        _one_curve(points, block, columns, stated, phase)
    elif len(block.header) == width > 4 and (numbered := _numbered(block.header)):
        _matrix_with_head(points, Block(block.titles, numbered, block.rows), phase)
    elif len(block.header) == width > 4 and sum(number(cell) is None for cell in block.header) > 2:
        raise FluxMapError(f"line {block.rows[0].line}: the header above it, {', '.join(block.header)!r:.80}, does not"
                           " name an angle, a current and a flux linkage, nor a current or an angle of each column, as"
                           " 'I=5A'")
    elif width > 4 or _rows_of_grid(block):
        _bare_matrix(points, block, phase)
    elif width in (3, 4):
        _bare_long(points, block, phase)
    else:
        raise FluxMapError(f"line {block.rows[0].line}: {width} columns: neither a table of angle, current and flux"
                           " linkage nor a matrix")


def _numbered(header: Sequence[str]) -> tuple[str, ...]:
    """A header of columns that differ in a number alone, as psi(2.5) or Flux_5, as one of numbers; empty for another
    one, and where the numbers may just count the columns."""
    cells = [re.fullmatch(r"(.*?)[ _(\[]*([+-]?\d+(?:[.,]\d+)?)[\])]*", cell) for cell in header[1:]]
    if not all(cells) or len({cell[1] for cell in cells if cell}) != 1:
        return ()
    texts = [cell[2] for cell in cells if cell]
    steps = {round(b - a, 9) for a, b in pairwise(number(text) or 0.0 for text in texts)}
    is_axis = all(step > 0.0 for step in steps) or all(step < 0.0 for step in steps)
    return (header[0], *texts) if is_axis and steps != {1.0} else ()


def _long(points: Points, block: Block, columns: Sequence[Column | None], phase: int) -> None:
    points.layout = points.layout or "a row for each point"
    of = {role: [at for at, meaning in enumerate(columns) if meaning and meaning.role == role]
          for role in ("angle", "current", "flux", "inductance", "phase")}
    names: dict[str, int] = {}
    fluxes = of["flux"] or of["inductance"]
    for index, at in enumerate(fluxes):
        current_at = of["current"][index if len(of["current"]) == len(fluxes) else 0]
        angle_at = of["angle"][index if len(of["angle"]) == len(fluxes) else 0]
        current_factor, flux_factor = points.units(columns[angle_at], columns[current_at], columns[at])
        for row in block.rows:
            if len(row.values) < len(columns):
                raise FluxMapError(f"line {row.line}: {len(row.values)} cells; the header has {len(columns)}")
            own = names.setdefault(row.cells[of["phase"][0]], len(names)) if of["phase"] else phase + index
            current_A = current_factor * row.values[current_at]
            points.add(row.line, own, row.values[angle_at], current_A,
                       points.value(columns[at], current_A, flux_factor * row.values[at]))


def _by_condition(points: Points, block: Block, columns: Sequence[Column | None],
                  conditions: Sequence[tuple[Column, float] | None], phase: int) -> None:
    """A column of flux linkage for each current (or angle) that its header states, the other one in a column to the
    left. The same condition twice is another phase."""
    points.layout = points.layout or "a column for each current or angle, stated in its header"
    roles = [meaning.role if meaning else None for meaning in columns]
    seen: dict[float, int] = {}
    free = [at for at, of in enumerate(conditions) if of is None]
    wanted_role = "flux" if "flux" in roles or "inductance" not in roles else "inductance"
    for at, stated in enumerate(conditions):
        if stated is None or roles[at] not in (None, wanted_role, stated[0].role):
            continue
        meaning, value = stated
        wanted = "angle" if meaning.role == "current" else "current"
        lefts = [left for left in free if left < at]
        named = [left for left in lefts if roles[left] == wanted]
        lefts = named or [left for left in lefts if roles[left] != "other"]
        if not lefts:
            raise FluxMapError(f"line {block.rows[0].line}: no column of the {wanted} left of {block.header[at]!r:.60}")
        left = columns[lefts[-1]]
        flux = columns[at] if roles[at] == wanted_role else None
        angle, current = (left, meaning) if wanted == "angle" else (meaning, left)
        current_factor, flux_factor = points.units(angle, current, flux)
        own = phase + seen.get(value, 0)
        seen[value] = seen.get(value, 0) + 1
        for row in block.rows:
            if len(row.values) > at:
                pair = (row.values[lefts[-1]], value) if wanted == "angle" else (value, row.values[lefts[-1]])
                current_A = current_factor * pair[1]
                points.add(row.line, own, pair[0], current_A,
                           points.value(flux, current_A, flux_factor * row.values[at]))


def _one_curve(points: Points, block: Block, columns: Sequence[Column | None], stated: tuple[Column, float], phase: int
               ) -> None:
    points.layout = points.layout or "a block for each current or angle"
    meaning, value = stated
    by = columns if len(columns) == 2 else [None, _quantity(block)]
    angle, current = (by[0], meaning) if meaning.role == "current" else (meaning, by[0])
    current_factor, flux_factor = points.units(angle, current, by[1])
    for row in block.rows:
        pair = (row.values[0], value) if meaning.role == "current" else (value, row.values[0])
        current_A = current_factor * pair[1]
        points.add(row.line, phase, pair[0], current_A, points.value(by[1], current_A, flux_factor * row.values[1]))


def _matrix_with_head(points: Points, block: Block, phase: int) -> None:
    cells = block.header if len(block.header) == len(block.rows[0].cells) else ("", *block.header)
    head = [number(cell) for cell in cells[1:]]
    _matrix(points, [value if value is not None else math.nan for value in head], block, block.rows,
            phase)


def _rows_of_grid(block: Block) -> bool:
    """Whether the first row and the first column of bare numbers are axes."""
    first = [value for value in block.rows[0].values if not math.isnan(value)]
    if len(block.rows) < 4 or len(block.rows[0].values) < 4:
        return False
    if len(block.rows[0].values) == len(block.rows[1].values):
        first = list(block.rows[0].values[1:])
    left = [row.values[0] for row in block.rows[1:]]
    return all(a < b for a, b in pairwise(first)) and all(a < b for a, b in pairwise(left))


def _bare_matrix(points: Points, block: Block, phase: int) -> None:
    if not _rows_of_grid(block):
        if len(block.rows[0].values) > 3 and len({row.values[0] for row in block.rows}) < 0.5 * len(block.rows):
            _bare_long(points, block, phase)
            return
        raise FluxMapError(f"line {block.rows[0].line}: the first row and the first column of a matrix must be its"
                           " rising currents and angles")
    head = block.rows[0].values
    head = head[1:] if len(head) == len(block.rows[1].values) else head
    _matrix(points, head, block, block.rows[1:], phase)


def _matrix(points: Points, head: Sequence[float], block: Block, rows: Sequence[Row], phase: int) -> None:
    """Flux linkages, the currents or the angles in the head, the others in the first column."""
    points.layout = points.layout or "a matrix"
    left = np.array([row.values[0] for row in rows])
    values = np.array([(list(row.values[1:]) + [math.nan] * len(head))[:len(head)] for row in rows])
    title = " ".join([*block.header[:1], *block.titles])
    units = [meaning for word in re.split(r"[\\|;,]|\s{1,}|/(?=\s*\w{2,})", title) if (meaning := column(word))]
    angle = next((of for of in units if of.role == "angle" and of.unit), None)
    current = next((of for of in units if of.role == "current" and of.factor), None)
    of_block = _quantity(block)
    role = of_block.role if of_block is not None and of_block.role == "inductance" else "flux"
    flux = next((of for of in units if of.role == role and of.factor), of_block if role == "inductance" else None)
    if role == "inductance":
        points.layout += "" if "inductance" in points.layout else ", inductance times current"
    current_factor, flux_factor = points.units(angle, current, flux)
    if role == "inductance":
        down = _is_down(title, left, head)
    else:
        down = _proportional(left, values.T) < _proportional(np.array(head), values)  # currents in the first column
    for row, start, fluxes in zip(rows, left, values, strict=True):
        for of, value in zip(head, fluxes, strict=True):
            pair = (of, start) if down else (start, of)
            current_A = current_factor * float(pair[1])
            points.add(row.line, phase, float(pair[0]), current_A,
                       points.value(flux, current_A, flux_factor * float(value)))


def _is_down(title: str, left: np.ndarray, head: Sequence[float]) -> bool:
    """Whether the currents are in the first column of a matrix of inductances, which no value shows. FluxMapError: the
    title does not name both axes."""
    found = {role: re.search(pattern, title, re.IGNORECASE) for role, pattern in (
        ("angle", r"angle|theta|position|winkel|\bdeg|\brad\b"), ("current", r"current|strom|\bi\b|\ba\b|amp"))}
    angle, current = found["angle"], found["current"]
    if min(left) < 0.0 or min(head) < 0.0:
        return min(head) < 0.0
    if angle is None or current is None:
        raise FluxMapError("a matrix of inductances whose corner does not name the quantity down and the one across, as"
                           " 'L [mH] angle [deg] \\ current [A]'")
    return current.start() < angle.start()


def _proportional(axis: np.ndarray, values: np.ndarray) -> float:
    """How far flux linkages, the last axis along `axis`, are from 0 where it is 0: they are there at 0 A only."""
    order = np.argsort(axis)
    x, y = axis[order], np.nanmean(np.abs(values), axis=0)[order]
    if x[0] < 0.0 or len(x) < 3:
        return math.inf if len(x) < 3 else float(abs(np.interp(0.0, x, y)) / max(float(np.nanmax(y)), 1e-300))
    at_zero = y[0] - x[0] * (y[1] - y[0]) / max(x[1] - x[0], 1e-300)
    return float(abs(at_zero) / max(float(np.nanmax(y)), 1e-300))


def _bare_long(points: Points, block: Block, phase: int) -> None:
    """Columns without names: two of them are a grid, one rises from 0 with the current."""
    points.layout = points.layout or "a row for each point, without names"
    given = [tuple(value for value in row.values if not math.isnan(value)) for row in block.rows]  # a tab too many
    width = min(len(values) for values in given)
    table = np.array([values[:width] for values in given])
    table_columns = [table[:, at] for at in range(width)]
    kept = [at for at in range(width) if not any(_multiple(table_columns[before], table_columns[at])
                                                 for before in range(at))]  # FEMM: voltage of a resistance
    axes = sorted(sorted(kept, key=lambda at: len(set(table_columns[at])))[:2])
    fluxes = [at for at in kept if at not in axes and _like_flux(table_columns[at])]
    if len(axes) < 2 or not fluxes:
        raise FluxMapError(f"line {block.rows[0].line}: no two columns of a grid of angles and currents with a third of"
                           " flux linkages; name the columns in a header")
    first, second = axes
    far = [_from_zero(table_columns[at], table_columns[other], table_columns[fluxes[0]])
           for at, other in ((first, second), (second, first))]
    angle_at, current_at = (second, first) if far[0] < far[1] else (first, second)
    points.units(None, None, None)
    for index, at in enumerate(fluxes):
        for row, values in zip(block.rows, given, strict=True):
            points.add(row.line, phase + index, values[angle_at], values[current_at], values[at])


def _multiple(of: np.ndarray, values: np.ndarray) -> bool:
    scale = float(of @ values) / max(float(of @ of), 1e-300)
    return bool(np.max(np.abs(values - scale * of)) <= 1e-6 * max(float(np.max(np.abs(values))), 1e-300))


def _like_flux(values: np.ndarray) -> bool:
    """Whether values have one sign: a torque has two, or is 0 at both ends."""
    most = float(np.max(np.abs(values)))
    return most > 0.0 and bool(np.all(values >= -0.02 * most) or np.all(values <= 0.02 * most))


def _from_zero(axis: np.ndarray, other: np.ndarray, flux: np.ndarray) -> float:
    means = {float(value): float(np.mean(np.abs(flux[axis == value]))) for value in set(axis)}
    values = sorted(means)
    return _proportional(np.array(values), np.array([[means[value] for value in values]]))
