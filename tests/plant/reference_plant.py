"""The emulated plant through its shared library, and an independent reference of the same equations.

The reference shares nothing with emulator/plant: its state is the flux linkage, not the current (the current is found
by inverting psi(theta, i)), its switching pattern is read off the timer's carriers, and SciPy's DOP853 integrates it at
a tolerance of 1e-12, with events where a flux linkage reaches zero and where the magnetics are not smooth.
"""

from __future__ import annotations

import ctypes
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.integrate import solve_ivp

import salient.machine.file
import salient.machine.flux_map
from salient.dbc import PHASES_MAX
from salient.machine.flux_map import ANGLE_INTERVALS, CURRENT_INTERVALS
from salient.paths import BUILD

TICK_NS = 5
FORMS = ("linear_cosine", "linear_trapezoid", "saturating")
MAP = 3  # MAGNETICS_MAP, after the forms


# --- The plant, through its shared library ---


class FluxMap(ctypes.Structure):
    _fields_ = [
        ("current_max_A", ctypes.c_double),
        ("inductance_min_H", ctypes.c_double),
        ("current_scale_A", ctypes.c_double),
        ("coenergy_J", (ctypes.c_double * (ANGLE_INTERVALS + 3)) * (CURRENT_INTERVALS + 4)),
    ]


class Magnetics(ctypes.Structure):
    _fields_ = [
        ("form", ctypes.c_int),
        ("unaligned_inductance_H", ctypes.c_double),
        ("aligned_inductance_H", ctypes.c_double),
        ("flat_deg", ctypes.c_double),
        ("blend_deg", ctypes.c_double),
        ("saturated_inductance_H", ctypes.c_double),
        ("flux_linkage_max_Wb", ctypes.c_double),
        ("current_at_flux_linkage_max_A", ctypes.c_double),
        ("map", ctypes.POINTER(FluxMap)),
    ]


class Circuit(ctypes.Structure):
    _fields_ = [
        ("coupling", ctypes.c_double * PHASES_MAX),
        ("eddy_conductance_S", ctypes.c_double),
        ("flux_deviation", ctypes.c_double * PHASES_MAX),
        ("angle_deviation_deg", ctypes.c_double * PHASES_MAX),
    ]


class Converter(ctypes.Structure):
    _fields_ = [
        ("switch_drop_V", ctypes.c_double),
        ("switch_resistance_ohm", ctypes.c_double),
        ("diode_drop_V", ctypes.c_double),
        ("diode_resistance_ohm", ctypes.c_double),
        ("minimum_pulse_ns", ctypes.c_double),
    ]


class DcLink(ctypes.Structure):
    _fields_ = [
        ("capacitance_F", ctypes.c_double),
        ("source_resistance_ohm", ctypes.c_double),
        ("chopper_resistance_ohm", ctypes.c_double),
        ("chopper_on_V", ctypes.c_double),
        ("chopper_off_V", ctypes.c_double),
    ]


class SensorErrors(ctypes.Structure):
    _fields_ = [
        ("current_gain", ctypes.c_double),
        ("current_offset_A", ctypes.c_double),
        ("current_noise_A", ctypes.c_double),
        ("current_limit_A", ctypes.c_double),
        ("current_delay_ns", ctypes.c_double),
        ("encoder_eccentricity_deg", ctypes.c_double),
    ]


class SensorRanges(ctypes.Structure):
    _fields_ = [
        ("current_A", ctypes.c_double),
        ("dc_link_V", ctypes.c_double),
        ("load_torque_Nm", ctypes.c_double),
    ]


class Machine(ctypes.Structure):
    _fields_ = [
        ("name", ctypes.c_char_p),
        ("stator_poles", ctypes.c_uint),
        ("rotor_poles", ctypes.c_uint),
        ("phases", ctypes.c_uint),
        ("resistance_ohm", ctypes.c_double),
        ("inertia_kg_m2", ctypes.c_double),
        ("friction_Nm_s", ctypes.c_double),
        ("supply_voltage_V", ctypes.c_double),
        ("magnetics", Magnetics),
        ("circuit", Circuit),
        ("converter", Converter),
        ("dc_link", DcLink),
        ("sensors", SensorErrors),
        ("ranges", SensorRanges),
    ]


