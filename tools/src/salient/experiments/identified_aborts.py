"""Identifications that are broken off at any instant: python -m salient.experiments.identified_aborts

A seed draws a machine, a load, one of its client killed (SIGKILL), its client silent for a while, a fault of the test
bench, safe torque off, and when: in the rest, the detection of the windings, the holds, the pulses of the map, the
spin-up or the coasting. Then it is judged by the true state alone:

- All gates are off within the specified time. With all of them off the DC link takes back the voltage times the sum of
  the currents; less, or energy drawn, is a gate that is on.
- No winding has current 60 ms after that, nor later, and until then none more than 1.05 times the limit; with a fault
  of the bench none more than 1.2 times the trip.
- Another client finds the drive ready once the cause has gone, arms it and runs it at a speed, or identifies again.
- The folder of --out is as it was: no file is new, changed or gone.

The last task ends a process at each operation on files while it writes a result over an earlier one. Prints a line for
each seed that is wrong, and the counts. DIR/runs.jsonl has what is done: an interrupted run goes on.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import random
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from salient import identify as identify_package
from salient.bench.bench import Bench
from salient.bench.emulator import EmulatorProcess
from salient.bench.programs import executable
from salient.bench.session import Session
from salient.errors import exit_code
from salient.experiments import tasks
from salient.experiments.compare.case import MACHINES
from salient.experiments.compare.every_machine import EXAMPLES
from salient.experiments.scaled import scale_of
from salient.identify.command import TELEMETRY_PERIOD_MS, measure
from salient.identify.link import IdentifyError, linked
from salient.identify.result import Result, write_machine
from salient.identify.sequence import Sequence as Experiments
from salient.machine.cache import bench_config
from salient.machine.file import load_machine
from salient.machine.path import machine_path
from salient.machine.scaling import scaling_of
from salient.paths import OUT

SEEDS = 200
KINDS = ("kill", "silence", "fault", "sto")
STAGES = {"rest": 0.075, "hold": 4.5, "drift": 1.5, "spin-up": 1.0, "coasting": 0.9}
"""Stages of an identification; times up to which an instant is drawn after its start, s."""
_TOLD = {"rest": ("rest",), "hold": ("hold", "a load"), "drift": ("drift",), "spin-up": ("spin-up",)}
"""Beginnings of the lines by which it tells them. Coasting begins with a rest in the spin-up of this length:"""
_COASTS_NS = 20_000_000
BINS, REPEATS = 24, 1
COMMAND_TIMEOUT_S, BACKGROUND_S = 0.05, 0.003
"""Parameter command_timeout_ms, default; passes of the background, and periods, until the switches open."""
STO_S, LATCHED_S, DISCHARGED_S = 1e-4, 1e-4, 0.06
_LOAD_PART, _LOADED = 0.2, 0.3
_ON_PART, _CURRENT_PART = 0.2, 0.005
"""Part of the power that a gate takes away from the DC link's, and of the limit from which a current counts."""
_PEAK, _TRIP_PEAK = 1.05, 1.2
_AFTER_S, _BRAKED_S = 0.25, 20.0
_START_RPM, _TURNED_RPM = 300.0, 30.0


@dataclass(frozen=True)
class FaultCase:
    """A fault of the bench. within_s: specified time to the first cause (firmware/requirements.toml, SR-...); None: the
    mode does not watch for it, and its limits or the tools end the experiments."""

    kind: str
    arguments: Mapping[str, float | str] = field(default_factory=dict)
    within_s: float | None = None
    duration_s: float | None = None


