"""Report of a failed test's bench: what it did, CAN log, plots, true state of the last second, what changed, seed
and replay command."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from salient.bench.recording import COLOURS
from salient.bench.session import Session
from salient.bench.stimulus import STIMULI, Stimulus, last_before, stimuli_of
from salient.bus.log import write_logs
from salient.config import BenchConfig
from salient.dbc import PHASES, PHASES_MIN
from salient.errors import RunFailed
from salient.json_file import json_text
from salient.paths import COMMAND

BEFORE_S, AFTER_S = 0.05, 0.01
"""Length of a plot and of the list of changes, around their moment."""
TRUTH_S = 1.0
_OF_MORE_PHASES = tuple(f"current_{phase}_A" for phase in PHASES[PHASES_MIN:])
TRUTH = "truth.npy"
LEFT = ("can.blf", "can.log", "failure.png", "last_second.png", "first_fault.png", "bench.json", "failure.html", TRUTH)
"""The files of a folder."""
RECORD_STEP_NS = 50_000
"""Step of the recording that a bench of a test makes for this purpose, which takes a few percent of its time."""
_RECORDING_HEADER_BYTES = 1024
"""RECORDER_HEADER_BYTES of emulator/plant/recorder.h."""
_TIME_TO_ACT_S = 1e-6
_LABELS_MAX = 12
"""Acts of a plot that have a label: more are not read."""
_LABEL_MAX = 90
"""Characters of one."""
_STIMULUS_COLOUR = "#009e73"


@dataclass(frozen=True)
class Saved:
    """Report on a bench. last: the stimulus before the failure; drive: that it has tripped, or why it does not run,
    else empty; stimuli: all of them, in order; changes: what changed just before."""

    last: str
    drive: str
    stimuli: list[str]
    changes: list[str]


def save(session: Session, folder: Path, notes: dict[str, Any], config: BenchConfig | None, error: str = "",
         moment: tuple[float, str] | None = None) -> Saved:
    """Writes log (BLF and candump text), plots around the failure and around the first fault, bench.json with the
    notes, and a page of all that and of the error. config: of an emulator that the session has started. moment: virtual
    time in s of what the plots are to show, and its name, instead of the failure, which is now."""
    folder.mkdir(parents=True, exist_ok=True)
    clear(folder)
    write_logs(session.log, folder / "can.blf", folder / "can.log")
    moment_s, title = moment or (session.time_s, "failure")
    acts = stimuli_of(session)
    plot_moment(session, moment_s, title, folder / "failure.png", acts)
    plot_moment(session, moment_s, title, folder / "last_second.png", acts, TRUTH_S)
    last = _last(acts, moment_s, title)
    changed = changes(session, moment_s, acts)
    fault = first_fault(session)
    drive = _drive(session, fault, acts)
    about: dict[str, Any] = {"virtual_time_s": session.time_s, "last_stimulus": last, "drive": drive,
                             STIMULI: [asdict(stimulus) for stimulus in acts], "changes_before_the_failure": changed}
    if fault is not None:
        time_s, name = fault
        plot_moment(session, time_s, f"first fault: {name}", folder / "first_fault.png", acts)
        about["first_fault"] = {"fault": name, "time_s": time_s, "changes": changes(session, time_s, acts)}
    simulator = getattr(session, "simulator", None)
    if config is not None:
        about |= {"seed": config.seed, "machine": str(config.machine), "node": config.node}
        about |= {} if config.true_machine is None else {"true_machine": str(config.true_machine)}
    if simulator is not None:
        about |= {"simulator": shlex.join(simulator.command), "stderr": simulator.errors}
    about |= {"view": f"{COMMAND} view --replay {shlex.quote(str(folder))}"} | notes
    (folder / "bench.json").write_text(json_text(about), encoding="utf-8")
    scopes = _save_scopes(session, folder)
    _write_page(folder, about | {"error": error, STIMULI: [str(stimulus) for stimulus in acts]}, title, scopes)
    return Saved(last, drive, [str(stimulus) for stimulus in acts], changed)


def clear(folder: Path) -> None:
    """Removes what an earlier failure has left: it would be taken for a part of the next one."""
    for path in (*(folder / name for name in LEFT), *folder.glob("scope_[0-9]*")):
        path.unlink(missing_ok=True)


def _save_scopes(session: Session, folder: Path) -> dict[str, str]:
    """Table and plot of each recording of the drive's buffer, whether or not the test has come to read it; titles by
    name of the plot. Time passes while it is read."""
    titles = {}
    for number, scope in enumerate(session.scopes):
        try:
            recording = scope.recording or scope.read(timeout=0.0)
        except (RunFailed, OSError):
            continue  # not complete, armed anew, or the drive has ended
        name = f"scope_{number}.png"
        recording.write(folder / f"scope_{number}.csv")
        recording.plot(folder / name, scope.title)
        titles[name] = f"The drive's buffer, triggered by: {scope.title}"
    return titles


def _write_page(folder: Path, about: dict[str, Any], title: str, scopes: Mapping[str, str]) -> None:
    from salient.pages import Plot, write_page

    plots = [Plot("", title, (folder / name).read_bytes())
             for name, title in (("failure.png", f"The {title}"), *scopes.items(),
                                ("first_fault.png", "The first fault"), ("last_second.png", "The second before"))
             if (folder / name).exists()]
    # The first ones of a drive that is on the bus already, the last ones of a failure outside pytest.
    unknown = dict.fromkeys(("simulator", "stderr", "machine", "seed", "test", "phase", "replay_in", "world"), "")
    write_page(folder / "failure.html", "failure.html", unknown | about | {"plots": plots})


def save_truth(recording: Path, folder: Path) -> None:
    """Copies the last TRUTH_S of a recording, which may be of an emulator that was killed, for numpy.load."""
    with recording.open("rb") as file:
        np.lib.format.read_magic(file)
        _, _, dtype = np.lib.format.read_array_header_1_0(file)
    rows = np.fromfile(recording, dtype, offset=_RECORDING_HEADER_BYTES)
    if len(rows):
        np.save(folder / TRUTH, rows[rows["time_s"] > rows["time_s"][-1] - TRUTH_S])


def first_fault(session: Session) -> tuple[float, str] | None:
    """Virtual time at which the drive reported its first fault, and the fault; None without one."""
    fault = session.telemetry["DRIVE_STATUS.fault"]
    found = np.flatnonzero(fault.value)
    if not len(found):
        return None
    number = int(fault.value[found[0]])
    return float(fault.time_s[found[0]]), (fault.choices or {}).get(number, str(number))


def changes(session: Session, time_s: float, acts: Sequence[Stimulus] = ()) -> list[str]:
    """Changes around a moment, in order: signals with named values of drive and test bench, the load, and what
    was done. The torque reference in torque mode only: in speed mode the speed controller changes it all
    the time."""
    from_s, to_s = time_s - BEFORE_S, time_s + AFTER_S
    found: list[tuple[float, str]] = []
    for table in (session.telemetry, session.truth):
        for name in table:
            if "." not in name:
                continue
            signal = table[name]
            if signal.choices is None and name.partition(".")[2] not in ("load_torque_Nm", "speed_reference_rpm",
                                                                         "torque_reference_Nm"):
                continue
            for at in np.flatnonzero(np.diff(signal.value)) + 1:
                if name == "DRIVE_TORQUE.torque_reference_Nm" and not _in_torque_mode(session, signal.time_s[at]):
                    continue
                if from_s <= signal.time_s[at] <= to_s:
                    before, after = ((signal.choices or {}).get(int(value), f"{value:g}") if signal.choices
                                     else f"{value:g} {signal.unit}".rstrip() for value in signal.value[at - 1:at + 1])
                    found.append((float(signal.time_s[at]), f"{name}: {before} -> {after}"))
    found += [(stimulus.time_s, stimulus.text) for stimulus in acts if from_s <= stimulus.time_s <= to_s]
    return [f"{at_s:.6f} s {text}" for at_s, text in sorted(found)]


def _in_torque_mode(session: Session, time_s: float) -> bool:
    mode = session.telemetry["DRIVE_STATUS.mode"]
    at = int(np.searchsorted(mode.time_s, time_s, side="right")) - 1
    return at >= 0 and (mode.choices or {}).get(int(mode.value[at])) == "torque"


def plot_moment(session: Session, time_s: float, title: str, path: Path,
                acts: Sequence[Stimulus], before_s: float = BEFORE_S) -> None:
    """Stimuli, speed, torque and phase currents, true and in the telemetry, and the drive's state, around a
    moment."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = (
        [("telemetry", "DRIVE_MOTION.speed_reference_rpm"), ("telemetry", "speed_rpm"), ("truth", "speed_rpm")],
        [("telemetry", "torque_reference_Nm"), ("telemetry", "torque_estimate_Nm"), ("truth", "torque_Nm"),
         ("truth", "load_torque_Nm")],
        [("truth", f"current_{phase}_A") for phase in PHASES],
    )  # fmt: skip
    from_s, to_s = max(0.0, time_s - before_s), time_s + AFTER_S
    labelled = _labelled(acts, from_s, to_s)
    top_in = 0.45 + 0.19 * max(1, len(labelled))
    figure = Figure(figsize=(10, 9.5 + top_in), layout="constrained")
    FigureCanvasAgg(figure)
    above, *rows, below = figure.subplots(len(panels) + 2, 1, sharex=True,
                                          height_ratios=(top_in, 2.4, 2.4, 2.4, 1.4))
    for axes, panel in zip(rows, panels, strict=True):
        for (source, name), colour in zip(panel, COLOURS, strict=False):
            signal = getattr(session, source)[name]
            if name in _OF_MORE_PHASES and not signal.value.any():
                continue  # a machine of fewer phases
            signal = signal.between(from_s, to_s)
            axes.plot(signal.time_s, signal.value, label=f"{source} {signal.name}", color=colour,
                      marker="." if before_s <= BEFORE_S else "", markersize=3)
            axes.set_ylabel(signal.unit)
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, fontsize="small", frameon=False)
    state = session.telemetry["DRIVE_STATUS.state"]
    states = state.choices or {}
    below.set_yticks(list(states), list(states.values()))
    state = state.between(from_s, to_s)
    below.step(state.time_s, state.value, where="post", color=COLOURS[0])
    for axes in (above, *rows, below):
        for stimulus in acts:
            if from_s <= stimulus.time_s <= to_s:
                axes.axvline(stimulus.time_s, color=_STIMULUS_COLOUR, linewidth=1, linestyle=":")
        axes.axvline(time_s, color="black", linewidth=1, linestyle="--")
        axes.grid(alpha=0.3)
    below.set_xlim(from_s, to_s)
    _label(above, labelled, from_s, to_s)
    below.set_ylabel("state")
    below.set_xlabel("virtual time, s")
    figure.suptitle(f"{title} at {time_s:.6f} s")
    figure.savefig(path, dpi=110)


