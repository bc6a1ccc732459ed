"""Independent reference of a machine with coupled phases, eddy currents and spread (emulator/plant/coupled.h).

Its state is the flux linkage of every winding that carries a current, and the currents follow from all of them together
by Newton's method with a Jacobian of differences; SciPy's DOP853 integrates it. Formulas of one pole: Reference of
reference_plant.py. Patterns are whole control periods with both switches of a phase, one or none on.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from reference_plant import Machine, Reference, Run
from scipy.integrate import solve_ivp

TOLERANCE = 1e-11
RATE_STEP_S = 1e-8
CONDUCTION_V = 1e-5
TRIAL_S = 1e-11

Array = np.ndarray


class Coupled:
    """The machine's flux linkages and torque as functions of all currents."""

    def __init__(self, machine: Machine) -> None:
        self.machine, self.pole = machine, Reference(machine)
        n = self.phases = machine.phases
        circuit = machine.circuit
        self.share = np.eye(n)
        for phase in range(n):
            self.share[phase, (phase + 1) % n] = self.share[(phase + 1) % n, phase] = circuit.coupling[phase]
        self.gain = 1.0 + np.array(circuit.flux_deviation[:n])
        self.offset = np.radians(circuit.angle_deviation_deg[:n])
        self.mutual = any(circuit.coupling[:n])
        self.eddy_S = circuit.eddy_conductance_S
        self.corners = sorted({(corner + float(offset)) % (2 * self.pole.half_pitch)
                               for corner in self.pole.corners for offset in self.offset})

    def shapes(self, angle: float) -> list[tuple[float, float]]:
        return [self.pole.shape(self.pole.phase_angle(angle, phase) - self.offset[phase])
                for phase in range(self.phases)]

    def fluxes(self, angle: float, currents: Array) -> Array:
        mmf = self.share @ currents
        of_poles = [gain * math.copysign(self.pole.flux(f, abs(u)), u)
                    for gain, (f, _), u in zip(self.gain, self.shapes(angle), mmf, strict=True)]
        return self.share.T @ np.array(of_poles)

    def torque(self, angle: float, currents: Array) -> float:
        mmf = self.share @ currents
        return sum(gain * self.pole.torque(slope, abs(u))
                   for gain, (_, slope), u in zip(self.gain, self.shapes(angle), mmf, strict=True))

    def currents(self, angle: float, fluxes: Array, carry: Sequence[int], guess: Array) -> Array:
        """Currents of the phases `carry`, whose flux linkages are given; the others have none."""
        currents = np.zeros(self.phases)
        currents[carry] = guess[carry]
        for _ in range(60):
            rest = (fluxes - self.fluxes(angle, currents))[carry]
            jacobian = np.zeros((len(carry), len(carry)))
            for column, phase in enumerate(carry):
                step = np.zeros(self.phases)
                step[phase] = 1e-3
                change = self.fluxes(angle, currents + step) - self.fluxes(angle, currents - step)
                jacobian[:, column] = change[carry] / 2e-3
            move = np.linalg.solve(jacobian, rest)
            currents[carry] += move
            if np.all(np.abs(move) < 1e-12 * (1.0 + np.abs(currents[carry]))):
                break
        return currents


@dataclass
class Segment:
    """Phases in an interval without an event: which carry a current, and which of these only in their loop."""

    carry: list[int]
    isolated: list[int]


def terminal_A(model: Coupled, phase: int, volts: float, currents: Array) -> float:
    """Current at the terminals of a phase that conducts."""
    ohm = model.machine.resistance_ohm
    flux_rate = (volts - ohm * currents[phase]) / (1.0 + ohm * model.eddy_S)
    return float(currents[phase] + model.eddy_S * flux_rate)


def run_coupled(machine: Machine, run: Run) -> dict[str, Array]:
    """States at the start of each period and at the end."""
    model, n = Coupled(machine), machine.phases
    y = np.zeros(n + 2)
    y[n], y[n + 1] = run.speed_rad_s, math.radians(run.angle_deg)
    guess = np.zeros(n)
    rows = []

    def observe(volts: Sequence[float]) -> None:
        currents = model.currents(y[n + 1], y[:n], list(range(n)), guess)
        rows.append([y[n + 1], y[n], model.torque(y[n + 1], currents), *currents, *y[:n]])

    period_s = run.period_ns * 1e-9
    for upper, lower in run.compares:
        volts = [((up > 0) + (low > 0) - 1) * machine.supply_voltage_V for up, low in zip(upper, lower, strict=True)]
        observe(volts)
        at_s = 0.0
        while at_s < period_s:
            segment = find_segment(model, y, volts, guess)
            y, at_s = advance(model, run.load_torque_Nm, segment, volts, y, (at_s, period_s), guess)
    observe(volts)
    columns = np.array(rows).T
    return {"angle": columns[0], "speed": columns[1], "torque": columns[2], "currents": columns[3:3 + n],
            "fluxes": columns[3 + n:]}