FAULTS = (
    FaultCase("current_sensor_high_rail", {"phase": "a"}, 1e-4),         # SR-11
    FaultCase("supply_surged", {"height_percent": 120.0}, 2e-3),         # SR-13, and the capacitor
    FaultCase("winding_temperature_sensor_open", {"phase": "b"}, 0.041),  # SR-18
    FaultCase("encoder_jump", {"angle_deg": 90.0}, 1e-4),                # SR-19
    FaultCase("encoder_no_answer", {}, 1e-4),                            # SR-19
    FaultCase("interrupt_lost", {}, 1.5e-4, 0.03),                       # SR-45
    FaultCase("background_hung", {}, 0.021, 0.03),                       # SR-47
    FaultCase("limit_flipped", {"bit": 12.0}, 1.5e-4),                   # SR-49
    FaultCase("constant_flipped", {"bit": 3064.0}, 2.1e-3),              # SR-50
    FaultCase("state_flipped", {"bit": 0.0}, 1.1e-3),                    # SR-51
    FaultCase("period_register_flipped", {"bit": 3.0}, 2.1e-3),          # SR-54
    FaultCase("clock_drift", {"drift_percent": 6.0}, 0.0215),            # SR-55
    FaultCase("winding_open", {"phase": "a"}),
    FaultCase("current_sensor_open", {"phase": "a"}),
    FaultCase("shaft_locked"),
)


@dataclass(frozen=True)
class Abort:
    """An end, and when: offset_s after the start of a stage."""

    seed: int
    machine: str
    loaded: bool
    kind: str
    fault: int
    stage: str
    offset_s: float
    pause_s: float
    lines: tuple[int, int]
    again: bool
    previous: bool


def machines() -> list[str]:
    """Names and files of those that are drawn."""
    return [*MACHINES, *(str(path) for path in sorted(EXAMPLES.glob("*.toml")))]


def drawn(seed: int) -> Abort:
    """The end of a seed."""
    of = random.Random(seed)
    stage = of.choice(list(STAGES))
    return Abort(seed, of.choice(machines()), of.random() < _LOADED, KINDS[seed % len(KINDS)],
                 of.randrange(len(FAULTS)), stage, of.uniform(0.0, STAGES[stage]), of.uniform(0.06, 1.2),
                 of.choice([(1, 0), (0, 1), (1, 1)]), of.random() < 0.25, of.random() < 0.5)


class Client(Session):
    """A session of lock-step that something befalls at an instant. strike: called then, once; place: stage and
    experiment of that instant; struck_ns: the instant."""

    place: str
    struck_ns: int

    def __init__(self, can: str, machine: str, strike: Callable[[Client], None]) -> None:
        self._strike: Callable[[Client], None] | None = strike
        self._at_ns: int | None = None
        self._stage, self._wanted, self._offset_ns = "", "", 0
        self._rests_ns: int | None = None
        self.place = ""
        self.struck_ns = 0
        super().__init__(can, machine=machine)

    def arm(self, stage: str, offset_s: float) -> Callable[[str], None]:
        """A function that takes the lines by which the identification tells its stages."""
        self._wanted, self._offset_ns = stage, round(1e9 * offset_s)

        def tell(line: str) -> None:
            self._enter(next((name for name, begins in _TOLD.items() if line.startswith(begins)), self._stage))
        return tell

    def _enter(self, stage: str) -> None:
        self._stage = stage
        if stage == self._wanted and self._at_ns is None:
            self._at_ns = self.time_ns + self._offset_ns

    def _follow(self) -> None:
        """Coasting, which is not told."""
        if self._stage != "spin-up" or self.drive._experiment.kind != "rest":
            self._rests_ns = None
        elif self._rests_ns is None:
            self._rests_ns = self.time_ns
        elif self.time_ns > self._rests_ns + _COASTS_NS:
            self._enter("coasting")

    def advance_to(self, time_ns: int) -> None:
        """Lets time pass."""
        self._follow()
        if self._at_ns is not None and self._strike is not None and time_ns >= self._at_ns:
            super().advance_to(max(self._at_ns, self.time_ns))
            strike, self._strike = self._strike, None
            self.struck_ns = self.time_ns
            self.place = f"{self._stage}: {self.drive._experiment.kind}"
            strike(self)
        super().advance_to(max(time_ns, self.time_ns))

    def pause(self, duration_s: float) -> None:
        """Lets time pass without a command of this client, as of a process that is stopped."""
        self.drive.silence()
        self.run_for(duration_s)


