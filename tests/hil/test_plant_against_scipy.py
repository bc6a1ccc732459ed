"""The emulated plant against an independent integration of the same equations.

The reference here shares nothing with emulator/plant: its state is the flux linkage, not the current (the current is
found by inverting psi(theta, i)), its switching pattern is read off the timer's carriers, and SciPy's DOP853 integrates
it at a tolerance of 1e-12, with an event where a flux linkage reaches zero.

Deviations are relative to the largest magnitude of the quantity in the run (speed: to its change). Measured on x86-64
with gcc 12: at most 4.7e-7 (the start of the saturating machine), 1.8e-6 for samples within steps; a sixteenth of that
with steps of half the length.
"""

from __future__ import annotations

import ctypes
import itertools
import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

ROOT = Path(__file__).resolve().parents[2]
PHASES_MAX = 4
PHASES = 3
TICK_NS = 5
FORMS = ("linear_cosine", "linear_trapezoid", "saturating")


# --- The plant, through its shared library ---


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
    ]


class Compare(ctypes.Structure):
    _fields_ = [("upper", ctypes.c_uint16 * PHASES_MAX), ("lower", ctypes.c_uint16 * PHASES_MAX)]


SAMPLE = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    build = Path(os.environ.get("SALIENT_BUILD", ROOT / "build" / "host"))
    plant = ctypes.CDLL(str(build / "lib" / "libsalient_plant.so"))
    pointer, number, integer = ctypes.c_void_p, ctypes.c_double, ctypes.c_uint64
    signatures: dict[str, list[type]] = {
        "plant_library_create": [ctypes.POINTER(Machine), number],
        "plant_library_destroy": [pointer],
        "plant_library_set_inputs": [pointer, number, number],
        "plant_library_set_motion": [pointer, number, number],
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


def machine_of(form: str, inertia_kg_m2: float = 0.02) -> Machine:
    saturating = form == "saturating"
    trapezoid = form == "linear_trapezoid"
    return Machine(
        name=form.encode(),
        stator_poles=6,
        rotor_poles=4,
        phases=PHASES,
        resistance_ohm=0.05,
        inertia_kg_m2=inertia_kg_m2,
        friction_Nm_s=0.02,
        supply_voltage_V=240.0,
        magnetics=Magnetics(
            form=FORMS.index(form),
            unaligned_inductance_H=0.67e-3 if saturating else 0.676e-3,
            aligned_inductance_H=23.6e-3,
            flat_deg=1.0 if trapezoid else 0.0,
            blend_deg=2.0 if trapezoid else 0.0,
            saturated_inductance_H=0.15e-3 if saturating else 0.0,
            flux_linkage_max_Wb=0.486 if saturating else 0.0,
            current_at_flux_linkage_max_A=450.0 if saturating else 0.0,
        ),
    )


# --- What is run ---


Compares = tuple[Sequence[int], Sequence[int]]  # (upper, lower), a value for each phase
Trace = dict[str, np.ndarray]


@dataclass(frozen=True)
class Run:
    """Compare values per control period of 2 * `period_ticks` timer ticks, and where the rotor starts."""

    period_ticks: int
    compares: Sequence[Compares]
    speed_rad_s: float
    angle_deg: float
    load_torque_Nm: float
    inertia_kg_m2: float = 0.02

    @property
    def period_ns(self) -> int:
        return 2 * self.period_ticks * TICK_NS


def traces(states: Sequence[tuple[float, ...]]) -> Trace:
    columns = np.array(states).T
    return {"time_ns": columns[0], "speed": columns[1], "torque": columns[2], "currents": columns[3:]}


@contextmanager
def plant_of(library: ctypes.CDLL, machine: Machine, run: Run) -> Iterator[int]:
    plant = library.plant_library_create(ctypes.byref(machine), 0.0)
    try:
        library.plant_library_set_motion(plant, run.speed_rad_s, math.radians(run.angle_deg))
        library.plant_library_set_inputs(plant, run.load_torque_Nm, machine.supply_voltage_V)
        yield plant
    finally:
        library.plant_library_destroy(plant)


def set_switches(library: ctypes.CDLL, plant: int, compares: Compares, period_ticks: int) -> None:
    compare = Compare()
    compare.upper[:PHASES], compare.lower[:PHASES] = compares
    library.plant_set_switches(plant, ctypes.byref(compare), period_ticks)


def run_plant(
    library: ctypes.CDLL, form: str, run: Run, factor: float = 1.0, sample_ns: int = 0
) -> tuple[Trace, State]:
    """The plant's states at the start of each period and at the end, or with sample_ns its observed samples; and the
    state in which it ends."""
    machine = machine_of(form, run.inertia_kg_m2)
    state = State()
    states: list[tuple[float, ...]] = []

    def read(address: int) -> None:
        library.plant_library_read(address, ctypes.byref(state))
        time_ns = round(state.time_s * 1e9)
        states.append((time_ns, state.speed_rad_s, state.torque_Nm, *state.current_A[:PHASES]))

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
    """Flux linkages, speed and angle of the machine; formulas written anew from their sources."""

    def __init__(self, machine: Machine) -> None:
        magnetics = machine.magnetics
        self.machine = machine
        self.form = FORMS[magnetics.form]
        self.lu = magnetics.unaligned_inductance_H
        self.la = magnetics.aligned_inductance_H
        self.ls = magnetics.saturated_inductance_H
        self.half_pitch = math.pi / machine.rotor_poles
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
                (side * at + half * self.half_pitch + phase * 2 * self.half_pitch / PHASES) % (2 * self.half_pitch)
                for at in ends
                for side in (-1, 1)
                for half in (0, 1)
                for phase in range(PHASES)
            }
        )

    def next_corner(self, angle: float) -> float:
        """The next rotor angle forwards at which f of some phase is not smooth: DOP853 is not to step over it."""
        pitch = 2 * self.half_pitch
        ahead = [(corner - angle) % pitch for corner in self.corners]
        return angle + min((distance for distance in ahead if distance > 1e-9), default=math.inf)

    def shape(self, angle: float) -> tuple[float, float]:
        """f and df/dtheta; f is even and periodic, so half a pitch is enough."""
        turn = math.remainder(angle, 2 * self.half_pitch)
        x, sign = abs(turn), math.copysign(1.0, turn)
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
        """The inverse of flux(); Newton from the left of the root rises to it, for flux() is concave."""
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
        """The angle's derivative of the co-energy, the integral of flux() over the current."""
        if self.form != "saturating":
            return slope * (self.la - self.lu) * current**2 / 2
        knee = self.a * (current + math.expm1(-self.b * current) / self.b)
        return slope * ((self.ls - self.lu) * current**2 / 2 + knee)

    def phase_angle(self, angle: float, phase: int) -> float:
        return angle - phase * 2 * self.half_pitch / PHASES

    def derivative(self, load: float, voltage: Sequence[float | None]) -> Callable[[float, np.ndarray], list[float]]:
        machine = self.machine

        def right_side(_: float, y: np.ndarray) -> list[float]:
            rates, torque = [0.0] * PHASES, 0.0
            for phase in range(PHASES):
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
        for phase in range(PHASES):
            f, slope = self.shape(self.phase_angle(y[-1], phase))
            currents.append(self.current(f, y[phase]))
            torque += self.torque(slope, currents[-1])
        return time_ns, y[-2], torque, *currents


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
        carrier = abs((start + end) / 2 - ticks)  # of the uppers: its valley is the middle of the period
        on = [(carrier < upper[phase]) + (ticks - carrier < lower[phase]) for phase in range(PHASES)]
        yield start * TICK_NS, end * TICK_NS, on