class State(ctypes.Structure):
    _fields_ = [
        ("time_s", ctypes.c_double),
        ("speed_rad_s", ctypes.c_double),
        ("rotor_angle_rad", ctypes.c_double),
        ("torque_Nm", ctypes.c_double),
        ("current_A", ctypes.c_double * PHASES_MAX),
        ("flux_linkage_Wb", ctypes.c_double * PHASES_MAX),
        ("energy_drawn_J", ctypes.c_double),
        ("energy_returned_J", ctypes.c_double),
        ("energy_copper_J", ctypes.c_double),
        ("energy_load_J", ctypes.c_double),
        ("energy_friction_J", ctypes.c_double),
        ("field_energy_J", ctypes.c_double),
        ("kinetic_energy_J", ctypes.c_double),
        ("bus_voltage_V", ctypes.c_double),
        ("energy_converter_J", ctypes.c_double),
        ("energy_supplied_J", ctypes.c_double),
        ("energy_source_J", ctypes.c_double),
        ("energy_chopper_J", ctypes.c_double),
        ("link_energy_J", ctypes.c_double),
        ("energy_fault_J", ctypes.c_double),
        ("energy_iron_J", ctypes.c_double),
    ]


class Compare(ctypes.Structure):
    _fields_ = [("upper", ctypes.c_uint16 * PHASES_MAX), ("lower", ctypes.c_uint16 * PHASES_MAX)]


SAMPLE = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)


def load_library() -> ctypes.CDLL:
    """libsalient_plant.so of the host build, its functions typed."""
    plant = ctypes.CDLL(str(BUILD / "host" / "lib" / "libsalient_plant.so"))
    pointer, number, integer = ctypes.c_void_p, ctypes.c_double, ctypes.c_uint64
    signatures: dict[str, list[type]] = {
        "plant_library_create": [ctypes.POINTER(Machine), number],
        "plant_library_destroy": [pointer],
        "plant_library_set_inputs": [pointer, number, number],
        "plant_library_set_motion": [pointer, number, number],
        "plant_library_set_current": [pointer, ctypes.c_uint, number],
        "plant_library_read": [pointer, ctypes.POINTER(State)],
        "plant_set_switches": [pointer, ctypes.POINTER(Compare), ctypes.c_uint16],
        "plant_set_step_factor": [pointer, number],
        "plant_observe": [pointer, integer, integer, SAMPLE, pointer],
        "plant_advance": [pointer, integer],
    }
    for name, arguments in signatures.items():
        function = getattr(plant, name)
        function.argtypes = arguments
        function.restype = pointer if name == "plant_library_create" else None
    return plant


def flux_map_of(model: salient.machine.flux_map.FluxMap) -> FluxMap:
    """The map structure that the build generates from a machine file."""
    inductance_min_H, _, _, current_scale_A = model.inductance_extremes
    flux_map = FluxMap(model.current_max_A, inductance_min_H, current_scale_A)
    for row, coefficients_J in zip(flux_map.coenergy_J, model.coefficients_J.tolist(), strict=True):
        row[:] = coefficients_J
    return flux_map


def machine_from(file: salient.machine.file.Machine) -> Machine:
    """The plant's machine structure for a machine file, as the build generates it."""
    magnetics = file.magnetics
    if isinstance(magnetics, salient.machine.flux_map.FluxMap):
        model = Magnetics(form=MAP, map=ctypes.pointer(flux_map_of(magnetics)))
        model.unaligned_inductance_H = magnetics.unaligned_inductance_H
    else:
        model = Magnetics(form=FORMS.index(magnetics.form), **magnetics.parameters)
    return Machine(
        name=file.name.encode(),
        stator_poles=file.stator_poles,
        rotor_poles=file.rotor_poles,
        phases=file.phases,
        resistance_ohm=file.resistance_ohm,
        inertia_kg_m2=file.inertia_kg_m2,
        friction_Nm_s=file.friction_Nm_s,
        supply_voltage_V=file.supply_voltage_V,
        magnetics=model,
        converter=Converter(**file.converter),
        dc_link=DcLink(**(file.dc_link or {})),
        sensors=SensorErrors(**file.sensors),
    )


# --- Runs ---