def strike_of(abort: Abort, note: Path) -> Callable[[Client], None]:
    """The end of the client, or of its drive. note: gets the instant, before a process dies."""
    def strike(client: Client) -> None:
        note.write_text(json.dumps([client.struck_ns, client.place]), encoding="utf-8")
        if abort.kind == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        elif abort.kind == "silence":
            client.pause(abort.pause_s)
        elif abort.kind == "sto":
            for name, on in zip(("sto_1", "sto_2"), abort.lines, strict=True):
                if on:
                    setattr(client.rig, name, 1)
        else:
            fault = FAULTS[abort.fault]
            client.rig.fault(fault.kind, duration_s=fault.duration_s, **fault.arguments)
    return strike


def in_a_process(function: Callable[[], object]) -> int:
    """Calls a function in a process of its own; returns its exit code, negative for a signal."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            function()
            code = 0
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def contents(folder: Path) -> dict[str, bytes]:
    """All files below a folder."""
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b"" for path in folder.rglob("*")}


def _client(abort: Abort, can: str, machine: str, out: Path, note: Path) -> str:
    """Identifies until it ends; how it ended."""
    with Client(can, machine, strike_of(abort, note)) as client:
        try:
            measure(client, machine_path(machine), out, BINS, REPEATS, client.arm(abort.stage, abort.offset_s))
        except IdentifyError as error:
            return str(error)
        return "" if client.struck_ns else "not struck"


def run_one(abort: Abort) -> dict[str, Any]:
    """Where an identification was broken off, how it ended, and what is wrong; executed by a worker."""
    path = machine_path(abort.machine)
    data = scaling_of(path, load_machine(path)).data
    period_ns = round(1e9 / data.control_rate_hz)
    with tempfile.TemporaryDirectory(prefix="salient-") as name:
        folder = Path(name)
        out, note, recording = folder / "out" / "motor.toml", folder / "note.json", folder / "recording.npy"
        out.parent.mkdir()
        if abort.previous:
            for suffix in (".toml", ".html", ".csv"):
                out.with_suffix(suffix).write_text(f"of an earlier run{suffix}\n", encoding="utf-8")
        before = contents(out.parent)
        config = bench_config({"machine": str(path), "controller": "salient", "pace": "lockstep", "record": recording,
                               "telemetry_period_ms": TELEMETRY_PERIOD_MS, "record_step_ns": 2 * period_ns,
                               "initial_angle_deg": random.Random(abort.seed).uniform(0.0, 360.0)})
        can = f"unix:{folder}/bus"
        with EmulatorProcess(config, can):
            if abort.loaded:
                with Session(can, machine=str(path)) as session:
                    session.rig.load_torque_Nm = _LOAD_PART * data.torque_rated_Nm
            if abort.kind == "kill":
                ending = f"exit code {in_a_process(lambda: _client(abort, can, str(path), out, note))}"
            else:
                ending = _client(abort, can, str(path), out, note)
            struck_ns, place = json.loads(note.read_text(encoding="utf-8")) if note.exists() else (0, "")
            files = contents(out.parent)
            with Session(can, machine=str(path)) as judge:
                wrong, latched_s, cause, end_s = _judged(abort, judge, path)
        record = np.load(recording)
    if not struck_ns:
        return {"place": "", "ending": ending, "cause": cause, "off_s": None, "peak": None,
                "wrong": []}
    if ending and files != before:  # one that a fault of the bench has not ended may write its result
        wrong.append(f"files {sorted(files)} instead of {sorted(before)}, or changed")
    found, off_s, peak = _physics(abort, record, struck_ns * 1e-9, latched_s, end_s,
                                  data.parameters["current_limit_A"], data.current_trip_A)
    return {"place": place, "ending": ending, "cause": cause, "off_s": off_s, "peak": peak, "wrong": wrong + found}


def _judged(abort: Abort, judge: Session, path: Path) -> tuple[list[str], float | None, str, float]:
    """Another client after the end: what is wrong, time and name of the first cause, and time of its start."""
    drive, wrong = judge.drive, []
    end_s = judge.time_s
    judge.run_for(_AFTER_S)
    fault = drive.fault
    if abort.kind == "sto":
        judge.rig.sto_1 = judge.rig.sto_2 = 1  # a difference of the lines ends when both have been off together
        judge.run_for(0.01)
        judge.rig.sto_1 = judge.rig.sto_2 = 0
    elif abort.kind == "fault":
        case = FAULTS[abort.fault]
        with suppress(Exception):  # one that has ended by itself
            judge.clear_fault(case.kind, **{name: str(value) for name, value in case.arguments.items()
                                            if name in ("phase", "leg")})
    judge.rig.load_torque_Nm = 0.0
    judge.rig.held_speed_rpm = 0.0  # a load may have driven it to any speed
    judge.run_until(lambda: abs(judge.truth["speed_rpm"].last) < 1.0, timeout=_BRAKED_S)
    for speed_rpm in (_TURNED_RPM, 0.0, math.nan):  # an encoder's fault ends when it counts again
        judge.rig.held_speed_rpm = speed_rpm
        judge.run_for(0.05)
    if fault == "code" or (fault == "memory" and abort.kind == "fault"):
        judge.rig.drive_reset = 1  # until a reset (docs/safety/protections.md)
        judge.run_for(0.1)
    drive.clear_fault()
    judge.run_for(0.1)
    try:
        drive.wait_until_ready()
        wrong += _used(abort, judge, path)
    except Exception as error:  # whatever it is, the drive is not usable
        wrong.append(f"not usable: {type(error).__name__}: {error}; state {drive.state}, fault {drive.fault}")
    causes = judge.telemetry["DRIVE_FAULT_CAUSE.fault"]
    latched = judge.telemetry["DRIVE_FAULT_CAUSE.time_us"]
    first = next((k for k in range(len(causes)) if causes.value[k]), None)
    return wrong, None if first is None else float(latched.value[first]) * 1e-6, fault, end_s


def _used(abort: Abort, judge: Session, path: Path) -> list[str]:
    """The drive runs, or identifies; what is wrong."""
    drive, machine = judge.drive, load_machine(path)
    if abort.again:
        with linked(judge) as link:
            Experiments(link, machine.phases, machine.rotor_poles, lambda _: None).probe()
        return []
    scale = scale_of(machine)
    speed_rpm = scale.rpm(_START_RPM)
    drive.speed_reference_rpm = speed_rpm
    judge.run_for(0.4 + scale.delay_s(speed_rpm, 0.4))
    reached = judge.truth["speed_rpm"].last
    drive.off()
    judge.run_for(0.02)
    return [] if abs(reached - speed_rpm) < 0.05 * speed_rpm else [
        f"{reached:.0f} instead of {speed_rpm:.0f} r/min; state {drive.state}, fault {drive.fault}"]


def gates_on(record: np.ndarray, least_A: float) -> np.ndarray:
    """Rows of a recording up to which, from the row before, a gate was on while a current flowed."""
    currents = np.stack([np.asarray(record[name], float) for name in record.dtype.names or ()
                         if name.startswith("current_")])
    # The smaller one: a current that ends in a row returns less than its mean.
    least = np.minimum(currents[:, 1:], currents[:, :-1]).sum(axis=0)
    voltage = np.minimum(record["bus_voltage_V"][1:], record["bus_voltage_V"][:-1]).astype(float)
    taken_J = np.diff(np.asarray(record["energy_drawn_J"], float) - record["energy_returned_J"])
    on = (least > least_A) & (taken_J > (_ON_PART - 1.0) * voltage * least * np.diff(record["time_s"]))
    return np.concatenate([[False], on])


def _physics(abort: Abort, record: np.ndarray, struck_s: float, latched_s: float | None, end_s: float, limit_A: float,
             trip_A: float) -> tuple[list[str], float | None, float]:
    """Violations by the true state, time from the instant to the last gate that was on, and the largest current by its
    bound."""
    time_s = np.asarray(record["time_s"])
    until = int(np.searchsorted(time_s, end_s + _AFTER_S))  # before the judge does anything
    record, time_s = record[:until], time_s[:until]
    currents = np.max([np.asarray(record[name], float) for name in record.dtype.names or ()
                       if name.startswith("current_")], axis=0)
    on = np.nonzero(gates_on(record, _CURRENT_PART * limit_A))[0]
    last_s = float(time_s[on[-1]]) if len(on) else 0.0
    case = FAULTS[abort.fault]
    wrong = []
    if latched_s is not None and latched_s < struck_s:  # a reset has set the drive's clock back
        latched_s = None
    within_s = {"kill": COMMAND_TIMEOUT_S + BACKGROUND_S, "silence": COMMAND_TIMEOUT_S + BACKGROUND_S,
                "sto": STO_S}.get(abort.kind, case.within_s)
    if within_s is not None and last_s > struck_s + within_s:
        wrong.append(f"a gate is on {1e3 * (last_s - struck_s):.3f} ms after the instant")
    if latched_s is not None and last_s > latched_s + LATCHED_S:
        wrong.append(f"a gate is on {1e3 * (last_s - latched_s):.3f} ms after the first cause")
    quiet_s = struck_s + within_s if within_s is not None else end_s
    if (currents[time_s > quiet_s + DISCHARGED_S] > _CURRENT_PART * limit_A).any():
        wrong.append("current after the end")
    bound_A = _TRIP_PEAK * trip_A if abort.kind == "fault" else _PEAK * limit_A
    peak = float(currents.max()) / bound_A
    if peak > 1.0:
        wrong.append(f"current {peak:.3f} of its bound")
    return wrong, last_s - struck_s if last_s > struck_s else 0.0, peak


# --- files -----------------------------------------------------------------------------------------------------------

_EARLIER, _SAME = 0.9, 0.01
"""Flux linkage of the earlier machine by the later one's; tolerance by which the two are told apart."""


