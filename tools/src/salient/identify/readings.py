"""Numbers that choose the next experiment: by records of pulses and holds, and by the pulses of each window."""

from __future__ import annotations

import math

import numpy as np

from salient.identify.link import ON

_SIDE_PART = 0.25
"""Least part of the pulses of a phase that are of either side of its aligned position."""


def pull(place: float) -> float:
    """Torque of a phase by its electrical angle from aligned, rev, roughly: the poles overlap near aligned."""
    angle = 2.0 * math.pi * place
    return -math.sin(angle) * (2.0 + math.cos(angle))


def folded(counts: np.ndarray) -> np.ndarray:
    """Pulses by window from aligned to unaligned, of all phases and both sides, which show the same map."""
    half = (counts.shape[1] + 1) // 2
    return np.asarray((counts[:, :half] + counts[:, ::-1][:, :half]).sum(axis=0))


def lacking_side(counts: np.ndarray) -> int:
    """Sign of the torque, in the direction of counting, of the side of aligned that has had too few pulses; 0: none."""
    half = counts.shape[1] // 2
    negative, positive = counts[:, :half].sum(), counts[:, half:].sum()
    least = _SIDE_PART * (negative + positive)
    return -1 if negative < least - half else 1 if positive < least - half else 0


def covered(counts: np.ndarray, repeats: int) -> bool:
    """Each window has had its pulses, and each phase some of either side, whose difference shows its angle."""
    phases, bins = counts.shape
    sides = np.stack([counts[:, :bins // 2].sum(axis=1), counts[:, bins // 2:].sum(axis=1)])
    return bool(folded(counts).min() >= 2 * phases * repeats and sides.min() >= _SIDE_PART * bins // 2 * repeats)


def inductance_of(log: np.ndarray, small_A: float = math.inf) -> list[tuple[float, float]]:
    """Angle of the encoder, rev, and inductance, H, by the first rise of the current in a pulse; none without a rise.
    small_A: current up to which the rotor stands, and the iron is not saturated."""
    on = log["action"] == ON
    if not on.any():
        return []
    first = int(on.argmax())
    end = first + int((~on[first:]).argmax())  # the record at which both switches are no longer on
    if end == first:
        return []
    part = log[first:end + 1]
    part = part[:max(2, int(np.searchsorted(part["current_A"], small_A)))]
    rise_A, time_s = float(part["current_A"][-1] - part["current_A"][0]), 1e-6 * float(np.ptp(part["time_us"]))
    if rise_A <= 0.0 or time_s <= 0.0:
        return []
    return [(float(part["turn"].mean()), float(part["dc_link_V"].mean()) * time_s / rise_A)]


def turning_points(turns: np.ndarray) -> np.ndarray:
    """Angles at which a smoothed oscillation turns round, each a tenth of its span from the one before."""
    if len(turns) < 16:
        return np.zeros(0)
    smooth = np.convolve(turns[::max(1, len(turns) // 600)], np.ones(7) / 7.0, "valid")
    span = float(np.ptp(smooth))
    points: list[float] = []
    for before, here, after in zip(smooth[:-2], smooth[1:-1], smooth[2:], strict=True):
        if (here - before) * (after - here) <= 0.0 and (not points or abs(here - points[-1]) > 0.1 * span):
            points.append(here)
    return np.array(points)


def centre_of(turns: np.ndarray) -> float:
    """Centre of an oscillation: its last turning points, weighted 1 2 1."""
    points = turning_points(turns)
    if len(points) >= 3:
        return float((points[-3] + 2.0 * points[-2] + points[-1]) / 4.0)
    return float(points.mean()) if len(points) == 2 else float(turns[-1])