def _drive(session: Session, fault: tuple[float, str] | None, acts: Sequence[Stimulus]) -> str:
    """The first fault of the drive, with the act before it; else its hindrance."""
    if fault is not None:
        time_s, name = fault
        before = last_before(acts, time_s)
        since = "" if before is None else f", {1e3 * (time_s - before.time_s):.3f} ms after {before.text}"
        return f"tripped: {name}, reported at {time_s:.6f} s{since}"
    return session.drive.hindrance


def _last(acts: Sequence[Stimulus], moment_s: float, title: str) -> str:
    """The last act by a moment, with the beginning of a fault that it ends; when it has not had any time to act also
    the one before it."""
    done = [stimulus for stimulus in acts if stimulus.time_s <= moment_s]
    if not done:
        return "none"
    text = f"{done[-1]}, {1e3 * (moment_s - done[-1].time_s):.3f} ms before the {title}"
    ended = re.search(r"fault \w+ (?=ends)", done[-1].text)
    begun = [stimulus for stimulus in done if ended and f"{ended[0]}begins" in stimulus.text]
    if begun:
        text += f"; it began at {begun[-1].time_s:.6f} s"
    earlier = last_before(done, moment_s - _TIME_TO_ACT_S)
    return text if earlier in (None, done[-1]) else f"{text}; before it {earlier}"


