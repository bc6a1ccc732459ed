"""The experiments, and why in this order: poles of nothing are assumed but their number; wiring, direction and angles
are found first, coarsely, because the pulses of the map are chosen by them.

1. Rest, for the offsets of the current sensors; a small pulse of each phase, which shows a winding.
2. Each phase in turn pulls the rotor and is damped: order and direction of the phases, angle of the encoder.
3. Pulses to the limit from every angle of every phase while the rotor drifts: phase and window are chosen so that their
   torque keeps the speed. One phase alone carries current.
4. Spin-up by pulses, and coasting: inertia and friction.

A load that turns the rotor by itself is found at rest. Then step 2 is small pulses on the turning rotor, whose rise of
the current shows the inductances by the angle: a hold would have to be stronger than the load. Pulses against the load
keep the speed of all that follows, and coasting is through standstill.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field

import numpy as np

from salient.bench.drive import Experiment
from salient.identify.link import CHARGES, HOLD_RECORD_S, RESTS, IdentifyError, Link
from salient.identify.readings import centre_of, covered, folded, inductance_of, lacking_side, pull, turning_points

PULSE_LEVEL, PUSH_LEVEL, HOLD_LEVEL, TURNING_LEVEL, PROBE_LEVEL = 0.98, 0.5, 0.3, 0.25, 0.1
"""Parts of the current limit; a pulse may exceed its level by a prediction's error, the drive ends all at 3 %."""
_STILL = 0.003 / (2.0 * math.pi)
"""Rotation below which the rotor has not moved, of a revolution."""
_QUIET = 0.02
"""Swing that is taken for rest, electrical, of a revolution."""
_HOLD_S, _HOLD_MAX_S, _DAMPED_MAX = 0.15, 3.0, 12
_FREEWHEEL_MS = 50
_LATENCY_S, _LEAD_S = 2.5e-3, 1.25e-3
"""Time to the start of an experiment; less for a push, whose current has to end in time."""
_SLOW, _SLOWEST, _FASTEST = 0.2, 0.7, 1.2
"""Parts of the drift speed: below the first the rotor stands, between the others it is kept."""
_PULSE_S = 0.02
"""Time in which the bus takes the records of a pulse."""
_NOISY_PART, _AVERAGED, _AVERAGED_S = 2.5e-4, 2, 16.0
"""Noise of the currents, part of the limit, from which a map has that many times the pulses, within that time."""
_LOSS_PART = 0.65
"""Part of the copper loss that the drive permits, at which the map ends."""
_SPIN_UP_MAX_S, _COAST_S, _COAST_STEP_S = 2.5, 1.0, 0.01
_REST_S, _REST_LOADED_S, _REST_MORE_S = 0.02, 0.005, 0.002
"""Times of rest: without a load, until one is found, and then for each other phase."""
_DRIFT_LOADED_S = 0.03
"""Time in which a load would stop the drifting rotor, at least."""
_PROBE_PERIODS, _PROBES, _PROBE_MAX_S = 0.5, 3, 3.0
"""Electrical periods and pulses of each phase that show the inductances of a turning rotor, at least; at most that
long."""
_APART = 0.5
"""Least rotation from where one phase holds the rotor to where the next one does, strokes."""
_OFF = 0.4
"""Largest distance of a phase from its place in the order, strokes."""
_CLEARER = 4.0
"""Sum of squares of the second best order of the phases by the one of the best, from which that is believed."""
_PUSH_MIN_S, _PUSH_S, _DECAY_S, _PUSH_PART = 0.003, 0.016, 0.004, 0.3
"""Duration of a push; at most that part of an electrical period, so that its torque keeps its sign."""
_UNMOVED_MAX, _PATH = 40, 5
"""Pushes that have not moved the rotor, at most; places of the rotor in a push by which its phase is chosen."""
_SMALL_PART = 0.2
"""Current at which no iron is saturated, of the limit."""
_REFINED = 6
"""Pulses of a phase that show where it is aligned, at least."""
_PLACES = 24
"""Places in an electrical period whose mean inductances count alike."""
_SPREAD = 0.1
"""Least singular value of a harmonic at such places by the root of their number: 0.7 of an even spread."""
_LEAST_SALIENCY = 0.2
"""Amplitude of the inductance by its mean, below which it does not vary with the angle."""


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
        self._load = 0.0
        """Acceleration by a load that turns the rotor, rev/s^2; 0 of a rotor that stays where it is."""
        self._wound: dict[int, np.ndarray] = {}
        """Records of the pulses that showed the windings, by phase."""
        self._missed: dict[tuple[int, int], int] = {}
        """Successive pulses of a phase from a window that the rotor has not reached."""
        self._pushed: int | None = None
        """Phase of the last push, whose current may not have ended."""
        self._from, self._unmoved = 0.0, 0
        """Angle at which the last push began, rev; pushes that have not moved the rotor from there."""

    # --- rest, windings -------------------------------------------------------------------------------------------

    def probe(self) -> None:
        """Offsets of the sensors by phase, and which phases have a winding. IdentifyError: less than three."""
        self.tell("rest: offsets of the current sensors; a pulse of each phase: which have a winding")
        for phase in range(self._phases):
            log = self.link.run(Experiment("rest", phase), _REST_MORE_S if self._load else _REST_LOADED_S)
            self._find_load()
            if not self._load:
                log = np.concatenate([log, self.link.run(Experiment("rest", phase), _REST_S - _REST_LOADED_S)])
            log = log[(log["phase"] == phase)]
            self.found.offset_A[phase] = log["current_A"].mean() if len(log) else 0.0
            self.found.noise_A[phase] = log["current_A"].std() if len(log) else 0.0
        for phase in range(self._phases):
            log = self._pulse(Experiment("pulse", phase, PROBE_LEVEL), keep=False)
            if log["current_A"].max() > 0.3 * PROBE_LEVEL * self.link.limit_A:
                self.found.phases.append(phase)
            self._wound[phase] = log
        if len(self.found.phases) < self._phases:
            missing = ", ".join("abcdef"[phase] for phase in range(self._phases) if phase not in self.found.phases)
            raise IdentifyError(f"phase {missing}: no current at full voltage: no winding, or no switch")

    def _find_load(self) -> None:
        """By the records so far, all of them at rest."""
        log = self.link.log
        if np.ptp(log["turn"]) > _STILL:
            time_s = (log["time_us"] - log["time_us"][-1]) * 1e-6
            self._load = 2.0 * float(np.polyfit(time_s, log["turn"], 2)[0])

    def _pulse(self, experiment: Experiment, timeout_s: float = 0.3, keep: bool = True, mapped: bool = False
               ) -> np.ndarray:
        log = self.link.run(experiment, timeout_s)
        fired = (log["state"] >= CHARGES) & (log["state"] <= RESTS)
        if keep and fired.any() and not self.link.interrupts(log):
            self.found.pulses.append(Pulse(experiment.phase, log[fired], mapped))
        return log

    # --- wiring, direction, rough angles -----------------------------------------------------------------------------

    def align(self) -> None:
        """Positions and order of the phases; pulses of long freewheeling at each. IdentifyError: they contradict the
        number of poles."""
        if self._load:
            self._align_turning()
            return
        self.tell(f"hold: each phase pulls the rotor with {HOLD_LEVEL:.0%} of the limit and is damped: order, "
                  "direction, angles")
        phases = self.found.phases
        places = self._hold_each([*phases, phases[0]])
        # The first hold may have found the rotor where friction holds it against the phase, opposite to its poles.
        self._order([places[-1], *places[1:-1]])
        if self._common_strokes(places[1:]) > 1:  # by chance, by the wiring, or fewer poles: in another order
            count = len(phases)
            places += self._hold_each([phases[2 * k % count if count % 2 else -k] for k in range(count)])
            factor = self._common_strokes(places[1:])
            if factor > 1:
                raise IdentifyError(f"each phase pulls the rotor by a multiple of {factor} strokes of "
                                    f"{self.found.rotor_poles} rotor poles: it has fewer")
        self.found.wired_us = int(self.link.log["time_us"][-1])

    def _hold_each(self, phases: list[int]) -> list[float]:
        """Where phases hold the rotor, one after the other."""
        places: list[float] = []
        apart = _APART / len(self.found.phases) / self.found.rotor_poles
        for number, phase in enumerate(phases):
            place, moved = self._settle(phase)
            if moved < apart and number > 0:  # an unstable equilibrium: another phase moves the rotor out of it
                self.link.run(Experiment("hold", self._other(phases, number), HOLD_LEVEL), 0.05)
                place, moved = self._settle(phase)
            places.append(place)
            self.link.rest(0.01)
            self._resistance(phase)
        return places

    def _common_strokes(self, places: list[float]) -> int:
        """Largest number of strokes of which all rotations between places are multiples."""
        stroke = 1.0 / (len(self.found.phases) * self.found.rotor_poles)
        return math.gcd(*(round((place - places[0]) / stroke) for place in places[1:]))

    def _order(self, places: list[float]) -> None:
        """Positions and order of the phases by where each of them is aligned, rev: the order that explains all places
        best, whose common origin has the mean of their errors, which friction makes."""
        count = len(self.found.phases)
        stroke = 1.0 / (count * self.found.rotor_poles)
        strokes = (np.array(places) - places[0]) / stroke
        fits = []
        for others in itertools.permutations(range(1, count)):
            left = 2.0 * math.pi * (strokes - [0, *others]) / count
            origin = float(np.angle(np.exp(1j * left).mean()))
            off = float(np.abs(np.angle(np.exp(1j * (left - origin)))).max())
            fits.append((off * count / (2.0 * math.pi), origin * count / (2.0 * math.pi), (0, *others)))
        off, origin, order = min(fits)
        for phase, each in zip(self.found.phases, order, strict=True):
            self.found.position[phase] = places[0] + (origin + each) * stroke
            self.found.order[phase] = each
        if off > _OFF:
            raise IdentifyError(f"the phases pull the rotor to {', '.join(f'{360 * place:.2f}' for place in places)} "
                                f"degrees: not those of {self.found.rotor_poles} rotor poles, or the rotor is blocked")

    def _align_turning(self) -> None:
        """As align, of a rotor that the load turns: the inductance of a phase is largest where it is aligned."""
        link, found = self.link, self.found
        self.tell(f"a load turns the rotor, {60.0 * self._load:+.0f} r/min a second: small pulses show the inductances "
                  "by the angle: order, direction, angles")
        small_A = _SMALL_PART * link.limit_A
        shown = {phase: inductance_of(log, small_A) for phase, log in self._wound.items()}
        begin, begin_s = float(next(iter(self._wound.values()))["turn"][0]), link.time_s
        levels = dict.fromkeys(found.phases, PROBE_LEVEL)
        while (abs(float(link.log["turn"][-1]) - begin) * found.rotor_poles < _PROBE_PERIODS
               or min(map(len, shown.values())) < _PROBES or (places := self._places(shown)) is None):
            if link.time_s - begin_s > _PROBE_MAX_S:
                raise IdentifyError("a load turns the rotor, but the inductances do not show its poles: they turn too "
                                    f"slowly, or are not {found.rotor_poles}")
            for phase in found.phases:
                seen = inductance_of(self._pulse(Experiment("pulse", phase, levels[phase]), keep=False), small_A)
                shown[phase] += seen
                if not seen:
                    levels[phase] = TURNING_LEVEL  # a period at full voltage is too long for the smaller one
        self._order(places)
        for phase in found.phases:
            self._resistance(phase)
        self._settle_speed()
        found.wired_us = int(link.log["time_us"][-1])

    def _places(self, shown: Mapping[int, Collection[tuple[float, float]]]) -> list[float] | None:
        """Positions of the phases by the first harmonic of their inductances, rev, in the order that explains these
        best; None while another one does nearly as well."""
        found, poles = self.found, self.found.rotor_poles
        turn, inductance = np.array([each for phase in found.phases for each in shown[phase]]).T
        row = np.repeat(np.arange(len(found.phases)), [len(shown[phase]) for phase in found.phases])
        fits = []
        for others in itertools.permutations(range(1, len(found.phases))):
            strokes = np.array([0, *others]) / len(found.phases)
            angle = 2.0 * math.pi * (poles * turn - strokes[row])
            design = np.column_stack([np.ones(len(angle)), np.cos(angle), np.sin(angle)])
            x = np.linalg.lstsq(design, inductance, rcond=None)[0]
            fits.append((float(np.sum((inductance - design @ x) ** 2)), strokes, x))
        fits.sort(key=lambda each: each[0])
        _, strokes, (mean, cosine, sine) = fits[0]
        if fits[1][0] < _CLEARER * fits[0][0] or math.hypot(cosine, sine) < _LEAST_SALIENCY * mean:
            return None
        return [float(math.atan2(sine, cosine) / (2.0 * math.pi) + stroke) / poles for stroke in strokes]

    def _refine(self) -> None:
        """Angles of the phases by the first rise of all pulses of the map: friction or a load keeps a held rotor from
        the aligned position, and the fit converges from near it."""
        found, small_A = self.found, _SMALL_PART * self.link.limit_A
        for phase in found.phases:
            shown = [each for pulse in found.pulses if pulse.phase == phase and pulse.mapped
                     for each in inductance_of(pulse.log, small_A)]
            moved = (self._aligned(phase, shown) - found.position[phase]) * found.rotor_poles
            found.position[phase] += math.remainder(moved, 1.0) / found.rotor_poles

    def _aligned(self, phase: int, shown: Collection[tuple[float, float]]) -> float:
        """Where the inductance of a phase is largest, rev, by its first harmonic. IdentifyError: it does not vary."""
        if len(shown) < _REFINED:
            raise IdentifyError(f"phase {'abcdef'[phase]}: no rise of the current to see its inductance by")
        turn, inductance = np.array(list(shown)).T
        place = np.round(turn * self.found.rotor_poles * _PLACES) % _PLACES
        known = np.unique(place)
        inductance = np.array([inductance[place == each].mean() for each in known])  # many pulses at a place are one
        angle = np.array([np.angle(np.exp(2j * math.pi * self.found.rotor_poles * turn[place == each]).mean())
                          for each in known])
        design = np.column_stack([np.ones(len(angle)), np.cos(angle), np.sin(angle)])
        if len(known) < 3 or np.linalg.svd(design, compute_uv=False)[-1] < _SPREAD * math.sqrt(len(known)):
            raise IdentifyError(f"phase {'abcdef'[phase]}: all its pulses are near the same angle, which does not show "
                                "where its inductance is largest")
        mean, cosine, sine = np.linalg.lstsq(design, inductance, rcond=None)[0]
        if math.hypot(cosine, sine) < _LEAST_SALIENCY * mean:
            raise IdentifyError(f"phase {'abcdef'[phase]}: its inductance does not vary with the angle of "
                                f"{self.found.rotor_poles} rotor poles")
        return math.atan2(sine, cosine) / (2.0 * math.pi * self.found.rotor_poles)

    @staticmethod
    def _other(phases: list[int], number: int) -> int:
        return next(phase for phase in phases if phase not in (phases[number], phases[number - 1]))

    def _hold(self, phase: int, duration_s: float, centre: float | None, level: float = HOLD_LEVEL) -> np.ndarray:
        kind = "hold" if centre is None else "damped"
        angle = 0.0 if centre is None else min(centre % 1.0, 65535 / 65536)
        return self.link.run(Experiment(kind, phase, level, angle=angle), duration_s)["turn"]

    def _settle(self, phase: int) -> tuple[float, float]:
        """Where a phase holds the rotor, and how far that was, rev."""
        quiet = _QUIET / self.found.rotor_poles
        turns = last = self._hold(phase, _HOLD_S, None)
        while (len(turns) * HOLD_RECORD_S < _HOLD_MAX_S and np.ptp(turns) >= _STILL and np.ptp(last) >= quiet
               and len(turning_points(turns)) < 3):
            last = self._hold(phase, _HOLD_S, None)
            turns = np.concatenate([turns, last])
        moved, span_s = float(np.ptp(turns)), max(len(turns) * HOLD_RECORD_S, 0.1)
        for _ in range(_DAMPED_MAX):
            if np.ptp(turns[len(turns) // 2:]) < quiet:
                break
            turns = self._hold(phase, max(0.5 * span_s, 0.15), centre_of(turns))
        # Friction may have stopped it anywhere, with a quarter of the current.
        turns = self._hold(phase, _HOLD_S, None, PUSH_LEVEL)
        if np.ptp(turns) >= quiet:
            return centre_of(turns), moved
        tail = turns[len(turns) // 2:]
        return float((tail.max() + tail.min()) / 2.0), moved

    def _resistance(self, phase: int) -> None:
        for part in (0.25, 0.5, 1.0):
            if self._load:
                self._settle_speed()
            self._pulse(Experiment("freewheel", phase, part * PULSE_LEVEL, _FREEWHEEL_MS))

    # --- map ---------------------------------------------------------------------------------------------------------

    @property
    def _drift(self) -> float:
        """Speed of the drifting rotor, rev/s: an electrical revolution in 1/4 s, or more where a load changes it."""
        return max(1.0 / self.found.rotor_poles / 0.25, abs(self._load) * _DRIFT_LOADED_S)

    def _settle_speed(self) -> None:
        """Against the load, until the rotor drifts. IdentifyError: the pulses are weaker than the load."""
        direction, begin_s, log = self._against_load, self.link.time_s, self.link.log
        while True:
            speed, turn = self._motion(log)
            part = speed * direction / self._drift
            if _SLOWEST < part < 2.0 * _FASTEST:
                self._end_push()
                return
            if self.link.time_s - begin_s > _SPIN_UP_MAX_S:
                raise IdentifyError("pulses cannot turn the rotor against its load")
            log = self.link.rest(0.005) if part > _SLOWEST else self._push(direction, speed, turn)

    @property
    def _against_load(self) -> int:
        return -1 if self._load > 0.0 else 1

    def _push(self, direction: int, speed: float, turn: float) -> np.ndarray:
        """A moment of the phase with the most torque in a direction, at half of the limit: a hold, because its records
        are few, while a pulse's keep the bus busy for longer than it lasts."""
        found = self.found
        duration_s = min(_PUSH_S, max(_PUSH_MIN_S, _PUSH_PART / found.rotor_poles / max(abs(speed), 1e-3)))
        path = turn + speed * (_LEAD_S + np.linspace(0.0, duration_s, _PATH))
        ranked = sorted(found.phases, key=lambda each: -direction * sum(pull(found.electrical(each, float(at)))
                                                                        for at in path))
        self._unmoved = self._unmoved + 1 if abs(speed) < _SLOW * self._drift and abs(turn - self._from) < _STILL else 0
        if self._unmoved > _UNMOVED_MAX:
            raise IdentifyError("no phase can move the rotor")
        self._from = turn
        phase = ranked[self._unmoved // 2 % 2]  # one whose torque is less than its friction may be followed by another
        if found.wired_us and speed * direction > -0.5 * self._drift:  # the shaft is found by the records; but first
            self._end_push(phase)  # a rotor that the load turns away has to be caught
        self._pushed = phase
        return self.link.run(Experiment("hold", phase, PUSH_LEVEL), duration_s)

    def _end_push(self, phase: int | None = None) -> None:
        """Waits for the end of the current of a push before another phase has the records, which have its torque."""
        if self._pushed not in (None, phase):
            self.link.run(Experiment("rest", self._pushed), _DECAY_S)
            self._pushed = None

    def map(self, bins: int, repeats: int, max_s: float) -> None:
        """Pulses until each window has had `repeats` of each phase and side on the mean, or for max_s, or until the
        windings have had most of their copper loss. IdentifyError: the rotor cannot be kept turning."""
        found, link = self.found, self.link
        star = self._drift
        self.tell(f"drift at about {60 * star:.0f} r/min: pulses to the limit from {bins} windows of each phase, "
                  f"{repeats} of each")
        counts = found.counts = np.zeros((len(found.phases), bins), int)
        begin_s, told_s = link.time_s, link.time_s
        log = link.rest(0.01)
        direction = self._against_load
        noisy = float(found.noise_A.mean()) > _NOISY_PART * link.limit_A
        while link.time_s - begin_s < max_s and not covered(counts, repeats * (
                _AVERAGED if noisy and link.time_s - begin_s < _AVERAGED_S else 1)):
            speed, turn = self._motion(log)
            if abs(speed) > 0.05 * star and not self._load:
                direction = 1 if speed > 0 else -1
            drives = self._drives(speed * direction / star)
            if drives if self._load else abs(speed) < _SLOW * star:
                log = self._push(direction, speed, turn)
                continue
            self._end_push()
            had = len(found.pulses)
            if self._load:  # up to the drift speed, and down to it the other way, while the load turns the rotor back
                window, log = self._measure_falling(counts, star, speed, turn)
            else:
                window, log = self._measure(counts, star, speed, turn, direction)
            fired = log[log["state"] == CHARGES]
            if len(fired) and len(found.pulses) > had:
                phase = int(fired["phase"][0])
                row = found.phases.index(phase)
                place = found.electrical(phase, float(fired["turn"][0])) * bins
                # A pulse at the edge of a window is one of it, wherever the encoder's count begins.
                near = abs((place - window - 0.5 + bins / 2.0) % bins - bins / 2.0) < 0.75
                counts[row, window if near else int(place) % bins] += 1
            log = log if len(log) > 4 else link.rest(0.003)
            if link.time_s - told_s > 2.0:
                told_s = link.time_s
                loss = link.loss_part(found.phases)
                if loss > _LOSS_PART:
                    self.tell("  the windings have had most of their copper loss: the map ends here")
                    break
                wanted = counts.size * repeats
                self.tell(f"  {folded(counts).clip(max=2 * len(counts) * repeats).sum()} of {wanted} pulses, "
                          f"{60 * speed:+.0f} r/min, {loss:.0%} of the permitted copper loss")
        found.mapped_us = int(link.log["time_us"][-1])
        self._refine()

    def _measure(self, counts: np.ndarray, star: float, speed: float, turn: float, direction: int
                 ) -> tuple[int, np.ndarray]:
        """A pulse from a window that has had few; its torque keeps the speed, unless a load brakes. Window and records.
        IdentifyError: the rotor cannot be moved."""
        sign = 0 if self._load else lacking_side(counts) or (direction if self._driving else -direction)
        choice = self._choose(counts, star, speed, turn, direction, sign)
        if choice is None:
            raise IdentifyError("no phase can move the rotor")
        row, window, arrival_s = choice
        log = self._pulse(self._windowed(self.found.phases[row], window, counts.shape[1], turn, direction),
                          timeout_s=min(1.5 * arrival_s + 0.02, 0.5), mapped=True)
        fired = bool((log["state"] == CHARGES).any())
        self._missed[row, window] = 0 if fired else self._missed.get((row, window), 0) + 1
        return window, log

    def _measure_falling(self, counts: np.ndarray, star: float, speed: float, turn: float) -> tuple[int, np.ndarray]:
        """As _measure, of a rotor that a load turns back: near standstill at once, of the phase whose present window
        has had the fewest."""
        if abs(speed) > _SLOW * star:
            return self._measure(counts, star, speed, turn, 1 if speed > 0.0 else -1)
        bins = counts.shape[1]
        windows = [int(self.found.electrical(phase, turn) * bins) % bins for phase in self.found.phases]
        row = min(range(len(windows)), key=lambda each: counts[each, windows[each]])
        return windows[row], self._pulse(Experiment("pulse", self.found.phases[row], PULSE_LEVEL), mapped=True)

    def _drives(self, speed: float) -> bool:
        """Whether the next pulse is to drive, by the speed, part of the drift speed: until it is above 1.2 of it, and
        then not before it is below 0.7 of it. With a load between 0.7 of it and half of it the other way."""
        slowest, fastest = (-0.5, _SLOWEST) if self._load else (_SLOWEST, _FASTEST)
        if speed > fastest or speed < slowest:
            self._driving = speed < slowest
        return self._driving

    def _windowed(self, phase: int, window: int, bins: int, turn: float, direction: int) -> Experiment:
        """A pulse at the next passage of a window: its start in the direction of counting."""
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
                ) -> tuple[int, int, float] | None:
        """Row and window of the next pulse, and the time to it: of those whose torque has the sign, or of all with a
        sign of 0, that whose pulse tells most by its time."""
        found, bins = self.found, counts.shape[1]
        of_window = folded(counts)
        best: tuple[float, int, int, float] | None = None
        for row, phase in enumerate(found.phases):
            place = found.electrical(phase, turn + speed * _LATENCY_S)
            for window in range(bins):
                centre = (window + 0.5) / bins
                if sign and (-1 if centre < 0.5 else 1) != sign:
                    continue
                ahead = (direction * (centre - place)) % 1.0
                arrival_s = ahead / found.rotor_poles / max(abs(speed), _SLOW * star)
                # The variance of a mean of n pulses falls by about 1 / n^2 with one more.
                had = (1.0 + of_window[min(window, bins - 1 - window)]) ** 2 * (1.0 + counts[row, window])
                cost = (arrival_s + _PULSE_S) * had * (1.0 + self._missed.get((row, window), 0)) ** 2
                if best is None or cost < best[0]:
                    best = (cost, row, window, arrival_s)
        return None if best is None else best[1:]

    # --- shaft -------------------------------------------------------------------------------------------------------

    def spin(self, speed_rpm: float) -> None:
        """Spins the rotor up by pulses, and lets it coast."""
        link = self.link
        self.tell(f"spin-up to {speed_rpm:.0f} r/min, coasting for {_COAST_S:g} s: inertia, friction")
        speed_rpm = max(speed_rpm, 2.0 * 60.0 * self._drift) if self._load else speed_rpm
        coasted_s, begin_s = 0.0, link.time_s
        while coasted_s < _COAST_S:
            log = link.rest(0.005)
            while link.time_s - begin_s < _SPIN_UP_MAX_S:
                speed, turn = self._motion(log)
                direction = self._against_load if self._load else 1 if speed >= 0.0 else -1
                if speed * direction * 60.0 >= speed_rpm:
                    break
                log = self._push(direction, speed, turn)
            self._end_push()
            coasted_s += self._coast(_COAST_S - coasted_s)
            if link.time_s - begin_s >= _SPIN_UP_MAX_S:
                break
        link.check()

    def _coast(self, duration_s: float) -> float:
        """Lets the rotor coast; with a load until it drifts the other way. Returns the time."""
        if not self._load:
            self.link.rest(duration_s)
            return duration_s
        begin_s = self.link.time_s
        while self.link.time_s - begin_s < duration_s:
            speed, _ = self._motion(self.link.rest(_COAST_STEP_S))
            if -speed * self._against_load > self._drift:
                break
        return self.link.time_s - begin_s
