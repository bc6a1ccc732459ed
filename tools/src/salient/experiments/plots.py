"""Plots of the demo: the paper's figures 5, 6 and 7 with this drive's results, and the phase currents.

A plot has one column per controller, all columns with the same scales. Each function takes `recordings`, which maps a
controller to the recording of its run (see metrics.py for the fields; one `current_<phase>_A` per phase), and the
matching part of results.json (`ours` and `paper`: controller -> metric -> value or None), and writes a PNG. Equal input
gives equal bytes: the file contains neither date nor version.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from salient.experiments.metrics import BAND, RIPPLE_WINDOW_S
from salient.experiments.scenario import LoadStep, RunResult
from salient.pages import controller_colour

Recordings = Mapping[str, np.ndarray]
Metrics = Mapping[str, Mapping[str, float | None]]

CONTROLLER_TITLE = {
    "traditional": "Traditional: PI, hysteresis DITC",
    "paper": "Paper: SMC, BP-PID in DITC",
    "salient": "Salient: observer, predictive flux PWM",
}
PAPER_LOAD = LoadStep(0.13, 8.0)
PAPER_COLOUR = "#6f6f6f"
LOAD_COLOUR = "#222222"
BAND_COLOUR = "#dfe9d8"
PHASE_COLOUR = ("#7a3fa0", "#12908e", "#d39a12", "#b03a5b")

_WIDTH_IN = 11.0
_COLUMN_IN = 4.4
"""Minimum width of a column, for its titles; more columns than fit make the plot wider."""

# Background of text that may overlap a line.
_TEXT_BOX = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}

# Lines are drawn through the minimum and the maximum of each of this many slices of the visible time: finer than the
# pixels of the plot, so that no extreme is lost.
SLICES = 1500

# Common to all plots of controllers.
STYLE: Any = {
    "font.family": "DejaVu Sans",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e6e6e6",
    "axes.axisbelow": True,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
}
_STYLE: Any = {
    **STYLE,
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.edgecolor": "#8a8a8a",
    "axes.linewidth": 0.8,
    "axes.labelcolor": "#333333",
    "grid.linewidth": 0.7,
    "xtick.color": "#555555",
    "ytick.color": "#555555",
    "lines.linewidth": 1.3,
    "lines.solid_joinstyle": "round",
    "agg.path.chunksize": 0,
    "path.simplify": False,
}


def extremes(time: np.ndarray, values: np.ndarray, slices: int = SLICES) -> tuple[np.ndarray, np.ndarray]:
    """A line of at most 2 * slices points through the minimum and the maximum of each slice, in time order.

    Slices hold equal numbers of samples. The plotted line covers the same area as the line through all samples, to
    within the width of a slice. Inputs of at most 2 * slices samples are returned unchanged.
    """
    count = len(values)
    if count <= 2 * slices:
        return np.asarray(time), np.asarray(values)
    bounds = np.linspace(0, count, slices + 1).astype(int)
    indices = np.empty(2 * slices, dtype=int)
    for index, (first, end) in enumerate(pairwise(bounds)):
        part = values[first:end]
        low, high = first + int(np.argmin(part)), first + int(np.argmax(part))
        indices[2 * index], indices[2 * index + 1] = min(low, high), max(low, high)
    return np.asarray(time[indices]), np.asarray(values[indices])


def plot_start(path: Path, recordings: Recordings, ours: Metrics, paper: Metrics, reference_rpm: float = 600.0,
               command_time_s: float = 0.0) -> None:
    """Figure 5: start without load; top: the whole start, bottom: detail around the reference."""

    def draw(figure: Figure) -> None:
        axes = _grid(figure, recordings, rows=2, heights=(1.25, 1.0))
        max_rpm = max(_value(of, "max_speed_rpm") for of in (*ours.values(), *paper.values()))
        end_s = min(float(recording["time_s"][-1]) for recording in recordings.values()) - command_time_s
        settled_s = [of["settling_time_s"] for of in (*ours.values(), *paper.values())]
        known_s = [time_s for time_s in settled_s if time_s is not None]
        shown_s = end_s if len(known_s) < len(settled_s) else min(end_s, 1.5 * max(known_s))
        for column, (controller, recording) in enumerate(recordings.items()):
            colour = controller_colour(controller)
            published = paper.get(controller, {})
            for axis in axes[:, column]:
                _band(axis, reference_rpm)
                _trace(axis, recording["time_s"] - command_time_s, recording["speed_rpm"], colour)
                axis.set_xlim(0.0, shown_s)
            _mark_settling(axes[0, column], reference_rpm, ours[controller]["settling_time_s"],
                           published.get("settling_time_s"), colour)
            axes[0, column].set_title(_letter(column) + _title(controller))
            axes[0, column].set_ylim(0.0, 1.13 * reference_rpm)
            zoom = axes[1, column]
            zoom.set_title("detail around the reference")
            zoom.set_ylim(0.985 * reference_rpm, max(max_rpm, 1.008 * reference_rpm) + 0.008 * reference_rpm)
            _mark_maximum(zoom, ours[controller], published, colour)
            zoom.set_xlabel("time after the speed command / s")
        _label_rows(axes, "speed / (r/min)", "speed / (r/min)")

    _save(path, draw, len(recordings), height_in=6.0, row_gap=0.24)


def plot_load_step_speed(path: Path, recordings: Recordings, ours: Metrics, paper: Metrics, load: LoadStep = PAPER_LOAD,
                         reference_rpm: float = 150.0) -> None:
    """Figure 6: load step, by the paper of 8 N m at 150 r/min; the whole run, the speed around the step, the
    first 10 ms after it."""

    def draw(figure: Figure) -> None:
        axes = _grid(figure, recordings, rows=3, heights=(1.0, 1.15, 0.9))
        after_ms, step_time_s = _zoom_after_ms(ours), load.at_s
        for column, (controller, recording) in enumerate(recordings.items()):
            colour = controller_colour(controller)
            mine, published = ours[controller], paper.get(controller, {})
            whole, around, first = axes[:, column]
            _band(whole, reference_rpm)
            _trace(whole, recording["time_s"], recording["speed_rpm"], colour)
            _step_line(whole, step_time_s)
            whole.annotate(f"{load.torque_Nm:g} N m", (step_time_s, 0.25 * reference_rpm),
                           xytext=(5, 0), textcoords="offset points",
                           color=LOAD_COLOUR, fontsize=8.5, va="center")
            whole.set_xlim(0.0, float(recording["time_s"][-1]))
            whole.set_ylim(0.0, 1.16 * reference_rpm)
            whole.set_title(_letter(column) + _title(controller))
            whole.set_xlabel("time / s")

            for axis, from_ms, to_ms in ((around, -0.1 * after_ms, after_ms), (first, -1.0, 10.0)):
                part = _between(recording, step_time_s + from_ms / 1e3, step_time_s + to_ms / 1e3)
                _band(axis, reference_rpm)
                _trace(axis, (part["time_s"] - step_time_s) * 1e3, part["speed_rpm"], colour)
                _step_line(axis, 0.0)
                axis.set_xlim(from_ms, to_ms)
                axis.set_xlabel("time after the load step / ms")
                _mark_recovery(axis, mine["recovery_time_s"], to_ms, colour)
            around.set_title(_step_summary(mine), color=colour, fontweight="bold")
            if published:
                around.annotate(f"published: {_step_summary(published, short=True)}", (0.97, 0.06),
                                xycoords="axes fraction", ha="right", color=PAPER_COLOUR, bbox=_TEXT_BOX)
            first.set_title("the first 10 ms")
        for row in axes[1:]:
            _same_limits(row)
        _label_rows(axes, *["speed / (r/min)"] * 3)

    _save(path, draw, len(recordings), height_in=8.8)


def plot_load_step_torque(path: Path, recordings: Recordings, ours: Metrics, paper: Metrics,
                          load: LoadStep = PAPER_LOAD,
                          window_s: tuple[float, float] = RIPPLE_WINDOW_S) -> None:
    """Figure 7: torque around the step, in the steady window with extremes and mean, and 1 ms around its maximum."""

    def draw(figure: Figure) -> None:
        axes = _grid(figure, recordings, rows=3, heights=(1.0, 1.15, 0.8))
        top_Nm = max(_value(of, "torque_max_Nm") for of in ours.values())
        bottom_Nm = min(_value(of, "torque_min_Nm") for of in ours.values())
        margin_Nm = 0.12 * (top_Nm - bottom_Nm) + 0.05
        for column, (controller, recording) in enumerate(recordings.items()):
            colour = controller_colour(controller)
            mine, published = ours[controller], paper.get(controller, {})
            around, steady, detail = axes[:, column]

            part = _between(recording, load.at_s - 0.01, load.at_s + 0.05)
            _trace(around, (part["time_s"] - load.at_s) * 1e3, part["torque_Nm"], colour, width=0.8)
            _trace(around, (part["time_s"] - load.at_s) * 1e3, part["load_torque_Nm"], LOAD_COLOUR, width=1.0)
            around.annotate("load", (0.0, 0.5 * load.torque_Nm), xytext=(-5, 0), textcoords="offset points",
                            color=LOAD_COLOUR,
                            fontsize=8.5, ha="right")
            around.set_xlim(-10.0, 50.0)
            around.set_xlabel("time after the load step / ms")
            around.set_title(_letter(column) + _title(controller))

            part = _between(recording, *window_s)
            _trace(steady, part["time_s"], part["torque_Nm"], colour, width=0.8)
            for name in ("torque_max_Nm", "torque_mean_Nm", "torque_min_Nm"):
                steady.axhline(_value(mine, name), color=LOAD_COLOUR, linewidth=0.9,
                               linestyle="-" if name == "torque_mean_Nm" else (0, (4, 2)))
            steady.set_xlim(*window_s)
            steady.set_ylim(bottom_Nm - 2.0 * margin_Nm, top_Nm + margin_Nm)
            steady.set_xlabel("time / s")
            steady.set_title(f"K$_t$ = {_value(mine, 'torque_ripple'):.3g}", fontweight="bold", color=colour)
            if published.get("torque_ripple") is not None:
                steady.set_title(f"published: {_value(published, 'torque_ripple'):g}", loc="right", color=PAPER_COLOUR,
                                 fontsize=9.5)
            steady.annotate("max {torque_max_Nm:.2f}   mean {torque_mean_Nm:.2f}   min {torque_min_Nm:.2f} N m"
                            .format_map(mine), (0.97, 0.05), xycoords="axes fraction", ha="right", color="#333333",
                            bbox=_TEXT_BOX)

            # `part` is still the steady window.
            peak_s = float(part["time_s"][int(np.argmax(part["torque_Nm"]))])
            part = _between(recording, peak_s - 0.5e-3, peak_s + 0.5e-3)
            _trace(detail, (part["time_s"] - peak_s) * 1e3, part["torque_Nm"], colour)
            detail.set_xlim(-0.5, 0.5)
            detail.set_title("1 ms around the maximum torque, separate scale")
            detail.set_xlabel(f"time from {peak_s:.4f} s / ms")
        _same_limits(axes[0])
        _label_rows(axes, "torque / (N m)", "torque / (N m)", "torque / (N m)")

    _save(path, draw, len(recordings), height_in=8.8)


def plot_phase_currents(path: Path, recordings: Recordings, from_s: float = RIPPLE_WINDOW_S[0],
                        rotor_span_deg: float = 60.0) -> None:
    """Phase currents and torque over the rotor angle from `from_s`, for `rotor_span_deg` (two strokes)."""

    def draw(figure: Figure) -> None:
        axes = _grid(figure, recordings, rows=2, heights=(1.2, 0.8))
        for column, (controller, recording) in enumerate(recordings.items()):
            part = recording[_index(recording, from_s):]
            travel_deg = np.unwrap(np.asarray(part["rotor_angle_deg"], dtype=float), period=360.0)
            travel_deg -= travel_deg[0]
            beyond = np.flatnonzero(travel_deg > rotor_span_deg)
            end = int(beyond[0]) + 1 if beyond.size else len(travel_deg)
            part, travel_deg = part[:end], travel_deg[:end]
            currents, torque = axes[:, column]
            for number, name in enumerate(_current_fields(recording)):
                _trace(currents, travel_deg, part[name], PHASE_COLOUR[number], label=name[8].upper(), width=1.0)
            currents.set_title(_letter(column) + _title(controller).partition(":")[0])
            currents.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), borderaxespad=0.0, ncols=4, handlelength=1.5,
                            columnspacing=1.4)
            _trace(torque, travel_deg, part["torque_Nm"], controller_colour(controller), width=0.8)
            for axis in (currents, torque):
                axis.set_xlim(0.0, rotor_span_deg)
                axis.set_xticks(np.linspace(0.0, rotor_span_deg, 5))
            torque.set_xlabel(f"rotor angle from {from_s:g} s / deg")
        for row in axes:
            _same_limits(row, from_zero=True)
        _label_rows(axes, "phase current / A", "torque / (N m)")

    _save(path, draw, len(recordings), height_in=5.2, row_gap=0.14)


# --- helpers --------------------------------------------------------------------------------------------------------

def plot_position(result: RunResult) -> None:
    """position.png in the folder of a run with positions: position with its targets, and the following error over
    time, as the drive tells them."""
    told = result.telemetry
    position_told, error_told = told["DRIVE_POSITION.position_deg"], told["DRIVE_POSITION.following_error_deg"]
    time_s = np.asarray(position_told.time_s)
    position_deg, error_deg = (np.asarray(each.value, dtype=float) for each in (position_told, error_told))
    targets = [(step.at_s, step.value_deg) for step in result.scenario.position]
    controller = result.scenario.controller

    def draw(figure: Figure) -> None:
        position, error = figure.subplots(2, 1, sharex=True, height_ratios=(1.2, 1.0))
        end_s = float(time_s[-1]) if len(time_s) else 0.0
        times = [min(at_s, end_s) for at_s, _ in targets]
        position.step([*times, end_s], [*(deg for _, deg in targets), targets[-1][1]], where="post",
                      color=PAPER_COLOUR, linewidth=0.9, label="target")
        _trace(position, time_s, position_deg, controller_colour(controller), label="position")
        position.legend(loc="best")
        position.set_title(_title(controller))
        _trace(error, time_s, error_deg, controller_colour(controller))
        error.set_xlabel("time / s")
        _label_rows(np.array([[position], [error]]), "position / deg", "following error / deg")

    _save(result.folder / "position.png", draw, 1, 5.0, row_gap=0.12)


def _grid(figure: Figure, recordings: Recordings, rows: int, heights: tuple[float, ...]) -> np.ndarray:
    return figure.subplots(rows, len(recordings), squeeze=False, gridspec_kw={"height_ratios": heights})


def _save(path: Path, draw: Callable[[Figure], None], columns: int, height_in: float, row_gap: float = 0.45) -> None:
    with matplotlib.rc_context(_STYLE):
        width_in = max(_WIDTH_IN, columns * _COLUMN_IN)
        figure = Figure(figsize=(width_in, height_in), dpi=140)
        draw(figure)
        # Margins in inches, equal for plots of different size.
        figure.subplots_adjust(left=0.73 / width_in, right=1.0 - 0.17 / width_in, bottom=0.55 / height_in,
                               top=1.0 - 0.35 / height_in, hspace=row_gap, wspace=0.14)
        figure.savefig(path, metadata={"Software": None})


def _trace(axis: Axes, time: np.ndarray, values: np.ndarray, colour: str, width: float = 1.3,
           label: str | None = None) -> None:
    axis.plot(*extremes(time, values), color=colour, linewidth=width, label=label)


def _band(axis: Axes, reference_rpm: float) -> None:
    axis.axhspan((1.0 - BAND) * reference_rpm, (1.0 + BAND) * reference_rpm, color=BAND_COLOUR, linewidth=0)
    axis.axhline(reference_rpm, color="#9aa78f", linewidth=0.8)


def _mark_settling(axis: Axes, reference_rpm: float, ours_s: float | None, paper_s: float | None, colour: str) -> None:
    text = "not settled in this run" if ours_s is None else f"settling time {ours_s:.3g} s"
    if ours_s is not None:
        axis.plot([ours_s], [reference_rpm], "o", color=colour, markersize=6.5, zorder=5)
    axis.annotate(text, (0.97, 0.16), xycoords="axes fraction", ha="right", color=colour, fontweight="bold")
    if paper_s is not None:
        axis.plot([paper_s], [reference_rpm], "D", color=PAPER_COLOUR, markerfacecolor="white", markersize=6.5,
                  zorder=4)
        axis.annotate(f"published: {paper_s:g} s", (0.97, 0.07), xycoords="axes fraction", ha="right",
                      color=PAPER_COLOUR)


def _mark_maximum(axis: Axes, ours: Mapping[str, float | None], paper: Mapping[str, float | None], colour: str) -> None:
    rows = [("max.", ours, colour, "bold")]
    if paper.get("max_speed_rpm") is not None:
        rows.append(("published", paper, PAPER_COLOUR, "normal"))
    for row, (name, of, line_colour, weight) in enumerate(rows):
        level_rpm = _value(of, "max_speed_rpm")
        axis.axhline(level_rpm, color=line_colour, linewidth=0.9, linestyle=(0, (4, 2)))
        axis.annotate(f"{name} {level_rpm:.1f} r/min ({_value(of, 'overshoot_percent'):+.2f} %)",
                      (0.97, 0.66 - 0.11 * row), xycoords="axes fraction", ha="right", color=line_colour,
                      fontweight=weight, bbox=_TEXT_BOX)


def _step_line(axis: Axes, when: float) -> None:
    axis.axvline(when, color=LOAD_COLOUR, linewidth=0.8, linestyle=(0, (1, 2)))


def _mark_recovery(axis: Axes, recovery_s: float | None, to_ms: float, colour: str) -> None:
    if recovery_s is None or not 0.0 < recovery_s * 1e3 < to_ms:
        return
    axis.axvline(recovery_s * 1e3, color=colour, linewidth=1.0, linestyle=(0, (4, 2)))
    near_end = recovery_s * 1e3 > 0.6 * to_ms
    axis.annotate("recovered", (recovery_s * 1e3, 0.92), xycoords=("data", "axes fraction"),
                  xytext=(-4 if near_end else 4, 0), textcoords="offset points", color=colour, fontsize=8.5,
                  ha="right" if near_end else "left")


def _step_summary(of: Mapping[str, float | None], short: bool = False) -> str:
    recovery_s, drop = of["recovery_time_s"], f"{_value(of, 'speed_dip_rpm'):.3g} r/min"
    recovery = "no recovery in this run" if recovery_s is None else f"{recovery_s * 1e3:.3g} ms"
    if short:
        return f"{drop}, {recovery}"
    return f"drop {drop}, {recovery if recovery_s is None else f'recovery {recovery}'}"


def _zoom_after_ms(ours: Metrics) -> float:
    """Time range that includes every recovery, limited to 20 to 100 ms."""
    longest_s = max((of["recovery_time_s"] or 0.1) for of in ours.values())
    return float(np.clip(1.3 * longest_s * 1e3, 20.0, 100.0))


def _same_limits(row: np.ndarray, from_zero: bool = False) -> None:
    low = 0.0 if from_zero else min(axis.get_ylim()[0] for axis in row)
    high = max(axis.get_ylim()[1] for axis in row)
    for axis in row:
        axis.set_ylim(low, high)


def _label_rows(axes: np.ndarray, *labels: str) -> None:
    for row, label in zip(axes, labels, strict=True):
        row[0].set_ylabel(label)


def _between(recording: np.ndarray, start_s: float, end_s: float) -> np.ndarray:
    return recording[_index(recording, start_s):_index(recording, end_s) + 1]


def _index(recording: np.ndarray, when_s: float) -> int:
    return int(np.searchsorted(recording["time_s"], when_s - 1e-10))


def _current_fields(recording: np.ndarray) -> list[str]:
    return [name for name in recording.dtype.names or () if name.startswith("current_") and name.endswith("_A")]


def _value(of: Mapping[str, float | None], name: str) -> float:
    value = of[name]
    return float("nan") if value is None else value


def _title(controller: str) -> str:
    return CONTROLLER_TITLE.get(controller, controller)


def _letter(column: int) -> str:
    return f"({'abcdefgh'[column]})  "
