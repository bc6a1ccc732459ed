"""The model of reference_plant.py with device drops, and with a DC link as a further state.

SciPy's DOP853 integrates flux linkages, speed, angle and DC-link voltage from event to event: a switch edge, a
flux linkage that reaches zero, an angle where the magnetics are not smooth, the supply's rectifier, the
chopper's comparator.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from reference_plant import Machine, Reference, Run, pattern, stop_at
from scipy.integrate import solve_ivp

THRESHOLD_TOLERANCE_V = 1e-9
SUPPLY_TOLERANCE_V = 1e-7
"""Nearer to the supply's voltage, the DC link is at it, and the current of half bridges and chopper decides."""
EVENTS_MAX = 1000
"""In an interval between two switch edges."""


def passing(index: int, value: float, falling: bool, begin_s: float | None) -> Callable[[float, np.ndarray], float]:
    """As stop_at, in one direction. From a start at begin_s on the value itself (None: not on it) it counts as not yet
    reached, so that only a later passage ends the integration, not the start again and again."""

    def stop(t: float, y: np.ndarray) -> float:
        if begin_s is not None and t <= begin_s:
            return 1.0 if falling else -1.0
        return y[index] - value

    stop.terminal = True  # type: ignore[attr-defined]
    stop.direction = -1.0 if falling else 1.0  # type: ignore[attr-defined]
    return stop


class LinkReference:
    """State: flux linkages, speed, angle, DC-link voltage. `supply_V` can be changed between advances."""

    def __init__(self, machine: Machine, run: Run) -> None:
        self.magnetics, self.machine, self.run, self.phases = Reference(machine), machine, run, machine.phases
        self.supply_V = machine.supply_voltage_V
        self.chopper_on = False
        angle_rad = math.radians(run.angle_deg)
        self.y = np.array([0.0] * self.phases + [run.speed_rad_s, angle_rad, machine.supply_voltage_V])
        for phase, current_A in enumerate(run.currents_A):
            f, _ = self.magnetics.shape(self.magnetics.phase_angle(angle_rad, phase))
            self.y[phase] = self.magnetics.flux(f, current_A)
        self.chopped_s = self.sourced_s = 0.0

    def currents(self, y: np.ndarray) -> list[float]:
        shapes = [self.magnetics.shape(self.magnetics.phase_angle(y[-2], phase))[0] for phase in range(self.phases)]
        return [self.magnetics.current(f, flux) for f, flux in zip(shapes, y[: self.phases], strict=True)]

    def right_side(self, on: list[int], conducts: list[bool], source: bool) -> Callable[[float, np.ndarray], list]:
        machine, link, converter = self.machine, self.machine.dc_link, self.machine.converter
        chopper_S = 1.0 / link.chopper_resistance_ohm if self.chopper_on else 0.0

        def rates(_: float, y: np.ndarray) -> list[float]:
            fluxes, torque_Nm = [0.0] * self.phases, 0.0
            drawn_A = chopper_S * y[-1]
            for phase in range(self.phases):
                if not conducts[phase]:
                    continue
                f, slope = self.magnetics.shape(self.magnetics.phase_angle(y[-2], phase))
                i = self.magnetics.current(f, y[phase])
                switches = on[phase] * (converter.switch_drop_V + converter.switch_resistance_ohm * i)
                diodes = (2 - on[phase]) * (converter.diode_drop_V + converter.diode_resistance_ohm * i)
                fluxes[phase] = (on[phase] - 1) * y[-1] - switches - diodes - machine.resistance_ohm * i
                drawn_A += (on[phase] - 1) * i
                torque_Nm += self.magnetics.torque(slope, i)
            sourced_A = (self.supply_V - y[-1]) / link.source_resistance_ohm if source else 0.0
            drag_Nm = machine.friction_Nm_s * y[-3] + self.run.load_torque_Nm
            return [*fluxes, (torque_Nm - drag_Nm) / machine.inertia_kg_m2, y[-3],
                    (sourced_A - drawn_A) / link.capacitance_F]

        return rates

    def advance(self, on: list[int], length_s: float) -> None:
        link, phases = self.machine.dc_link, range(self.phases)
        chopper = link.chopper_resistance_ohm > 0.0
        at_s, events = 0.0, 0
        while at_s < length_s:
            y = self.y
            events += 1
            assert events < EVENTS_MAX, f"more than {EVENTS_MAX} events in {length_s} s, at {at_s} s"
            if chopper and y[-1] >= link.chopper_on_V - THRESHOLD_TOLERANCE_V:
                self.chopper_on = True
            elif chopper and y[-1] <= link.chopper_off_V + THRESHOLD_TOLERANCE_V:
                self.chopper_on = False
            conducts = [y[phase] > 0.0 or on[phase] == 2 for phase in phases]
            currents = self.currents(y)
            drawn_A = sum((on[phase] - 1) * currents[phase] for phase in phases)
            drawn_A += y[-1] / link.chopper_resistance_ohm if self.chopper_on else 0.0
            if abs(y[-1] - self.supply_V) <= SUPPLY_TOLERANCE_V:
                y[-1] = self.supply_V
            source = y[-1] < self.supply_V or (y[-1] == self.supply_V and drawn_A >= 0.0)
            stops = [stop_at(self.phases + 1, self.magnetics.next_corner(y[-2], side)) for side in (1, -1)]
            ends = [phase for phase in phases if conducts[phase] and on[phase] < 2]
            stops += [stop_at(phase, 0.0) for phase in ends]
            thresholds = []
            if drawn_A != 0.0 or abs(y[-1] - self.supply_V) > 1e-6:  # else it only approaches
                thresholds.append((self.supply_V, not source))
            if chopper:
                thresholds.append((link.chopper_off_V if self.chopper_on else link.chopper_on_V, self.chopper_on))
            for voltage_V, falling in thresholds:
                begin_s = at_s if abs(y[-1] - voltage_V) <= THRESHOLD_TOLERANCE_V else None
                stops.append(passing(self.phases + 2, voltage_V, falling, begin_s))
            rates = self.right_side(on, conducts, source)
            solution = solve_ivp(rates, (at_s, length_s), y, "DOP853", rtol=1e-11, atol=1e-12, events=stops)
            if any(len(times) for times in solution.t_events[:2]):
                # The step that found the corner used values past it: repeated, up to the corner.
                solution = solve_ivp(rates, (at_s, solution.t[-1]), y, "DOP853", rtol=1e-11, atol=1e-12,
                                     events=stops[2:])
                ended = solution.t_events
            else:
                ended = solution.t_events[2:]
            self.y = solution.y[:, -1]
            for phase, times in zip(ends, ended, strict=False):
                if len(times) > 0:
                    self.y[phase] = 0.0
            step_s = solution.t[-1] - at_s
            self.chopped_s += step_s if self.chopper_on else 0.0
            self.sourced_s += step_s if source else 0.0
            at_s = solution.t[-1]

    def advance_period(self, period: int) -> None:
        upper, lower = self.run.compares[period]
        for start_ns, end_ns, on in pattern(self.run, upper, lower):
            self.advance(on, (end_ns - start_ns) * 1e-9)

    def row(self) -> list[float]:
        return [*self.y[self.phases :], *self.currents(self.y)]