Compares = tuple[Sequence[int], Sequence[int]]  # (upper, lower), one value per phase
Trace = dict[str, np.ndarray]


@dataclass(frozen=True)
class Run:
    """Compare values per control period of 2 * `period_ticks` timer ticks, and the initial state of the machine
    (currents of all phases, default 0 A)."""

    period_ticks: int
    compares: Sequence[Compares]
    speed_rad_s: float
    angle_deg: float
    load_torque_Nm: float
    currents_A: Sequence[float] = ()

    @property
    def period_ns(self) -> int:
        return 2 * self.period_ticks * TICK_NS


def traces(states: Sequence[tuple[float, ...]]) -> Trace:
    columns = np.array(states).T
    phases = (len(columns) - 4) // 2
    return {
        "time_ns": columns[0],
        "angle": columns[1],
        "speed": columns[2],
        "torque": columns[3],
        "currents": columns[4 : 4 + phases],
        "fluxes": columns[4 + phases :],
    }


@contextmanager
def plant_of(library: ctypes.CDLL, machine: Machine, run: Run) -> Iterator[int]:
    plant = library.plant_library_create(ctypes.byref(machine), 0.0)
    try:
        library.plant_library_set_motion(plant, run.speed_rad_s, math.radians(run.angle_deg))
        for phase, current_A in enumerate(run.currents_A):
            library.plant_library_set_current(plant, phase, current_A)
        library.plant_library_set_inputs(plant, run.load_torque_Nm, machine.supply_voltage_V)
        yield plant
    finally:
        library.plant_library_destroy(plant)


def set_switches(library: ctypes.CDLL, plant: int, compares: Compares, period_ticks: int) -> None:
    compare = Compare()
    upper, lower = compares
    compare.upper[: len(upper)], compare.lower[: len(lower)] = upper, lower
    library.plant_set_switches(plant, ctypes.byref(compare), period_ticks)


def run_plant(
    library: ctypes.CDLL, machine: Machine, run: Run, factor: float = 1.0, sample_ns: int = 0
) -> tuple[Trace, State]:
    """States at the start of each period and at the end, or with sample_ns observed samples; and the final state."""
    state = State()
    states: list[tuple[float, ...]] = []

    def read(address: int) -> None:
        library.plant_library_read(address, ctypes.byref(state))
        phases = slice(machine.phases)
        motion = (round(state.time_s * 1e9), state.rotor_angle_rad, state.speed_rad_s, state.torque_Nm)
        states.append((*motion, *state.current_A[phases], *state.flux_linkage_Wb[phases]))

    callback = SAMPLE(lambda _, address: read(address))
    with plant_of(library, machine, run) as plant:
        library.plant_set_step_factor(plant, factor)
        if sample_ns:
            library.plant_observe(plant, 0, sample_ns, callback, None)
        else:
            read(plant)
        for period, compares in enumerate(run.compares):
            set_switches(library, plant, compares, run.period_ticks)
            library.plant_advance(plant, (period + 1) * run.period_ns)
            if not sample_ns:
                read(plant)
        library.plant_library_read(plant, ctypes.byref(state))
    return traces(states), state


# --- The reference ---


