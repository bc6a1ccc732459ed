"""Vectorised reference: the model of reference_plant.py for many machines and runs, one row of NumPy arrays per run.

SciPy's DOP853 costs a Python call a stage; here its tableau and its error estimate (the attributes of the public class)
step all runs together, each at its own step length. As in reference_plant.py the state is flux linkages, speed
and angle, formulas follow their sources, and steps end at switch edges, where a flux linkage reaches zero and where the
magnetics are not smooth. test_plant_properties.py compares some runs with reference_plant.run_reference.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from reference_plant import FORMS, PHASES_MAX, Machine, Reference, Run, Trace, pattern
from scipy.integrate import DOP853

TOLERANCE = 1e-12  # per step, relative to the magnitude of the state
EVENT_TOLERANCE_S = 1e-16
CORNER_TOLERANCE_RAD = 1e-9
SPEED, ANGLE = PHASES_MAX, PHASES_MAX + 1  # columns of the state, after the flux linkages

Array = np.ndarray


class Machines:
    """Machine data of all runs, one row per run. The runs are in the order of FORMS, so each form is a slice."""

    def __init__(self, machines: Sequence[Machine]) -> None:
        forms = [machine.magnetics.form for machine in machines]
        assert forms == sorted(forms)
        references = [Reference(machine) for machine in machines]

        def column(name: str) -> Array:
            return np.array([getattr(reference, name, 0.0) for reference in references])[:, None]

        self.slices = {form: slice(forms.index(n), forms.index(n) + forms.count(n)) for n, form in enumerate(FORMS)}
        self.lu, self.la, self.ls = column("lu"), column("la"), column("ls")
        self.half_pitch, self.flat, self.blend = column("half_pitch"), column("flat"), column("blend")
        knee = self.slices["saturating"]
        self.a, self.b = column("a")[knee].astype(float), column("b")[knee].astype(float)
        self.resistance, self.inertia, self.friction = (
            np.array([getattr(machine, name) for machine in machines])[:, None]
            for name in ("resistance_ohm", "inertia_kg_m2", "friction_Nm_s")
        )
        phases = np.array([machine.phases for machine in machines])
        self.present = np.arange(PHASES_MAX) < phases[:, None]
        self.offset = np.arange(PHASES_MAX) * 2 * self.half_pitch / phases[:, None]
        width = max(1, *(len(reference.corners) for reference in references))
        self.corners = np.full((len(machines), width), np.nan)
        for row, reference in zip(self.corners, references, strict=True):
            row[: len(reference.corners)] = reference.corners

    def shape(self, angle: Array) -> tuple[Array, Array]:
        """f and df/dtheta of all phases at rotor angles (by row)."""
        wrapped = angle[:, None] - self.offset
        wrapped = wrapped - 2 * self.half_pitch * np.round(wrapped / (2 * self.half_pitch))
        x, sign = np.abs(wrapped), np.sign(wrapped)
        f, slope = np.empty_like(x), np.empty_like(x)

        at = self.slices["linear_cosine"]
        k = np.pi / self.half_pitch[at]
        f[at], slope[at] = (1 + np.cos(k * x[at])) / 2, -k / 2 * np.sin(k * x[at])

        at = self.slices["saturating"]
        k = 1 / self.half_pitch[at]
        f[at] = 1 + (k * x[at]) ** 2 * (2 * k * x[at] - 3)
        slope[at] = 6 * k * k * x[at] * (k * x[at] - 1)

        # The slope of a trapezoid with rounded corners is itself a trapezoid; f is 1 minus its area.
        at = self.slices["linear_trapezoid"]
        flat, blend = self.flat[at], self.blend[at]
        length = self.half_pitch[at] - 2 * flat
        y = np.clip(x[at] - flat, 0, length)
        height = 1 / (length - blend)
        slope[at] = -height * np.minimum(1, np.minimum(y, length - y) / blend)
        start, rest = np.minimum(y, blend), np.minimum(length - y, blend)
        straight = np.clip(y - blend, 0, length - 2 * blend)
        f[at] = 1 - height * (start**2 / (2 * blend) + straight + (blend**2 - rest**2) / (2 * blend))
        return f, sign * slope

    def flux(self, f: Array, current: Array) -> Array:
        g = self.la * current
        knee = self.slices["saturating"]
        i = current[knee]
        g[knee] = self.ls[knee] * i - self.a * np.expm1(-self.b * i)
        return (1 - f) * self.lu * current + f * g

    def current(self, f: Array, flux: Array) -> Array:
        """Inverse of flux(); Newton's method from the left converges monotonically, because flux() is concave."""
        current = flux / ((1 - f) * self.lu + f * self.la)
        knee = self.slices["saturating"]
        i, target, f = current[knee], flux[knee], f[knee]
        steep = (1 - f) * self.lu[knee] + f * self.ls[knee]
        for _ in range(60):
            fall = np.exp(-self.b * i)
            step = (target - steep * i - f * self.a * (1 - fall)) / (steep + f * self.a * self.b * fall)
            i += step
            if np.all(np.abs(step) <= 1e-15 + 1e-13 * np.abs(i)):
                break
        return current

    def torque(self, slope: Array, current: Array) -> Array:
        """Sum over the phases of the derivative of the co-energy by the angle."""
        energy = (self.la - self.lu) * current**2 / 2
        knee = self.slices["saturating"]
        i = current[knee]
        energy[knee] = (self.ls - self.lu)[knee] * i**2 / 2 + self.a * (i + np.expm1(-self.b * i) / self.b)
        return np.sum(slope * energy, axis=1)

    def smooth_range(self, angle: Array) -> tuple[Array, Array]:
        """The nearest smaller and larger rotor angles at which f of some phase is not smooth."""
        pitch = 2 * self.half_pitch
        following, previous = (self.corners - angle[:, None]) % pitch, (angle[:, None] - self.corners) % pitch
        following[~(following > CORNER_TOLERANCE_RAD)] = np.inf
        previous[~(previous > CORNER_TOLERANCE_RAD)] = np.inf
        return angle - previous.min(axis=1), angle + following.min(axis=1)