def writing(_: object = None) -> dict[str, Any]:
    """As a task: what is wrong when a process is killed while it writes a result."""
    path = machine_path(MACHINES[0])
    with tempfile.TemporaryDirectory(prefix="salient-") as name:
        folder = Path(name)
        config = bench_config({"machine": str(path), "controller": "salient",
                               "telemetry_period_ms": TELEMETRY_PERIOD_MS})
        bench = Bench(config, f"unix:{folder}/bus")
        try:
            result = measure(bench, path, folder / "first" / "motor.toml", 12, 1, lambda _: None)
        finally:
            bench.close()
        instants, wrong = killed_writing(result, path, folder / "killed")
    return {"place": "files", "ending": f"{instants} instants", "cause": "none", "off_s": None, "peak": None,
            "wrong": wrong}


def killed_writing(result: Result, plate: Path, folder: Path) -> tuple[int, list[str]]:
    """Kills a process at the first, second, ... operation on files while it writes a result, once with an earlier one
    there and once without. Returns the number of instants, and what is wrong."""
    wrong, instants = [], 0
    out = folder / "motor.toml"

    def page(_: object, path: Path) -> None:
        path.write_text("page\n", encoding="utf-8")

    for earlier in (False, True):
        number = 0
        while True:
            number += 1
            shutil.rmtree(folder, ignore_errors=True)
            if earlier:
                write_machine(replace(result, flux_Wb=_EARLIER * result.flux_Wb), plate, out, page)
            before = out.read_bytes() if earlier else b""
            code = in_a_process(lambda n=number: _killed_at(n, folder, lambda: write_machine(  # type: ignore[misc]
                result, plate, out, page)))
            if code == 0:
                break
            instants += 1
            what = f"{'over' if earlier else 'without'} an earlier one, operation {number}"
            if code != -signal.SIGKILL:
                wrong.append(f"{what}: exit code {code}")
            elif out.exists():
                flux_Wb = (_EARLIER if out.read_bytes() == before else 1.0) * float(result.flux_Wb.max())
                found_Wb = float(load_machine(out).magnetics.flux_linkage_Wb(0.0, result.current_A.max()))
                if abs(found_Wb - flux_Wb) > _SAME * flux_Wb:
                    wrong.append(f"{what}: {found_Wb:.4f} Wb instead of {flux_Wb:.4f} Wb: the map of another file")
            elif earlier:
                wrong.append(f"{what}: the earlier one is gone")
            write_machine(result, plate, out, page)
            left = sorted(each.name for each in folder.rglob("*"))
            if len(left) != 3:
                wrong.append(f"{what}: {left} after the next one")
    return instants, wrong