def _labelled(acts: Sequence[Stimulus], from_s: float, to_s: float) -> list[Stimulus]:
    """The latest acts of a plot, and with room the one before them, which the drive may still follow."""
    shown = [stimulus for stimulus in acts if from_s <= stimulus.time_s <= to_s]
    before = last_before(acts, from_s)
    return [*([before] if before is not None and before not in shown else []), *shown][-_LABELS_MAX:]


def _label(axes: Any, labelled: Sequence[Stimulus], from_s: float, to_s: float) -> None:
    """A row for each act: a mark at its time, on the side with more room its text."""
    axes.set_ylim(len(labelled) or 1, 0)
    axes.set_yticks([])
    axes.grid(visible=False)
    axes.set_ylabel("stimulus", rotation=0, ha="right", va="center")
    for row, stimulus in enumerate(labelled):
        is_before = stimulus.time_s < from_s
        at_s = max(stimulus.time_s, from_s)
        is_left = at_s < (from_s + to_s) / 2
        axes.plot([at_s], [row + 0.5], marker="<" if is_before else "o", color=_STIMULUS_COLOUR, markersize=5,
                  clip_on=False)
        text = str(stimulus)
        shown = text if len(text) <= _LABEL_MAX else f"{text[:_LABEL_MAX]}..."
        axes.annotate(shown, (at_s, row + 0.5), xytext=(7 if is_left else -7, 0), textcoords="offset points",
                      ha="left" if is_left else "right", va="center", fontsize="small", annotation_clip=False,
                      bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 0.5})
    if not labelled:
        axes.annotate("none", (from_s, 0.5), xytext=(7, 0), textcoords="offset points", va="center", fontsize="small")