Stop = Callable[[float, np.ndarray], float]


def stop_at(index: int, value: float) -> Stop:
    """A terminal event of solve_ivp: a component of the state reaches a value (infinite: never)."""

    def stop(_: float, y: np.ndarray) -> float:
        return y[index] - value if math.isfinite(value) else 1.0

    stop.terminal = True  # type: ignore[attr-defined]
    return stop


def run_reference(form: str, run: Run, sample_ns: int = 0) -> tuple[Trace, list[tuple[int, float]]]:
    """The reference's states at the same instants as run_plant's, and (phase, time in ns) of each end of conduction."""
    machine = machine_of(form, run.inertia_kg_m2)
    reference = Reference(machine)
    y = np.array([0.0] * PHASES + [run.speed_rad_s, math.radians(run.angle_deg)])
    states = [reference.observe(0, y)]
    ends: list[tuple[int, float]] = []
    for period, (upper, lower) in enumerate(run.compares):
        for start_ns, end_ns, on in pattern(run, upper, lower):
            origin_ns = period * run.period_ns
            at_s, until_s = start_ns * 1e-9, end_ns * 1e-9
            while at_s < until_s:
                voltage: list[float | None] = []
                stops: list[tuple[int | None, Stop]] = [(None, stop_at(PHASES + 1, reference.next_corner(y[-1])))]
                for phase in range(PHASES):
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
                solution = solve(t_span=(at_s, until_s), events=[stop for _, stop in stops])
                if len(solution.t_events[0]):
                    # The step that found the corner has looked beyond it: again, up to the corner.
                    solution = solve(t_span=(at_s, solution.t[-1]), events=[stop for _, stop in stops[1:]])
                    stops = stops[1:]
                assert solution.success, solution.message
                reached_s = solution.t[-1]
                states += [
                    reference.observe(origin_ns + n, solution.sol(n * 1e-9)) for n in grid if n * 1e-9 <= reached_s
                ]
                y = solution.y[:, -1].copy()
                at_s = reached_s
                for (phase, _), times in zip(stops, solution.t_events or [], strict=True):
                    if phase is not None and len(times):
                        y[phase] = 0.0
                        ends.append((phase, float(origin_ns + reached_s * 1e9)))
        if not sample_ns:
            states.append(reference.observe((period + 1) * run.period_ns, y))
    return traces(states), ends


