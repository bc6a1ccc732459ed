"""The experiments, and why in this order: poles of nothing are assumed but their number; wiring, direction and angles
are found first, coarsely, because the pulses of the map are chosen by them.

1. Rest, for the offsets of the current sensors; a small pulse of each phase, which shows a winding.
2. Each phase in turn pulls the rotor and is damped: order and direction of the phases, angle of the encoder.
3. Pulses to the limit from every angle of every phase while the rotor drifts: phase and window are chosen so that their
   torque keeps the speed. One phase alone carries current.
4. Spin-up by pulses, and coasting: inertia and friction.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from salient.bench.drive import Experiment
from salient.identify.link import CHARGES, RESTS, IdentifyError, Link

PULSE_LEVEL, HOLD_LEVEL, PROBE_LEVEL = 4095 / 4096, 0.3, 0.1
_STILL = 0.003 / (2.0 * math.pi)
"""Rotation below which the rotor has not moved, of a revolution."""
_QUIET = 0.02
"""Swing that is taken for rest, electrical, of a revolution."""
_HOLD_S, _HOLD_MAX_S, _DAMPED_MAX = 0.15, 3.0, 12
_FREEWHEEL_MS = 50
_LATENCY_S = 2.5e-3
_SLOWEST, _FASTEST = 0.7, 1.2
"""Parts of the drift speed, between which it is kept."""
_PATIENCE_S = 0.05
"""Wait for a window that is worth one pulse more of it."""
_SPIN_UP_MAX_S, _COAST_S = 2.5, 1.0


@dataclass(frozen=True)
class Pulse:
    """Records of a pulse, from its first period on. mapped: one of the map's pulses."""

    phase: int
    log: np.ndarray
    mapped: bool


@dataclass
class Findings:
    """Results of the experiments. position: angle of the encoder at which a phase is aligned, rev, by phase; order:
    strokes by which it comes after phase a, in the direction in which the encoder counts; times in s of the link."""

    phases: list[int]
    rotor_poles: int
    offset_A: np.ndarray
    noise_A: np.ndarray
    position: dict[int, float] = field(default_factory=dict)
    order: dict[int, int] = field(default_factory=dict)
    pulses: list[Pulse] = field(default_factory=list)
    counts: np.ndarray | None = None
    wired_us: int = 0
    mapped_us: int = 0

    def electrical(self, phase: int, turn: float) -> float:
        """Angle of a phase from its aligned position, 0 to below 1."""
        return (self.rotor_poles * (turn - self.position[phase])) % 1.0