def find_segment(model: Coupled, y: Array, volts: Sequence[float], guess: Array) -> Segment:
    n = model.phases
    currents = model.currents(y[n + 1], y[:n], list(range(n)), guess)
    guess[:] = currents
    if model.eddy_S > 0.0:
        isolated = [phase for phase in range(n)
                    if volts[phase] <= 0.0 and terminal_A(model, phase, volts[phase], currents) <= 1e-9]
        # At the event itself: by what the current does next.
        trial = y + TRIAL_S * rates(model, 0.0, Segment(list(range(n)), isolated), volts, y, guess)
        after = model.currents(trial[n + 1], trial[:n], list(range(n)), guess)
        isolated = [phase for phase in isolated if terminal_A(model, phase, volts[phase], after) <= 0.0]
        asleep = [phase for phase in isolated if not model.mutual and currents[phase] < 1e-9]
        return Segment([phase for phase in range(n) if phase not in asleep],
                       [phase for phase in isolated if phase not in asleep])
    carry = [phase for phase in range(n) if currents[phase] > 1e-9]
    while True:
        others = [phase for phase in range(n) if phase not in carry]
        blocking = {phase: induced(model, y, Segment(carry, []), volts, phase) - volts[phase] for phase in others}
        first = min(blocking, key=lambda phase: blocking[phase], default=None)
        if first is None or blocking[first] >= (CONDUCTION_V if model.mutual else -CONDUCTION_V):
            return Segment(carry, [])
        carry = sorted([*carry, first])


def rates(model: Coupled, load: float, segment: Segment, volts: Sequence[float], y: Array, guess: Array) -> Array:
    n, machine = model.phases, model.machine
    currents = model.currents(y[n + 1], y[:n], segment.carry, guess)
    result = np.zeros(n + 2)
    for phase in segment.carry:
        if phase in segment.isolated:
            result[phase] = -currents[phase] / model.eddy_S
        else:
            result[phase] = ((volts[phase] - machine.resistance_ohm * currents[phase])
                             / (1.0 + machine.resistance_ohm * model.eddy_S))
    torque = model.torque(y[n + 1], currents)
    result[n] = (torque - machine.friction_Nm_s * y[n] - load) / machine.inertia_kg_m2
    result[n + 1] = y[n]
    return result


def induced(model: Coupled, y: Array, segment: Segment, volts: Sequence[float], phase: int) -> float:
    """Voltage of an open winding, by a difference over time."""
    n = model.phases
    rate = rates(model, 0.0, segment, volts, y, np.zeros(n))
    ends = []
    for side in (-1.0, 1.0):
        moved = y + side * RATE_STEP_S * rate
        currents = model.currents(moved[n + 1], moved[:n], segment.carry, np.zeros(n))
        ends.append(model.fluxes(moved[n + 1], currents)[phase])
    return float((ends[1] - ends[0]) / (2.0 * RATE_STEP_S))


def advance(model: Coupled, load: float, segment: Segment, volts: Sequence[float], y: Array,
            span_s: tuple[float, float], guess: Array) -> tuple[Array, float]:
    """To the next event or the end; the flux linkages of open windings follow from the currents."""
    n = model.phases
    stops: list[Callable[[float, Array], float]] = []

    def add(value: Callable[[Array], float], direction: float) -> None:
        def stop(_: float, state: Array) -> float:
            return value(state)

        stop.terminal, stop.direction = True, direction  # type: ignore[attr-defined]
        stops.append(stop)

    def solved(state: Array) -> Array:
        return model.currents(state[n + 1], state[:n], segment.carry, guess)

    for phase in range(n):
        if phase in segment.isolated:
            add(lambda state, k=phase: terminal_A(model, k, volts[k], solved(state)), 1.0)
        elif phase in segment.carry:
            if model.eddy_S > 0.0:
                add(lambda state, k=phase: terminal_A(model, k, volts[k], solved(state)), -1.0)
            else:
                add(lambda state, k=phase: solved(state)[k], -1.0)
        elif volts[phase] >= 0.0 and model.mutual and model.eddy_S == 0.0:
            add(lambda state, k=phase: induced(model, state, segment, volts, k) - volts[k], -1.0)
    if model.corners:
        pitch = 2 * model.pole.half_pitch
        ahead = min((corner - y[n + 1]) % pitch for corner in model.corners if (corner - y[n + 1]) % pitch > 1e-9)
        add(lambda state, at=y[n + 1] + ahead: state[n + 1] - at, 1.0)
    done = solve_ivp(lambda _, state: rates(model, load, segment, volts, state, guess), span_s, y,
                     method="Radau" if segment.isolated else "DOP853", rtol=TOLERANCE, atol=1e-13,
                     events=stops or None)
    end = done.y[:, -1].copy()
    currents = model.currents(end[n + 1], end[:n], segment.carry, guess)
    if model.eddy_S == 0.0:
        currents = np.maximum(currents, 0.0)
    currents[np.abs(currents) < 1e-9] = 0.0
    end[:n] = model.fluxes(end[n + 1], currents)
    guess[:] = currents
    return end, float(done.t[-1])
