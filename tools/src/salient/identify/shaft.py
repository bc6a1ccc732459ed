"""Inertia and friction from the encoder's trace and the torque that the currents make, by the map.

In the weak form, with test functions phi of short windows, nothing is differentiated but phi:

    int phi'' theta = (1/J) int phi T - (B/J) int phi w - (C/J) int phi sign(w) - (L/J) int phi

Window by window one equation of 1/J, B/J, the Coulomb friction's C/J and a constant load's L/J. The two last ones are
left out while they are within their uncertainty. Uncertainty by resampling runs of windows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from salient.identify.fit import Fit
from salient.identify.link import OFF, ON, PART, ZERO, IdentifyError
from salient.identify.sequence import Findings

_STEP_S, _WINDOW_S, _RUN = 0.5e-3, 0.06, 8
_SAMPLES, _SIGNIFICANT = 200, 3.0
_SIGN_RAD_S, _SIGN_STEPS = 0.2, 4
"""Speed that counts as turning, and steps to either side by which it is read: within a window the rotor may turn round,
or stick."""


@dataclass(frozen=True)
class Shaft:
    """Values and their standard deviations: inertia in kg m^2, viscous friction in N m s, Coulomb friction and load in
    N m; the two last 0 when they are not significant."""

    inertia: tuple[float, float]
    friction: tuple[float, float]
    coulomb: tuple[float, float]
    load: tuple[float, float]


def torque_of(found: Findings, fit: Fit, log: np.ndarray) -> np.ndarray:
    """Torque of the currents at each record, N m."""
    torque = np.zeros(len(log))
    for row, phase in enumerate(found.phases):
        current = log["current_A"] - found.offset_A[phase]
        live = (log["phase"] == phase) & (current > 4.0 * found.noise_A[phase] + 0.01 * fit.basis.current_max_A)
        shaft = fit.shaft_rad(2.0 * math.pi * log["turn"][live])
        torque[live] = fit.torque_Nm(shaft - 2.0 * math.pi * found.position[phase] - fit.delta_rad[row],
                                     np.maximum(current[live] + fit.offset_A[row], 0.0))
    return torque


def _of_the_iron(fit: Fit, log: np.ndarray) -> np.ndarray:
    """Records with the currents that make the torque: less the eddy currents by the voltage before each record."""
    action = np.concatenate([[OFF], log["action"][:-1]])
    sign = np.select([action == ON, action == ZERO], [1.0, 0.0], -1.0)
    other = log.copy()
    pulses = (action != PART) & (log["current_A"] > 0.01 * fit.basis.current_max_A)  # a hold's flux linkage is constant
    other["current_A"][pulses] = fit.iron_A(log["current_A"], sign * log["dc_link_V"])[pulses]
    return other


def shaft_of(found: Findings, fit: Fit, log: np.ndarray) -> Shaft:
    """Inertia and friction by the records after the alignment. IdentifyError: the rotor has not turned enough."""
    log = log[log["time_us"] > found.wired_us]
    if len(log) < 2:
        raise IdentifyError("no record of the turning rotor for its inertia")
    log = _of_the_iron(fit, log)
    time_s = (log["time_us"] - log["time_us"][0]) * 1e-6
    angle = fit.shaft_rad(2.0 * math.pi * log["turn"])
    # Impulse of the torque between two records, by Simpson's rule, at their mean time.
    middle = log[:-1].copy()
    for name in ("current_A", "turn"):
        middle[name] = (log[name][1:] + log[name][:-1]) / 2.0
    torque, between = torque_of(found, fit, log), torque_of(found, fit, middle)
    gap_s = np.diff(time_s)
    impulse = (torque[1:] + 4.0 * between + torque[:-1]) / 6.0 * gap_s
    impulse_s = (time_s[1:] + time_s[:-1]) / 2.0
    rows, right = _equations(time_s, angle, impulse_s[impulse != 0.0], impulse[impulse != 0.0])
    if len(right) < 8 * _RUN:
        raise IdentifyError("the record of the turning rotor is too short for its inertia")
    return _solved(rows, right)


def _equations(time_s: np.ndarray, angle: np.ndarray, impulse_s: np.ndarray, impulse: np.ndarray
               ) -> tuple[np.ndarray, np.ndarray]:
    grid = np.arange(0.0, time_s[-1], _STEP_S)
    theta = np.interp(grid, time_s, angle)
    count = round(_WINDOW_S / _STEP_S)
    x = np.linspace(-1.0, 1.0, count + 1)
    half_s = _WINDOW_S / 2.0
    phi = (1.0 - x**2) ** 5
    first = -10.0 * x * (1.0 - x**2) ** 4 / half_s
    second = (-10.0 * (1.0 - x**2) ** 4 + 80.0 * x**2 * (1.0 - x**2) ** 3) / half_s**2
    second -= second.mean()  # a constant angle or speed has no acceleration, however coarse the sum
    second -= x * (second @ x) / (x @ x)
    ends = np.pad(theta, _SIGN_STEPS, mode="edge")
    sign = np.tanh((ends[2 * _SIGN_STEPS:] - ends[:-2 * _SIGN_STEPS]) / (2 * _SIGN_STEPS * _STEP_S) / _SIGN_RAD_S)
    rows, right = [], []
    for begin in range(0, len(grid) - count - 1, count // 4):
        part = theta[begin:begin + count + 1] - theta[begin]
        middle_s = grid[begin] + half_s
        near = np.abs(impulse_s - middle_s) < half_s
        at = (impulse_s[near] - middle_s) / half_s
        speed = -float(first @ part) * _STEP_S
        mass = float(phi.sum()) * _STEP_S
        rows.append([float(((1.0 - at**2) ** 5) @ impulse[near]), -speed,
                     -float(phi @ sign[begin:begin + count + 1]) * _STEP_S, -mass])
        right.append(float(second @ part) * _STEP_S)
    return np.array(rows), np.array(right)


def _solved(rows: np.ndarray, right: np.ndarray) -> Shaft:
    columns = [0, 1, 2, 3]
    while True:
        values, samples = _resampled(rows[:, columns], right)
        deviations = samples.std(axis=0)
        weak = [k for k, column in enumerate(columns) if column >= 2
                and abs(values[k]) < _SIGNIFICANT * deviations[k]]
        if not weak:
            break
        columns.remove(columns[min(weak, key=lambda k: abs(values[k]) / max(deviations[k], 1e-300))])
    if values[0] <= _SIGNIFICANT * deviations[0]:
        raise IdentifyError("the rotor does not follow the torque of the pulses: blocked, or another motor drives it")
    inertia = 1.0 / float(values[0])
    scaled = values * inertia
    # Deviations of the quotients to the first order: a sample may have drawn no torque at all, or a negative 1/J.
    scattered = (samples - scaled * samples[:, :1]) * inertia
    found = {column: (float(scaled[k]), float(scattered[:, k].std())) for k, column in enumerate(columns)}
    none = (0.0, 0.0)
    return Shaft((inertia, float(deviations[0]) * inertia**2), found[1], found.get(2, none), found.get(3, none))


def _resampled(rows: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The solution, and the solutions for runs of successive windows drawn with repetition."""
    values = np.linalg.lstsq(rows, right, rcond=None)[0]
    random = np.random.default_rng(1)
    runs = len(right) // _RUN
    normals = [rows[k * _RUN:(k + 1) * _RUN].T @ rows[k * _RUN:(k + 1) * _RUN] for k in range(runs)]
    rights = [rows[k * _RUN:(k + 1) * _RUN].T @ right[k * _RUN:(k + 1) * _RUN] for k in range(runs)]
    samples = []
    for _ in range(_SAMPLES):
        drawn = random.integers(runs, size=runs)
        normal, of = sum(normals[k] for k in drawn), sum(rights[k] for k in drawn)
        samples.append(np.linalg.lstsq(normal, of, rcond=None)[0])
    return values, np.array(samples)
