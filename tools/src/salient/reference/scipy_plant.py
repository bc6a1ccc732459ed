"""The saturating machine on its half bridges by SciPy's solvers: what the emulated plant is compared with.

Currents, speed and angle are the state, and a run goes segment by segment from one switch edge to the next, as in the
emulator; the right-hand side is plain Python floats (for three phases several times faster than NumPy's arrays) and
looks only at phases that conduct. The solvers are called as odeint and ode, whose loops over the steps are compiled,
not as solve_ivp, whose loop is Python.

Equations: emulator/plant/plant.h; magnetics: magnetics.py's "saturating", here with the derivatives that the currents'
equations need.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from scipy.integrate import ode, odeint

from salient.benchmark.switching_pattern import SwitchingPattern, Trajectory
from salient.machine.file import Machine, load_machine, machine_path
from salient.machine.magnetics import Formula

_ZERO_TOLERANCE_A = 1e-10

State = list[float]
"""Currents of all phases, speed, rotor angle."""
RightSide = Callable[[float, np.ndarray], State]
Solver = Callable[[RightSide, State, float, float], State]
"""(right-hand side, state at `from`, from, to in seconds) to the state at `to`."""


def lsoda(tolerance: float) -> Solver:
    """SciPy's LSODA; tolerance: relative, and absolute in A, rad/s and rad."""

    def solve(right_side: RightSide, y: State, from_s: float, to_s: float) -> State:
        end: State = odeint(right_side, y, (from_s, to_s), tfirst=True, rtol=tolerance, atol=tolerance)[-1].tolist()
        return end

    return solve


def dopri5(tolerance: float) -> Solver:
    """SciPy's Runge-Kutta method of order 5 by Dormand and Prince; tolerance as with lsoda."""
    return partial(_runge_kutta, "dopri5", tolerance)


def dop853(tolerance: float) -> Solver:
    """The same of order 8."""
    return partial(_runge_kutta, "dop853", tolerance)


def _runge_kutta(method: str, tolerance: float, right_side: RightSide, y: State, from_s: float, to_s: float) -> State:
    solver = ode(right_side).set_integrator(method, rtol=tolerance, atol=tolerance, nsteps=10_000)
    end: State = solver.set_initial_value(y, from_s).integrate(to_s).tolist()
    if not solver.successful():
        raise ArithmeticError(f"{method} stopped at {solver.t:g} s")
    return end


def _right_side(machine: Machine, load_torque_Nm: float, voltage_V: dict[int, float],
                evaluations: Iterator[int]) -> RightSide:
    """voltage_V: of each phase that conducts; evaluations: stepped at each call."""
    assert isinstance(machine.magnetics, Formula)
    m = machine.magnetics.parameters
    lu, ls = m["unaligned_inductance_H"], m["saturated_inductance_H"]
    a = m["flux_linkage_max_Wb"] - ls * m["current_at_flux_linkage_max_A"]
    b = (m["aligned_inductance_H"] - ls) / a
    excess_slope = ls - lu
    count, pitch, half = machine.phases, machine.pitch_rad, 0.5 * machine.pitch_rad
    resistance, friction, inertia = machine.resistance_ohm, machine.friction_Nm_s, machine.inertia_kg_m2
    conducting = [(phase, phase * pitch / count, voltage) for phase, voltage in voltage_V.items()]
    remainder, exp = math.remainder, math.exp

    def derivative(_: float, y: np.ndarray) -> State:
        next(evaluations)
        *currents, speed, angle = y.tolist()  # floats are much faster than NumPy's scalars
        rates, torque = [0.0] * count, 0.0
        for phase, offset, voltage in conducting:
            current = currents[phase]
            turn = remainder(angle - offset, pitch)
            x = abs(turn) / half
            f, slope = (2.0 * x - 3.0) * x * x + 1.0, 6.0 * x * (x - 1.0) / half
            if turn < 0.0:
                slope = -slope
            knee = exp(-b * current)
            drop = a - a * knee
            inductance = lu + f * (excess_slope + a * b * knee)
            motional = speed * slope * (excess_slope * current + drop)
            rates[phase] = (voltage - resistance * current - motional) / inductance
            torque += slope * (0.5 * excess_slope * current * current + a * current - drop / b)
        return [*rates, (torque - friction * speed - load_torque_Nm) / inertia, speed]

    return derivative


def run_scipy(pattern: SwitchingPattern, solver: Solver) -> Trajectory:
    """The saturating machine through a recorded pattern; ValueError for a machine of another form."""
    machine = load_machine(machine_path(pattern.machine))
    if machine.magnetics.form != "saturating":
        raise ValueError(f"magnetics {machine.magnetics.form}: only saturating is written here")
    segments = [list(pattern.segments(period)) for period in range(pattern.periods)]
    started_s = time.process_time()
    y = [*pattern.current_A, pattern.speed_rad_s, pattern.angle_rad]
    states, evaluations = [], itertools.count()
    make = partial(_right_side, machine, pattern.load_torque_Nm, evaluations=evaluations)
    for period in segments:
        for start_ns, end_ns, on in period:
            y = _segment(make, machine.supply_voltage_V, solver, y, on, start_ns * 1e-9, end_ns * 1e-9)
        states.append(y)
    taken_s = time.process_time() - started_s
    columns = np.array(states)
    current_A, speed_rad_s, angle_rad = columns[:, :-2], columns[:, -2], columns[:, -1]
    phase_angle_rad = angle_rad[:, None] - np.arange(machine.phases) * machine.pitch_rad / machine.phases
    torque_Nm = np.sum(machine.magnetics.torque_Nm(phase_angle_rad, current_A), axis=1)
    return Trajectory(angle_rad, speed_rad_s, torque_Nm, current_A, taken_s, next(evaluations))


def _segment(make: Callable[[dict[int, float]], RightSide], supply_voltage_V: float, solver: Solver, y: State,
             on: list[int], at_s: float, end_s: float) -> State:
    """To the next switch edge; a phase whose current reaches zero at no positive voltage stays at zero."""
    while True:
        applied = [(count - 1) * supply_voltage_V for count in on]
        voltage_V = {phase: volts for phase, volts in enumerate(applied) if volts > 0.0 or y[phase] > 0.0}
        right_side = make(voltage_V)
        end = solver(right_side, y, at_s, end_s)
        ended = [phase for phase, volts in voltage_V.items() if volts <= 0.0 and end[phase] < 0.0]
        if not ended:
            return end
        at_s, phase, y = min(_zero(right_side, solver, y, end, phase, at_s, end_s) for phase in ended)
        y[phase] = 0.0


def _zero(right_side: RightSide, solver: Solver, y: State, end: State, phase: int, at_s: float,
          end_s: float) -> tuple[float, int, State]:
    """(time, phase, state) where the phase's current reaches zero: false position, Illinois variant."""
    low_s, low_A, high_s, high_A = at_s, y[phase], end_s, end[phase]
    side = 0
    for _ in range(50):
        zero_s = low_s + (high_s - low_s) * low_A / (low_A - high_A)
        state = solver(right_side, y, at_s, zero_s)
        if abs(state[phase]) < _ZERO_TOLERANCE_A:
            break
        if state[phase] > 0.0:
            low_s, low_A, high_A = zero_s, state[phase], high_A * (0.5 if side > 0 else 1.0)
            side = 1
        else:
            high_s, high_A, low_A = zero_s, state[phase], low_A * (0.5 if side < 0 else 1.0)
            side = -1
    return zero_s, phase, state