def _killed_at(number: int, folder: Path, function: Callable[[], object]) -> None:
    """Calls a function, and kills this process before its n-th operation on a file of a folder."""
    seen = 0

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal seen
        if event in ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir") and arguments and str(
                arguments[0]).startswith(str(folder)):
            seen += 1
            if seen == number:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)
    function()


# --- all -------------------------------------------------------------------------------------------------------------

def summary(results: Sequence[tuple[Abort | None, Mapping[str, Any]]]) -> list[str]:
    """Counts by kind and place, and the longest times."""
    lines = []
    aborts = [(abort, result) for abort, result in results if abort is not None and result["place"]]
    for kind in KINDS:
        of = [result for abort, result in aborts if abort.kind == kind]
        late = max((result["off_s"] for result in of if result["off_s"] is not None), default=0.0)
        lines.append(f"{kind}: {len(of)}, gates off after at most {1e3 * late:.2f} ms, "
                     f"{sum(bool(result['wrong']) for result in of)} wrong")
    lines.append(f"ended before their instant: {sum(abort is not None for abort, _ in results) - len(aborts)}")
    places = Counter(result["place"] for _, result in aborts)
    lines.append("places: " + ", ".join(f"{place} {count}" for place, count in sorted(places.items())))
    return lines


def main() -> int:
    """Runs the seeds; exit code 1 when anything is wrong."""
    parser = argparse.ArgumentParser(prog="python -m salient.experiments.identified_aborts", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--jobs", type=int)
    parser.add_argument("--out", type=Path, default=OUT / "identified_aborts")
    options = parser.parse_args()
    of = code()
    seeds = range(options.first, options.first + options.seeds)
    listed = [tasks.Task(f"{of} {seed}", seed) for seed in seeds]
    listed.append(tasks.Task(f"{of} writing", None))
    results = []
    for task, result in tasks.run(listed, of_seed, options.out, jobs=options.jobs):
        abort = None if task.arguments is None else drawn(task.arguments)
        results.append((abort, result))
        if result["wrong"]:
            print(f"seed {task.arguments}: {'; '.join(result['wrong'])} ({abort}, {result})", flush=True)
    print("\n".join(summary(results)))
    return 1 if any(result["wrong"] for _, result in results) else 0


def code(*more: str) -> str:
    """Identifies what a result depends on but its seed: the drive, the identification, this file, further ones."""
    package = Path(str(identify_package.__file__)).parent
    files = [executable(), Path(__file__), *map(Path, more), *sorted(package.glob("*.py"))]
    return hashlib.sha256(" ".join(map(tasks.file_digest, files)).encode()).hexdigest()[:16]


def of_seed(seed: int | None) -> dict[str, Any]:
    """Result of a seed, or of the writing; executed by a worker."""
    return writing() if seed is None else run_one(drawn(seed))


if __name__ == "__main__":
    sys.exit(exit_code(main))
