"""What a failed test leaves of a bench: CAN log, plots, true state of the last second, what changed, seed and replay
command."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np

from salient.bench.session import Session
from salient.bus.log import write_logs
from salient.config import BenchConfig
from salient.paths import COMMAND

BEFORE_S, AFTER_S = 0.05, 0.01
"""Of a plot and of the list of changes, around their moment."""
TRUTH_S = 1.0
COLOURS = ("#0072b2", "#d55e00", "#000000", "#56b4e9")
"""Those of the live page (view/page/palette.js)."""
TRUTH = "truth.npy"
LEFT = ("can.blf", "can.log", "failure.png", "last_second.png", "first_fault.png", "bench.json", "failure.html", TRUTH)
"""The files of a folder."""
RECORD_STEP_NS = 50_000
"""Of the recording that a bench of a test makes for this purpose, which takes a few percent of its time."""
_RECORDING_HEADER_BYTES = 1024
"""RECORDER_HEADER_BYTES of emulator/plant/recorder.h."""


def save(session: Session, folder: Path, notes: dict[str, Any], config: BenchConfig | None, error: str = "",
         moment: tuple[float, str] | None = None) -> list[str]:
    """Writes log (BLF and candump text), plots around the failure and around the first fault, bench.json with the
    notes, and a page of all that and of the error. config: of an emulator that the session has started. moment: virtual
    time in s of what the plots are to show, and its name, instead of the failure, which is now. Returns what changed
    just before."""
    folder.mkdir(parents=True, exist_ok=True)
    clear(folder)
    write_logs(session.log, folder / "can.blf", folder / "can.log")
    moment_s, title = moment or (session.time_s, "failure")
    plot_moment(session, moment_s, title, folder / "failure.png")
    plot_moment(session, moment_s, title, folder / "last_second.png", TRUTH_S)
    changed = changes(session, moment_s)
    about: dict[str, Any] = {"virtual_time_s": session.time_s, "changes_before_the_failure": changed}
    fault = first_fault(session)
    if fault is not None:
        time_s, name = fault
        plot_moment(session, time_s, f"first fault: {name}", folder / "first_fault.png")
        about["first_fault"] = {"fault": name, "time_s": time_s, "changes": changes(session, time_s)}
    simulator = getattr(session, "simulator", None)
    if config is not None:
        about |= {"seed": config.seed, "machine": str(config.machine), "node": config.node}
    if simulator is not None:
        about |= {"simulator": shlex.join(simulator.command), "stderr": simulator.errors}
    about |= {"view": f"{COMMAND} view --replay {shlex.quote(str(folder))}"} | notes
    (folder / "bench.json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    _write_page(folder, about | {"error": error}, title)
    return changed


def clear(folder: Path) -> None:
    """Removes what an earlier failure has left: it would be taken for a part of the next one."""
    for name in LEFT:
        (folder / name).unlink(missing_ok=True)


def _write_page(folder: Path, about: dict[str, Any], title: str) -> None:
    from salient.pages import Plot, write_page

    plots = [Plot("", title, (folder / name).read_bytes())
             for name, title in (("failure.png", f"The {title}"), ("first_fault.png", "The first fault"),
                                ("last_second.png", "The second before"))
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


def changes(session: Session, time_s: float) -> list[str]:
    """What changed around a moment, in order: signals with named values of drive and test bench, the load, and the
    variables that were set. The torque reference in torque mode only: in speed mode the speed controller changes it all
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
    found += _settings(session, from_s, to_s)
    return [f"{at_s:.6f} s {text}" for at_s, text in sorted(found)]


def _in_torque_mode(session: Session, time_s: float) -> bool:
    mode = session.telemetry["DRIVE_STATUS.mode"]
    at = int(np.searchsorted(mode.time_s, time_s, side="right")) - 1
    return at >= 0 and (mode.choices or {}).get(int(mode.value[at])) == "torque"


def _settings(session: Session, from_s: float, to_s: float) -> list[tuple[float, str]]:
    """Variables of the test bench that were set."""
    message = session.rig_database.get_message_by_name("RIG_SET")
    found = []
    for time_ns, frame in session.log:
        if (frame.arbitration_id == message.frame_id and frame.is_extended_id and from_s <= time_ns / 1e9 <= to_s
                and len(frame.data) == message.length):
            values: dict[str, Any] = dict(message.decode_simple(bytes(frame.data)))
            name = str(values["quantity"])
            when = f" at {values['at_us'] / 1e6:g} s" if values.get("at_us") else ""
            found.append((time_ns / 1e9, f"RIG_SET: {name} = {values.get(name)}{when}"))
    return found


def plot_moment(session: Session, time_s: float, title: str, path: Path, before_s: float = BEFORE_S) -> None:
    """Speed, torque and phase currents, true and in the telemetry, and the drive's state, around a moment."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = (
        [("telemetry", "DRIVE_MOTION.speed_reference_rpm"), ("telemetry", "speed_rpm"), ("truth", "speed_rpm")],
        [("telemetry", "torque_reference_Nm"), ("telemetry", "torque_estimate_Nm"), ("truth", "torque_Nm"),
         ("truth", "load_torque_Nm")],
        [("truth", f"current_{phase}_A") for phase in "abcd"],
    )  # fmt: skip
    figure = Figure(figsize=(10, 9.5), layout="constrained")
    FigureCanvasAgg(figure)
    *rows, below = figure.subplots(len(panels) + 1, 1, sharex=True, height_ratios=(1, 1, 1, 0.6))
    for axes, panel in zip(rows, panels, strict=True):
        for (source, name), colour in zip(panel, COLOURS, strict=False):
            signal = getattr(session, source)[name]
            if name == "current_d_A" and not signal.value.any():
                continue  # a machine of three phases
            signal = signal.between(time_s - before_s, time_s + AFTER_S)
            axes.plot(signal.time_s, signal.value, label=f"{source} {signal.name}", color=colour,
                      marker="." if before_s <= BEFORE_S else "", markersize=3)
            axes.set_ylabel(signal.unit)
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=4, fontsize="small", frameon=False)
    state = session.telemetry["DRIVE_STATUS.state"]
    states = state.choices or {}
    below.set_yticks(list(states), list(states.values()))
    state = state.between(time_s - before_s, time_s + AFTER_S)
    below.step(state.time_s, state.value, where="post", color=COLOURS[0])
    for axes in (*rows, below):
        axes.axvline(time_s, color="black", linewidth=1, linestyle="--")
        axes.grid(alpha=0.3)
    below.set_ylabel("state")
    below.set_xlabel("virtual time, s")
    figure.suptitle(f"{title} at {time_s:.6f} s")
    figure.savefig(path, dpi=110)