class Sequence:
    """Runs the experiments of a link. phases, rotor_poles: of the name plate; tell: takes a line about the progress."""

    def __init__(self, link: Link, phases: int, rotor_poles: int, tell: Callable[[str], None]) -> None:
        self.link, self.tell = link, tell
        self.found = Findings([], rotor_poles, np.zeros(phases), np.zeros(phases))
        self._phases = phases
        self._driving = True

    # --- rest, windings -------------------------------------------------------------------------------------------

    def probe(self) -> None:
        """Offsets of the sensors by phase, and which phases have a winding. IdentifyError: less than three."""
        self.tell("rest: offsets of the current sensors; a pulse of each phase: which have a winding")
        for phase in range(self._phases):
            log = self.link.run(Experiment("rest", phase), 0.02)
            log = log[(log["phase"] == phase)]
            self.found.offset_A[phase] = log["current_A"].mean() if len(log) else 0.0
            self.found.noise_A[phase] = log["current_A"].std() if len(log) else 0.0
        for phase in range(self._phases):
            log = self._pulse(Experiment("pulse", phase, PROBE_LEVEL), keep=False)
            if log["current_A"].max() > 0.3 * PROBE_LEVEL * self.link.limit_A:
                self.found.phases.append(phase)
        if len(self.found.phases) < self._phases:
            missing = ", ".join("abcdef"[phase] for phase in range(self._phases) if phase not in self.found.phases)
            raise IdentifyError(f"phase {missing}: no current at full voltage: no winding, or no switch")

    def _pulse(self, experiment: Experiment, timeout_s: float = 0.3, keep: bool = True, mapped: bool = False
               ) -> np.ndarray:
        log = self.link.run(experiment, timeout_s)
        fired = (log["state"] >= CHARGES) & (log["state"] <= RESTS)
        if keep and fired.any():
            self.found.pulses.append(Pulse(experiment.phase, log[fired], mapped))
        return log

    # --- wiring, direction, rough angles -----------------------------------------------------------------------------

    def align(self) -> None:
        """Positions and order of the phases; pulses of long freewheeling at each. IdentifyError: they contradict the
        number of poles."""
        self.tell(f"hold: each phase pulls the rotor with {HOLD_LEVEL:.0%} of the limit and is damped: order, "
                  "direction, angles")
        phases = [*self.found.phases, self.found.phases[0]]
        places: list[float] = []
        for number, phase in enumerate(phases):
            place, moved = self._settle(phase)
            if moved < _STILL and number > 0:  # an unstable equilibrium: another phase moves the rotor out of it
                self.link.run(Experiment("hold", self._other(phases, number), HOLD_LEVEL), 0.05)
                place, moved = self._settle(phase)
            places.append(place)
            self._resistance(phase)
        stroke = 1.0 / (len(self.found.phases) * self.found.rotor_poles)
        for phase, place in zip(self.found.phases, places, strict=False):
            strokes = (place - places[0]) / stroke
            self.found.position[phase] = place
            self.found.order[phase] = round(strokes) % len(self.found.phases)
        if sorted(self.found.order.values()) != list(range(len(self.found.phases))):
            raise IdentifyError(f"the phases pull the rotor to {', '.join(f'{360 * place:.2f}' for place in places)} "
                                f"degrees: not those of {self.found.rotor_poles} rotor poles, or the rotor is blocked")
        self.found.wired_us = int(self.link.log["time_us"][-1])

    @staticmethod
    def _other(phases: list[int], number: int) -> int:
        return next(phase for phase in phases if phase not in (phases[number], phases[number - 1]))

    def _hold(self, phase: int, duration_s: float, centre: float | None) -> np.ndarray:
        kind = "hold" if centre is None else "damped"
        angle = 0.0 if centre is None else min(centre % 1.0, 65535 / 65536)
        return self.link.run(Experiment(kind, phase, HOLD_LEVEL, angle=angle), duration_s)["turn"]

    def _settle(self, phase: int) -> tuple[float, float]:
        """Where a phase holds the rotor, and how far that was, rev."""
        turns = self._hold(phase, _HOLD_S, None)
        while len(turns) * 1e-3 < _HOLD_MAX_S and np.ptp(turns) >= _STILL and len(turning_points(turns)) < 3:
            turns = np.concatenate([turns, self._hold(phase, _HOLD_S, None)])
        moved, span_s = float(np.ptp(turns)), max(len(turns) * 1e-3, 0.1)
        quiet = _QUIET / self.found.rotor_poles
        for _ in range(_DAMPED_MAX):
            if np.ptp(turns[len(turns) // 2:]) < quiet:
                break
            turns = self._hold(phase, max(0.5 * span_s, 0.15), centre_of(turns))
        tail = turns[len(turns) // 2:]
        return float((tail.max() + tail.min()) / 2.0), moved

    def _resistance(self, phase: int) -> None:
        self.link.rest(0.01)
        for part in (0.25, 0.5, 1.0):
            self._pulse(Experiment("freewheel", phase, part * PULSE_LEVEL, _FREEWHEEL_MS))

    # --- map ---------------------------------------------------------------------------------------------------------

    def map(self, bins: int, repeats: int, max_s: float) -> None:
        """Pulses until each window of each phase has had `repeats`, or for max_s. IdentifyError: the rotor cannot be
        kept turning."""
        found, link = self.found, self.link
        star = 1.0 / found.rotor_poles / 0.25  # rev/s: an electrical revolution in 1/4 s
        self.tell(f"drift at about {60 * star:.0f} r/min: pulses to the limit from {bins} windows of each phase, "
                  f"{repeats} of each")
        counts = found.counts = np.zeros((len(found.phases), bins), int)
        begin_s, told_s = link.time_s, link.time_s
        log = link.rest(0.01)
        direction = 1
        while counts.min() < repeats and link.time_s - begin_s < max_s:
            speed, turn = self._motion(log)
            if abs(speed) > 0.05 * star:
                direction = 1 if speed > 0 else -1
            sign = direction if self._drives(abs(speed) / star) else -direction
            choice = self._choose(counts, star, speed, turn, direction, sign)
            if choice is None:
                raise IdentifyError("no phase can move the rotor")
            row, window, arrival_s, at_once = choice
            phase = found.phases[row]
            if at_once:
                log = self._pulse(Experiment("pulse", phase, PULSE_LEVEL), mapped=True)
            else:
                log = self._pulse(self._windowed(phase, window, bins, turn, direction),
                                  timeout_s=min(1.5 * arrival_s + 0.02, 0.5), mapped=True)
            fired = log[log["state"] == CHARGES]
            if len(fired):
                place = found.electrical(phase, float(fired["turn"][0])) * bins
                # A pulse at the edge of a window is one of it, wherever the encoder's count begins.
                near = abs((place - window - 0.5 + bins / 2.0) % bins - bins / 2.0) < 0.75
                counts[row, window if near else int(place) % bins] += 1
            log = log if len(log) > 4 else link.rest(0.003)
            if link.time_s - told_s > 2.0:
                told_s = link.time_s
                self.tell(f"  {counts.clip(max=repeats).sum()} of {counts.size * repeats} windows, "
                          f"{60 * speed:+.0f} r/min")
        found.mapped_us = int(link.log["time_us"][-1])

    def _drives(self, speed: float) -> bool:
        """Whether the next pulse is to drive, by the speed, part of the drift speed: until it is above 1.2 of it, and
        then not before it is below 0.7 of it."""
        if speed > _FASTEST or speed < _SLOWEST:
            self._driving = speed < _SLOWEST
        return self._driving

    def _windowed(self, phase: int, window: int, bins: int, turn: float, direction: int) -> Experiment:
        """A pulse at the next passage of a window: its begin in the direction of counting."""
        found = self.found
        ahead = (direction * ((window + 0.5) / bins - found.electrical(phase, turn))) % 1.0
        centre = turn + direction * ahead / found.rotor_poles
        width = 1.0 / bins / found.rotor_poles
        return Experiment("pulse", phase, PULSE_LEVEL, 500, angle=min((centre - width / 2.0) % 1.0, 65535 / 65536),
                          width=width)

    def _motion(self, log: np.ndarray) -> tuple[float, float]:
        """Speed, rev/s, and angle, rev, by the last records."""
        part = self.link.log[-60:]
        part = part[part["time_us"] > part["time_us"][-1] - 6000]
        time_s = (part["time_us"] - part["time_us"][-1]) * 1e-6
        if len(part) < 4 or time_s[0] > -1.5e-3:
            return 0.0, float(part["turn"][-1])
        return float(np.polyfit(time_s, part["turn"], 1)[0]), float(part["turn"][-1])

    def _choose(self, counts: np.ndarray, star: float, speed: float, turn: float, direction: int, sign: int
                ) -> tuple[int, int, float, bool] | None:
        """Row and window of the next pulse, the time to it, and whether it is one at once: of those whose torque has
        the sign, that with few pulses which comes soon."""
        found, bins = self.found, counts.shape[1]
        half = slice(bins // 2, bins) if direction > 0 else slice(0, bins // 2)
        slow, weak = abs(speed) < 0.2 * star, self._driving and bool(counts[:, half].min() >= counts.mean() - 0.5)
        best: tuple[float, int, int, float, bool] | None = None
        for row, phase in enumerate(found.phases):
            place = found.electrical(phase, turn + speed * _LATENCY_S)
            for window in range(bins):
                centre = (window + 0.5) / bins
                if (-1 if centre < 0.5 else 1) != sign:
                    continue
                ahead = (direction * (centre - place)) % 1.0
                arrival_s = ahead / found.rotor_poles / max(abs(speed), 0.2 * star)
                cost = counts[row, window] + arrival_s / _PATIENCE_S
                if weak:  # the rotor has to gain speed
                    cost += 4.0 * math.cos(2.0 * math.pi * centre) ** 2
                if slow:
                    if math.sin(2.0 * math.pi * centre) ** 2 < 0.1:
                        continue
                    cost = counts[row, window] + 100.0 * min(ahead, 1.0 - ahead)
                if best is None or cost < best[0]:
                    best = (cost, row, window, arrival_s, slow)
        return None if best is None else best[1:]

    # --- shaft -------------------------------------------------------------------------------------------------------

    def spin(self, speed_rpm: float) -> None:
        """Spins the rotor up by pulses, and lets it coast."""
        link, found = self.link, self.found
        self.tell(f"spin-up to {speed_rpm:.0f} r/min, coasting for {_COAST_S:g} s: inertia, friction")
        begin_s = link.time_s
        log = link.rest(0.005)
        while link.time_s - begin_s < _SPIN_UP_MAX_S:
            speed, turn = self._motion(log)
            if abs(speed) * 60.0 >= speed_rpm:
                break
            direction = 1 if speed >= 0.0 else -1
            at = turn + speed * _LATENCY_S
            phase = max(found.phases, key=lambda each: -direction * math.sin(
                2.0 * math.pi * found.electrical(each, at)))
            log = self._pulse(Experiment("pulse", phase, PULSE_LEVEL))
        link.rest(_COAST_S)
        link.check()


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