# --- The runs ---


def start_from_standstill(library: ctypes.CDLL, form: str) -> Run:
    """Several strokes from rest, phases on from 45 to 75 degrees, current kept near 35 A by a hysteresis at 40 kHz.
    What the law decided on the plant is recorded, so that both sides then run the same pattern. A light rotor, so that
    40 ms are enough."""
    full, low_A, high_A = 2500, 32.0, 38.0
    run = Run(full, [], speed_rad_s=0.0, angle_deg=50.0, load_torque_Nm=1.0, inertia_kg_m2=0.005)
    machine = machine_of(form, run.inertia_kg_m2)
    compares: list[Compares] = []
    rising = [True] * PHASES

    def law(state: State) -> Compares:
        upper, lower = [0] * PHASES, [0] * PHASES
        for phase in range(PHASES):
            angle_deg = (math.degrees(state.rotor_angle_rad) - 30.0 * phase) % 90.0
            rising[phase] = state.current_A[phase] < (high_A if rising[phase] else low_A)
            if 45.0 <= angle_deg < 75.0:
                upper[phase] = full
                lower[phase] = full if rising[phase] else 0
        compares.append((upper, lower))
        return compares[-1]

    with plant_of(library, machine, run) as plant:
        state = State()
        for period in range(1600):
            library.plant_library_read(plant, ctypes.byref(state))
            set_switches(library, plant, law(state), full)
            library.plant_advance(plant, (period + 1) * run.period_ns)
    return replace(run, compares=compares)


def chopping_stroke() -> Run:
    """A stroke at 150 r/min: 40 kHz, both switches of phase A with partial duty, so that two pulses and two
    freewheels lie within each period, while phase C's current is driven to zero within each period by its diodes."""
    full = 2500
    compares: list[Compares] = []
    for period in range(120):
        upper, lower = [0] * PHASES, [0] * PHASES
        if period < 8:
            upper[0], lower[0] = full, full
        elif period < 100:
            upper[0], lower[0] = 2000 + 3 * period, 400 + (37 * period) % 200
        if 10 <= period < 60:
            upper[2], lower[2] = 1801, 1202
        elif 60 <= period < 90:
            upper[2] = 333
        compares.append((upper, lower))
    return Run(full, compares, speed_rad_s=15.7, angle_deg=55.0, load_torque_Nm=8.0)