class Reference:
    """Flux linkages, speed and angle of the machine; formulas written independently from their sources."""

    def __init__(self, machine: Machine) -> None:
        magnetics = machine.magnetics
        self.machine = machine
        self.form = FORMS[magnetics.form]
        self.lu = magnetics.unaligned_inductance_H
        self.la = magnetics.aligned_inductance_H
        self.ls = magnetics.saturated_inductance_H
        self.phases = machine.phases
        self.half_pitch = math.pi / machine.rotor_poles
        self.phase_offset = 2 * self.half_pitch / machine.phases
        if self.form == "saturating":
            self.a = magnetics.flux_linkage_max_Wb - self.ls * magnetics.current_at_flux_linkage_max_A
            self.b = (self.la - self.ls) / self.a
        self.flat, self.blend = math.radians(magnetics.flat_deg), math.radians(magnetics.blend_deg)
        ends = {
            "linear_cosine": [],
            "linear_trapezoid": [self.flat, self.flat + self.blend],
            "saturating": [0.0],
        }[self.form]
        self.corners = sorted(
            {
                (side * at + half * self.half_pitch + phase * self.phase_offset) % (2 * self.half_pitch)
                for at in ends
                for side in (-1, 1)
                for half in (0, 1)
                for phase in range(self.phases)
            }
        )

    def next_corner(self, angle: float, direction: int) -> float:
        """The next rotor angle in a direction (1 or -1) at which f of some phase is not smooth: DOP853 must not
        step over it. Infinite for the cosine."""
        pitch = 2 * self.half_pitch
        ahead = [direction * (corner - angle) % pitch for corner in self.corners]
        return angle + direction * min((distance for distance in ahead if distance > 1e-9), default=math.inf)

    def shape(self, angle: float) -> tuple[float, float]:
        """f and df/dtheta; f is even and periodic, so half a pitch is enough."""
        wrapped = math.remainder(angle, 2 * self.half_pitch)
        x, sign = abs(wrapped), math.copysign(1.0, wrapped)
        if self.form == "linear_cosine":
            k = math.pi / self.half_pitch
            return math.cos(k * x / 2) ** 2, -sign * k / 2 * math.sin(k * x)
        if self.form == "saturating":
            k = 1 / self.half_pitch
            return 2 * (k * x) ** 3 - 3 * (k * x) ** 2 + 1, sign * (6 * k**3 * x**2 - 6 * k**2 * x)
        # The slope of a trapezoid with rounded corners is itself a trapezoid; f is 1 minus its area.
        a, b, c = self.flat, self.blend, self.half_pitch - 2 * self.flat
        height = 1 / (c - b)
        y = min(max(x - a, 0.0), c)
        slope = height * min(1.0, y / b, (c - y) / b)
        area = height * (min(y, b) ** 2 / (2 * b) + max(0.0, min(y, c - b) - b))
        if y > c - b:
            area += height * (b / 2 - (c - y) ** 2 / (2 * b))
        return 1 - area, -sign * slope

    def flux(self, f: float, current: float) -> float:
        g = self.la * current
        if self.form == "saturating":
            g = self.ls * current + self.a * -math.expm1(-self.b * current)
        return (1 - f) * self.lu * current + f * g

    def current(self, f: float, flux: float) -> float:
        """Inverse of flux(); Newton's method from the left converges monotonically, because flux() is concave."""
        current = flux / ((1 - f) * self.lu + f * self.la)
        if self.form != "saturating":
            return current
        for _ in range(50):
            slope = (1 - f) * self.lu + f * (self.ls + self.a * self.b * math.exp(-self.b * current))
            step = (flux - self.flux(f, current)) / slope
            current += step
            if abs(step) <= 1e-14 * (1 + abs(current)):
                break
        return current

    def torque(self, slope: float, current: float) -> float:
        """Derivative by the angle of the co-energy, the integral of flux() over the current."""
        if self.form != "saturating":
            return slope * (self.la - self.lu) * current**2 / 2
        knee = self.a * (current + math.expm1(-self.b * current) / self.b)
        return slope * ((self.ls - self.lu) * current**2 / 2 + knee)

    def phase_angle(self, angle: float, phase: int) -> float:
        return angle - phase * self.phase_offset

    def derivative(self, load: float, voltage: Sequence[float | None]) -> Callable[[float, np.ndarray], list[float]]:
        machine = self.machine

        def right_side(_: float, y: np.ndarray) -> list[float]:
            rates, torque = [0.0] * self.phases, 0.0
            for phase in range(self.phases):
                applied = voltage[phase]
                if applied is None:
                    continue
                f, slope = self.shape(self.phase_angle(y[-1], phase))
                current = self.current(f, y[phase])
                rates[phase] = applied - machine.resistance_ohm * current
                torque += self.torque(slope, current)
            speed = y[-2]
            return [*rates, (torque - machine.friction_Nm_s * speed - load) / machine.inertia_kg_m2, speed]

        return right_side

    def observe(self, time_ns: float, y: np.ndarray) -> tuple[float, ...]:
        currents, torque = [], 0.0
        for phase in range(self.phases):
            f, slope = self.shape(self.phase_angle(y[-1], phase))
            currents.append(self.current(f, y[phase]))
            torque += self.torque(slope, currents[-1])
        return time_ns, y[-1], y[-2], torque, *currents, *y[: self.phases]