class Schedule:
    """Converter voltages of each run: pieces of constant voltage of whole nanoseconds."""

    def __init__(self, machines: Sequence[Machine], runs: Sequence[Run]) -> None:
        rows = []
        for machine, run in zip(machines, runs, strict=True):
            pieces = []
            for period, (upper, lower) in enumerate(run.compares):
                for start_ns, end_ns, on in pattern(run, upper, lower):
                    volts = [(number - 1) * machine.supply_voltage_V for number in on]
                    ends = period + 1 if end_ns == run.period_ns else 0
                    pieces.append((end_ns - start_ns, ends, [*volts, *[0.0] * (PHASES_MAX - len(volts))]))
            rows.append(pieces)
        longest = max(map(len, rows))
        self.count = np.array([len(pieces) for pieces in rows])
        self.length_s = np.zeros((len(rows), longest))
        self.period_end = np.zeros((len(rows), longest), dtype=int)  # period that ends here; 0: none
        self.volts = np.zeros((len(rows), longest, PHASES_MAX))
        for row, pieces in enumerate(rows):
            for index, (length_ns, ends, volts) in enumerate(pieces):
                self.length_s[row, index] = length_ns * 1e-9
                self.period_end[row, index] = ends
                self.volts[row, index] = volts


def run_batch(  # noqa: PLR0915 - one loop, whose arrays all of its parts share
        machines: Sequence[Machine], runs: Sequence[Run]) -> list[Trace]:
    """States at the start of each period and at the end, for runs of equal length; machines sorted by form."""
    rows = len(runs)
    all_rows = np.arange(rows)
    model, schedule = Machines(machines), Schedule(machines, runs)
    periods = len(runs[0].compares)
    load = np.array([run.load_torque_Nm for run in runs])
    supply = np.array([machine.supply_voltage_V for machine in machines])

    y = np.zeros((rows, PHASES_MAX + 2))
    start = np.zeros((rows, PHASES_MAX))
    for row, run in enumerate(runs):
        start[row, : len(run.currents_A)] = run.currents_A
        y[row, SPEED], y[row, ANGLE] = run.speed_rad_s, np.radians(run.angle_deg)
    f, _ = model.shape(y[:, ANGLE])
    y[:, :PHASES_MAX] = model.flux(f, start)
    record = np.empty((periods + 1, *y.shape))
    record[0] = y

    def derivative(y: Array, volts: Array, conducts: Array) -> Array:
        f, slope = model.shape(y[:, ANGLE])
        current = model.current(f, np.where(conducts, y[:, :PHASES_MAX], 0.0))
        result = np.empty_like(y)
        result[:, :PHASES_MAX] = np.where(conducts, volts - model.resistance * current, 0.0)
        drag = model.friction[:, 0] * y[:, SPEED] + load
        result[:, SPEED] = (model.torque(slope, current) - drag) / model.inertia[:, 0]
        result[:, ANGLE] = y[:, SPEED]
        return result

    at = np.zeros(rows, dtype=int)  # index of the piece
    elapsed_s = np.zeros(rows)  # of the piece
    longest_s = np.full(rows, 1e-6)  # step length that the error allows
    # Search for an event within a step: bracket, distances from the event at its ends, last trial.
    searching = np.zeros(rows, dtype=bool)
    low_s, high_s, low, high, last_s = (np.zeros(rows) for _ in range(5))
    side = np.zeros(rows, dtype=int)
    while True:
        running = at < schedule.count
        if not running.any():
            break
        piece = np.minimum(at, schedule.count - 1)
        volts = schedule.volts[all_rows, piece]
        conducts = model.present & ((volts > 0) | (y[:, :PHASES_MAX] > 0))
        falls = conducts & (volts < 0)
        previous, following = model.smooth_range(y[:, ANGLE])
        left_s = schedule.length_s[all_rows, piece] - elapsed_s
        with np.errstate(invalid="ignore", divide="ignore"):
            trial_s = low_s + (high_s - low_s) * low / (low - high)
        h = np.where(searching, trial_s, np.minimum(longest_s, left_s))
        h[~running] = 0.0

        stages = np.empty((DOP853.n_stages, *y.shape))
        for stage in range(DOP853.n_stages):
            change = np.tensordot(DOP853.A[stage, :stage], stages[:stage], 1) if stage else 0.0
            stages[stage] = derivative(y + h[:, None] * change, volts, conducts)
        end = y + h[:, None] * np.tensordot(DOP853.B, stages, 1)

        magnitude = np.empty_like(y)
        magnitude[:, :PHASES_MAX] = (np.abs(y[:, :PHASES_MAX]).max(axis=1) + 1e-6 * supply)[:, None]
        magnitude[:, SPEED], magnitude[:, ANGLE] = 1.0 + np.abs(y[:, SPEED]), 0.1
        fifth = np.sum((np.tensordot(DOP853.E5[:-1], stages, 1) / magnitude) ** 2, axis=1)
        third = np.sum((np.tensordot(DOP853.E3[:-1], stages, 1) / magnitude) ** 2, axis=1)
        scale = np.sqrt((fifth + 0.01 * third) * y.shape[1])
        error = np.divide(h * fifth, scale, out=np.zeros(rows), where=scale > 0) / TOLERANCE
        advice_s = h * np.clip(0.9 * np.maximum(error, 1e-12) ** -0.125, 0.2, 5.0)

        # Distance from the nearest event, in rad and in 1e-6 V s per V: negative when a step goes past it.
        fluxes = np.where(falls, end[:, :PHASES_MAX], np.inf).min(axis=1) / (1e-6 * supply)
        distance = np.minimum(fluxes, np.minimum(following - end[:, ANGLE], end[:, ANGLE] - previous))
        distance_start = np.where(falls, y[:, :PHASES_MAX], np.inf).min(axis=1) / (1e-6 * supply)
        distance_start = np.minimum(distance_start, np.minimum(following - y[:, ANGLE], y[:, ANGLE] - previous))
        beyond = distance < 0
        found = searching & ((np.abs(h - last_s) < EVENT_TOLERANCE_S) | (distance == 0))
        good = running & (error <= 1) & (found | ~(searching | beyond))
        failed = running & ~good & (found | ~(searching | beyond))
        begins = running & ~searching & beyond
        goes_on = searching & ~found

        longest_s = np.where(good & ~found, np.maximum(advice_s, 1e-9), longest_s)
        longest_s = np.where(failed, np.minimum(advice_s, 0.5 * h), longest_s)
        # Illinois method: the value at an end of the bracket that is retained twice is halved.
        up = goes_on & (distance > 0)
        down = goes_on & ~up
        high = np.where(up & (side > 0), 0.5 * high, high)
        low = np.where(down & (side < 0), 0.5 * low, low)
        low_s, low = np.where(up, h, np.where(begins, 0.0, low_s)), np.where(up, distance, low)
        high_s, high = np.where(down | begins, h, high_s), np.where(down | begins, distance, high)
        low = np.where(begins, distance_start, low)
        side = np.where(begins, 0, np.where(up, 1, np.where(down, -1, side)))
        last_s = np.where(begins | goes_on, h, last_s)
        searching = (searching & ~found) | begins

        y[good] = end[good]
        ended = good[:, None] & falls & (y[:, :PHASES_MAX] <= 1e-14 * supply[:, None])
        y[:, :PHASES_MAX][ended] = 0.0
        elapsed_s[good] += h[good]
        done = good & (left_s - h <= 1e-18)
        for row in np.flatnonzero(done & (schedule.period_end[all_rows, piece] > 0)):
            record[schedule.period_end[row, piece[row]], row] = y[row]
        at[done] += 1
        elapsed_s[done] = 0.0

    traces: list[Trace] = [{} for _ in runs]
    for number, state in enumerate(record):
        f, slope = model.shape(state[:, ANGLE])
        currents = model.current(f, state[:, :PHASES_MAX])
        torques = model.torque(slope, currents)
        for row, (machine, run) in enumerate(zip(machines, runs, strict=True)):
            columns = {
                "time_ns": number * run.period_ns,
                "angle": state[row, ANGLE],
                "speed": state[row, SPEED],
                "torque": torques[row],
                "currents": currents[row, : machine.phases],
                "fluxes": state[row, : machine.phases],
            }
            for name, value in columns.items():
                traces[row].setdefault(name, []).append(value)
    return [{name: np.array(values).T for name, values in trace.items()} for trace in traces]