def single_pulse(full: int = 2500, driven_ns: int = 850_000) -> Run:
    """One pulse of 12 degrees from 45 on, at 2390 r/min, then the diodes until their current ends."""
    driven = driven_ns // (2 * full * TICK_NS)
    compares = [([full, 0, 0], [full, 0, 0])] * driven + [([0] * PHASES, [0] * PHASES)] * (2 * driven)
    return Run(full, compares, speed_rad_s=250.0, angle_deg=45.0, load_torque_Nm=2.0)


def run_of(library: ctypes.CDLL, name: str, form: str) -> Run:
    if name == "start":
        return start_from_standstill(library, form)
    return {"chopping": chopping_stroke, "single_pulse": single_pulse}[name]()


def deviation(measured: Trace, expected: Trace) -> dict[str, float]:
    """Largest deviation of each quantity relative to its largest magnitude; speed relative to its change."""
    assert np.array_equal(measured["time_ns"], expected["time_ns"])
    worst = {}
    for name in ("speed", "torque", "currents"):
        reach = np.ptp(expected[name]) if name == "speed" else np.max(np.abs(expected[name]))
        worst[name] = float(np.max(np.abs(measured[name] - expected[name])) / reach)
    return worst


# --- The tests ---

NAMES = ("start", "chopping", "single_pulse")
BOUND = 2e-6
SAMPLE_BOUND = 5e-6  # cubic interpolation between the ends of a step


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", NAMES)
def test_currents_torque_and_speed_agree(library: ctypes.CDLL, name: str, form: str) -> None:
    run = run_of(library, name, form)
    expected, ends = run_reference(form, run)
    measured, _ = run_plant(library, form, run)
    assert np.max(expected["currents"]) > 10.0
    assert len(ends) >= 1, "the run is to contain an end of conduction"
    worst = deviation(measured, expected)
    assert max(worst.values()) < BOUND, worst


@pytest.mark.parametrize("form", FORMS)
def test_conduction_ends_within_the_nanosecond(library: ctypes.CDLL, form: str) -> None:
    run = single_pulse()
    _, ends = run_reference(form, run)
    ((phase, end_ns),) = ends
    assert phase == 0
    machine, state = machine_of(form), State()
    with plant_of(library, machine, run) as plant:
        for period, compares in enumerate(run.compares):
            set_switches(library, plant, compares, run.period_ticks)
            start_ns = period * run.period_ns
            if start_ns <= end_ns < start_ns + run.period_ns:
                library.plant_advance(plant, math.floor(end_ns) - 1)
                library.plant_library_read(plant, ctypes.byref(state))
                assert state.current_A[phase] > 0.0
                library.plant_advance(plant, math.ceil(end_ns) + 1)
                library.plant_library_read(plant, ctypes.byref(state))
                assert state.current_A[phase] == 0.0
            library.plant_advance(plant, start_ns + run.period_ns)
        library.plant_library_read(plant, ctypes.byref(state))
        assert list(state.current_A) == [0.0] * PHASES_MAX


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", ("chopping", "single_pulse"))
def test_samples_within_steps_agree_and_disturb_nothing(library: ctypes.CDLL, name: str, form: str) -> None:
    run = run_of(library, name, form)
    expected, _ = run_reference(form, run, sample_ns=1000)
    measured, watched = run_plant(library, form, run, sample_ns=1000)
    worst = deviation(measured, expected)
    assert max(worst.values()) < SAMPLE_BOUND, worst
    _, unwatched = run_plant(library, form, run)
    assert bytes(watched) == bytes(unwatched)


@pytest.mark.parametrize("form", FORMS)
def test_error_falls_with_the_fourth_power_of_the_step(library: ctypes.CDLL, form: str) -> None:
    # Long periods, so that the step's limits decide and not the switch edges.
    run = single_pulse(full=40_000, driven_ns=800_000)
    expected, _ = run_reference(form, run)
    errors = [max(deviation(run_plant(library, form, run, factor)[0], expected).values()) for factor in (4, 2, 1)]
    for coarse, fine in itertools.pairwise(errors):
        assert 10.0 < coarse / fine < 26.0, errors
