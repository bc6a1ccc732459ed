"""Iron loss of a run, estimated afterwards from its recorded phase currents and rotor angle.

Steinmetz: sinusoidal flux of frequency f and amplitude B costs P = k f^alpha B^beta in W/kg. For any other periodic
waveform the improved generalized Steinmetz equation with the same three numbers (K. Venkatachalam, C. R. Sullivan,
T. Abdallah, H. Tacca, "Accurate prediction of ferrite core loss with nonsinusoidal voltage waveforms using only
Steinmetz parameters", IEEE Workshop on Computers in Power Electronics, 2002):

    P = 1/T  integral over T of  k_i |dB/dt|^alpha swing^(beta - alpha) dt
    k_i = k / ((2 pi)^(alpha - 1)  integral from 0 to 2 pi of |cos x|^alpha 2^(beta - alpha) dx)

where swing is the peak-to-peak flux density of the loop that the waveform is in. As that paper does, the waveform is
split into a major loop and minor loops, here those that chopping makes: a minor loop begins where the flux turns back
and ends where it is at that level again; loops may contain loops.

Simplifications: the flux density of a stator pole, psi / turns_area_m2, is taken for all of the iron, though the
waveforms in yoke and rotor differ. Neglected: the bias of the loops (a pole's flux does not change its sign), which
Steinmetz's parameters do not describe; relaxation while the flux is constant; leakage. The iron does not act back on
the electrical side: it is not part of the emulator's energy balance.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from salient.machine.file import Machine

SAMPLE_STEP_MAX_S = 1e-6
"""Coarser samples miss too much of the short pulses of chopping, and the estimate comes out too low."""

# Far below any sample step, far above the rounding of a double near 1 s.
_TIME_TOLERANCE_S = 1e-10


def iron_loss_W(machine: Machine, recording: np.ndarray, window_s: tuple[float, float]) -> float | None:
    """Mean iron loss over whole electrical periods at the end of window_s: as many as fit into it, at least one.

    A single period may begin before the window. `recording`: rows at a constant step with time_s, rotor_angle_deg and
    a current_<phase>_A for each phase; window_s within it. machine.iron_loss["mass_kg"], which must be there, is the
    iron of all phases together, an equal share for each. None when the samples are more than SAMPLE_STEP_MAX_S apart
    or the rotor has not turned by an electrical period since the first row.
    """
    steinmetz = machine.iron_loss
    if steinmetz is None:
        raise ValueError(f"machine {machine.name} has no table [iron_loss]")
    time_s = recording["time_s"]
    begin, end = np.searchsorted(time_s, (window_s[0] - _TIME_TOLERANCE_S, window_s[1] + _TIME_TOLERANCE_S))
    if time_s[1] - time_s[0] > SAMPLE_STEP_MAX_S + _TIME_TOLERANCE_S:
        return None
    angle_rad = np.unwrap(np.radians(recording["rotor_angle_deg"][:end], dtype=float))
    to_end_rad = np.abs(angle_rad[-1] - angle_rad)
    periods = max(1, int(to_end_rad[begin] / machine.pitch_rad))
    before = np.flatnonzero(to_end_rad >= periods * machine.pitch_rad)
    if before.size == 0:
        return None
    part = slice(before[-1], end)
    losses_W_kg = []
    for phase, current in enumerate(name for name in recording.dtype.names or () if name.startswith("current_")):
        flux_Wb = machine.magnetics.flux_linkage_Wb(angle_rad[part] - phase * machine.pitch_rad / machine.phases,
                                                    recording[current][part])
        losses_W_kg.append(specific_loss_W_kg(time_s[part], flux_Wb / steinmetz["turns_area_m2"],
                                              steinmetz["steinmetz_k"], steinmetz["steinmetz_alpha"],
                                              steinmetz["steinmetz_beta"]))
    return float(steinmetz["mass_kg"] * sum(losses_W_kg) / machine.phases)


def specific_loss_W_kg(time_s: np.ndarray, flux_density_T: np.ndarray, k: float, alpha: float, beta: float) -> float:
    """Loss by the improved generalized Steinmetz equation of one period, taken as straight between its samples.

    The samples reach from the first instant of the period to its last; where first and last differ, the step back
    costs nothing.
    """
    # Integral of |dB/dt|^alpha over each step.
    steps = np.abs(np.diff(flux_density_T)) ** alpha * np.diff(time_s) ** (1.0 - alpha)
    cosine = 2.0 * math.sqrt(math.pi) * math.gamma((alpha + 1.0) / 2.0) / math.gamma(alpha / 2.0 + 1.0)
    k_i = k / ((2.0 * math.pi) ** (alpha - 1.0) * cosine * 2.0 ** (beta - alpha))
    energy = sum(swing_T ** (beta - alpha) * integral for swing_T, integral in split_loops(flux_density_T, steps))
    loss_W_kg: float = k_i * energy / (time_s[-1] - time_s[0])
    return loss_W_kg


def split_loops(values: np.ndarray, step_integrals: np.ndarray) -> list[tuple[float, float]]:
    """The loops of a periodic waveform through `values`, straight in between: (peak to peak, integral over the loop).

    step_integrals[k] belongs to the step from value k to k + 1, in proportion to the distance; the step from the last
    value back to the first has none. Minor loops come before the loops that contain them. A constant has no loop.
    """
    # One turn from the lowest value to itself, without the steps that do not move.
    lowest = int(np.argmin(values))
    values = np.concatenate((values[lowest:], values[:lowest + 1]))
    step_integrals = np.concatenate((step_integrals[lowest:], [0.0], step_integrals[:lowest]))
    moving = np.diff(values) != 0.0
    values = np.concatenate((values[:1], values[1:][moving]))
    so_far = np.concatenate(([0.0], np.cumsum(step_integrals[moving])))
    rising = np.diff(values) > 0.0
    turns = np.flatnonzero(rising[1:] != rising[:-1]) + 1
    ends = [0, *turns.tolist(), len(values) - 1] if rising.size else [0]

    loops = []
    # The turning points of the loops that are still open, each swing smaller than the one before, and the integral on
    # the way to each from the point before it.
    open_points: list[tuple[float, float]] = [(values[0], 0.0)]
    for first, last in pairwise(ends):
        sign = 1.0 if values[last] > values[first] else -1.0
        run, run_so_far = sign * values[first:last + 1], so_far[first:last + 1]
        position, carried = run_so_far[0], 0.0
        # Each level to which the run returns ends the loop that began there.
        while len(open_points) > 1 and sign * values[last] >= sign * open_points[-2][0]:
            (turn, way_to_turn), (back, way_back) = open_points[-2:]
            closed = float(np.interp(sign * turn, run, run_so_far))
            loops.append((float(abs(turn - back)), way_back + carried + closed - position))
            position, carried = closed, way_to_turn
            del open_points[-2:]
            if not open_points:  # the whole turn is closed, at its lowest value
                open_points.append((turn, 0.0))
                break
        if values[last] != open_points[-1][0]:
            open_points.append((values[last], carried + run_so_far[-1] - position))
    return loops