def pattern(run: Run, upper: Sequence[int], lower: Sequence[int]) -> Iterator[tuple[int, int, list[int]]]:
    """(start, end, switches on per phase) in ns from the period's start, read off the carriers of hal_pwm.h."""
    ticks = run.period_ticks
    instants = {0, 2 * ticks}
    for value in upper:
        instants |= {ticks - min(value, ticks), ticks + min(value, ticks)}
    for value in lower:
        instants |= {min(value, ticks), 2 * ticks - min(value, ticks)}
    ordered = sorted(instants)
    for start, end in itertools.pairwise(ordered):
        carrier = abs((start + end) / 2 - ticks)  # of the upper switches: valley in the middle of the period
        on = [(carrier < up) + (ticks - carrier < low) for up, low in zip(upper, lower, strict=True)]
        yield start * TICK_NS, end * TICK_NS, on


Stop = Callable[[float, np.ndarray], float]


def stop_at(index: int, value: float) -> Stop:
    """A terminal event of solve_ivp: a component of the state reaches a value (infinite: never)."""

    def stop(_: float, y: np.ndarray) -> float:
        return y[index] - value if math.isfinite(value) else 1.0

    stop.terminal = True  # type: ignore[attr-defined]
    return stop


def run_reference(
    machine: Machine, run: Run, sample_ns: int = 0, reference: Reference | None = None
) -> tuple[Trace, list[tuple[int, float]]]:
    """The reference's states at the same instants as run_plant's, and (phase, time in ns) of each end of conduction."""
    reference, phases = reference or Reference(machine), range(machine.phases)
    y = np.array([0.0 for _ in phases] + [run.speed_rad_s, math.radians(run.angle_deg)])
    for phase, current_A in enumerate(run.currents_A):
        f, _ = reference.shape(reference.phase_angle(y[-1], phase))
        y[phase] = reference.flux(f, current_A)
    states = [reference.observe(0, y)]
    ends: list[tuple[int, float]] = []
    for period, (upper, lower) in enumerate(run.compares):
        for start_ns, end_ns, on in pattern(run, upper, lower):
            origin_ns = period * run.period_ns
            at_s, until_s = start_ns * 1e-9, end_ns * 1e-9
            while at_s < until_s:
                voltage: list[float | None] = []
                corners = [stop_at(len(phases) + 1, reference.next_corner(y[-1], side)) for side in (1, -1)]
                stops: list[tuple[int, Stop]] = []
                for phase in phases:
                    applied = (on[phase] - 1) * machine.supply_voltage_V
                    conducts = applied > 0 or y[phase] > 0
                    voltage.append(applied if conducts else None)
                    if conducts and applied < 0:
                        stops.append((phase, stop_at(phase, 0.0)))
                grid: list[int] = []
                if sample_ns:
                    first = (origin_ns + round(at_s * 1e9)) // sample_ns + 1
                    last = (origin_ns + end_ns) // sample_ns
                    grid = [n * sample_ns - origin_ns for n in range(first, last + 1)]
                solve = partial(
                    solve_ivp,
                    reference.derivative(run.load_torque_Nm, voltage),
                    y0=y,
                    method="DOP853",
                    rtol=1e-12,
                    atol=1e-14,
                    dense_output=bool(sample_ns),
                )
                falling = [stop for _, stop in stops]
                solution = solve(t_span=(at_s, until_s), events=corners + falling)
                event_times = solution.t_events[len(corners) :]
                if any(len(times) for times in solution.t_events[: len(corners)]):
                    # The step that found the corner used values past it: repeated, up to the corner.
                    solution = solve(t_span=(at_s, solution.t[-1]), events=falling or None)
                    event_times = solution.t_events or []
                assert solution.success, solution.message
                reached_s = solution.t[-1]
                states += [
                    reference.observe(origin_ns + n, solution.sol(n * 1e-9)) for n in grid if n * 1e-9 <= reached_s
                ]
                y = solution.y[:, -1].copy()
                at_s = reached_s
                for (phase, _), times in zip(stops, event_times, strict=True):
                    if len(times):
                        y[phase] = 0.0
                        ends.append((phase, float(origin_ns + reached_s * 1e9)))
        if not sample_ns:
            states.append(reference.observe((period + 1) * run.period_ns, y))
    return traces(states), ends
