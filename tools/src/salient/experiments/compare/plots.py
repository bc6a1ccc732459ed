"""Plots of compare.html, from the content of compare.json (results_file.py). Equal content gives equal bytes."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from salient.config import CONTROLLERS
from salient.experiments.compare.baseline import Change
from salient.experiments.compare.metrics import METRICS, Metric
from salient.experiments.compare.table import in_order
from salient.experiments.plots import STYLE
from salient.experiments.results import PAPER
from salient.pages import Plot, controller_colour

Content = Mapping[str, Any]

_TARGET_COLOUR = "#222222"
_PUBLISHED_COLOUR = "#6f6f6f"
_MARKER = {"traditional": "s", "paper": "D", "salient": "o"}
_LINES = matplotlib.colormaps["viridis"]
_MACHINE_COLOURS = ("#1b4f9c", "#c8641e", "#1b7f5c", "#8a3b8f")
_CHANGES_MAX = 60

_STYLE: Any = {**STYLE, "font.size": 9.0, "axes.titlesize": 9.5}


def group_plots(group: str, content: Content) -> list[Plot]:
    """The plots of a group; none for a group with tables only or without data."""
    plots = []
    for title, caption, draw in _PLOTS.get(group, ()):
        png = _png(draw, content)
        if png is not None:
            plots.append(Plot(title, caption, png))
    return plots


def changes_plot(changes: Sequence[Change]) -> Plot | None:
    """The changes from the baseline, the largest ones first; None when no change has a percentage."""
    shown = [(change, change.excess_percent) for change in changes if change.excess_percent is not None]
    shown = sorted(shown, key=lambda one: -abs(one[1]))[:_CHANGES_MAX]
    if not shown:
        return None
    png = _png(lambda content: _changes(shown), {})
    caption = ("Each line is a metric that changed by more than the threshold, relative to its value in the baseline"
               " (maximum speeds: to their excess over the reference); to the right: worse.")
    return Plot("Changes from the baseline", caption, png) if png else None


# --- ripple ---------------------------------------------------------------------------------------------------------

def _ripples(content: Content) -> Figure | None:
    """Panels by rate and imperfections, machines along x, one marker per controller and number of pulses."""
    rows = [row for row in _rows(content, "ripple") if row["figure"] == "ripple"]
    panels: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        parts = row["condition"].split(", ")
        title = ", ".join([parts[1], *parts[3:]])
        if len(parts) < 4 or parts[3] == "all imperfections":
            panels.setdefault(title, []).append(row)
        else:
            panels.setdefault("40 kHz, one imperfection, saturating", []).append(row)
    if not panels:
        return None
    figure, axes = _panels(len(panels), columns=2, height_in=3.2, sharey=True)
    for axis, (title, of) in zip(axes, panels.items(), strict=True):
        single = "one imperfection" in title
        ticks = list(dict.fromkeys(_tick(row, single) for row in of))
        for row in of:
            two = "two pulses" in row["condition"]
            for controller, value in row["values"].items():
                if value is None or (two and controller != "salient"):
                    continue
                x = ticks.index(_tick(row, single)) + 0.16 * (CONTROLLERS.index(controller) - 1) + 0.12 * two
                axis.plot(x, value, _MARKER.get(controller, "o"), color=controller_colour(controller), markersize=6,
                          markerfacecolor="white" if two else controller_colour(controller))
            if row["wanted"] is not None:
                x = ticks.index(_tick(row, single)) + 0.16 + 0.12 * two
                axis.plot([x - 0.09, x + 0.09], [row["wanted"]] * 2, color=_TARGET_COLOUR, linewidth=1.4)
        axis.set_xticks(range(len(ticks)), ticks, rotation=20 if single else 0, ha="right" if single else "center")
        axis.set_xlim(-0.5, len(ticks) - 0.5)
        _logarithmic(axis.yaxis)
        axis.set_title(title)
        axis.axhline(PAPER["load_step_150"]["paper"]["torque_ripple"], color=_PUBLISHED_COLOUR, linewidth=0.8,
                     linestyle=(0, (4, 2)))
    axes[0].set_ylabel("K$_t$ over 0.1 s")
    _legend(figure, rows)
    return figure


def _tick(row: Mapping[str, Any], single: bool) -> str:
    parts = row["condition"].split(", ")
    return str(parts[-1] if single else parts[0].replace("_", "\n"))


def _traces(content: Content) -> Figure | None:
    """Torque over the paper's window, one panel per controller and number of pulses, each with its own scale."""
    traces = [trace for trace in content["traces"]
              if trace["controller"] == "salient" or "one pulse" in trace["condition"]]
    if not traces:
        return None
    figure, axes = _panels(len(traces), columns=1, height_in=1.7)
    for axis, trace in zip(axes, traces, strict=True):
        torque_Nm = np.asarray(trace["torque_Nm"])
        axis.plot(trace["time_s"], torque_Nm, color=controller_colour(trace["controller"]), linewidth=0.7)
        pulses = f", {trace['condition'].split(', ')[2]}" if trace["controller"] == "salient" else ""
        axis.set_title(f"{trace['controller']}{pulses}: {torque_Nm.min():.3f} to {torque_Nm.max():.3f} N m")
        axis.set_ylabel("N m")
        axis.set_xlim(trace["time_s"][0], trace["time_s"][-1])
    axes[-1].set_xlabel("time / s")
    return figure


def _over_speed(content: Content) -> Figure | None:
    return _over(content, "speeds", "speed / (r/min)")


def _over_load(content: Content) -> Figure | None:
    return _over(content, "loads", "load / (N m)")


def _torque_over_speed(content: Content) -> Figure | None:
    """Mean torque over speed and its bound, one panel per machine; braking below zero."""
    every = _rows(content, "torque_speed")
    rows = [row for row in every if row["figure"] == "torque_mean_Nm"]
    bounds = {row["condition"]: row["values"]["salient"] for row in every
              if row["figure"] == "torque_bound_Nm" and row["values"].get("salient") is not None}
    machines = list(dict.fromkeys(row["condition"].split(", ")[0] for row in rows))
    if not rows:
        return None
    figure, axes = _panels(len(machines), columns=4, height_in=3.4, sharey=True)
    for axis, machine in zip(axes, machines, strict=True):
        for controller in _controllers(rows):
            for quadrant in ("motoring", "braking"):
                points = [(float(speed.split()[0]), row["values"][controller]) for row in rows
                          for of, speed, kind in [row["condition"].split(", ")]
                          if (of, kind) == (machine, quadrant) and row["values"].get(controller) is not None]
                if points:
                    axis.plot(*zip(*points, strict=True), _MARKER.get(controller, "o") + "-",
                              color=controller_colour(controller), markersize=4)
        for quadrant in ("motoring", "braking"):
            points = [(float(speed.split()[0]), bound_Nm) for condition, bound_Nm in bounds.items()
                      for of, speed, kind in [condition.split(", ")] if (of, kind) == (machine, quadrant)]
            if points:
                axis.plot(*zip(*points, strict=True), color=_TARGET_COLOUR, linewidth=1.0)
        axis.axhline(0.0, color="#555555", linewidth=0.8)
        axis.set_title(machine)
        axis.set_xlabel("speed / (r/min)")
        axis.set_xlim(0.0, None)
    axes[0].set_ylabel("mean torque / (N m)")
    _legend(figure, rows, {"bound": {"color": _TARGET_COLOUR, "linewidth": 1.0}} if bounds else {})
    return figure


def _over(content: Content, group: str, label: str) -> Figure | None:
    """Ripple over the number at the start of a condition's second part, one panel per machine."""
    rows = [row for row in _rows(content, group) if row["figure"] == "ripple"]
    by_machine: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        by_machine.setdefault(row["condition"].split(", ")[0], []).append(row)
    if not rows:
        return None
    figure, axes = _panels(len(by_machine), columns=4, height_in=3.0, sharey=True)
    for axis, (machine, of) in zip(axes, by_machine.items(), strict=True):
        numbers = [float(row["condition"].split(", ")[1].split()[0]) for row in of]
        for controller in _controllers(rows):
            values = [row["values"].get(controller) or np.nan for row in of]
            axis.plot(numbers, values, _MARKER.get(controller, "o") + "-", color=controller_colour(controller),
                      markersize=5)
        targets = [(number, row["wanted"]) for number, row in zip(numbers, of, strict=True)
                   if row["wanted"] is not None]
        if targets:
            axis.plot(*zip(*targets, strict=True), "_", color=_TARGET_COLOUR, markersize=16, markeredgewidth=1.5)
        _logarithmic(axis.yaxis)
        axis.set_xticks(numbers)
        axis.set_title(machine)
        axis.set_xlabel(label)
    axes[0].set_ylabel("K$_t$ over 0.1 s")
    _legend(figure, rows)
    return figure


# --- load step ------------------------------------------------------------------------------------------------------

def _over_angle(content: Content) -> Figure | None:
    runs = [run for run in content["runs"] if run["group"] == "dip" and run["figures"]]
    conditions = list(dict.fromkeys(run["condition"] for run in runs))
    if not conditions:
        return None
    limits = {(row["condition"], row["statistic"]): row for row in _rows(content, "dip")
              if row["figure"] == "speed_dip_rpm"}
    bounds = {"median": (0, (1, 2)), "worst": (0, (5, 2))}
    figure, axes = _panels(len(conditions), columns=3, height_in=2.9, sharey=True)
    for axis, condition in zip(axes, conditions, strict=True):
        for controller in _controllers_of_runs(runs):
            points = sorted((run["figures"]["step_angle_deg"], run["figures"]["speed_dip_rpm"]) for run in runs
                            if run["condition"] == condition and run["controller"] == controller)
            if points:
                axis.plot(*zip(*points, strict=True), _MARKER.get(controller, "o") + "-",
                          color=controller_colour(controller), markersize=3.5, linewidth=1.0)
        for statistic, dash in bounds.items():
            row = limits.get((condition, statistic))
            if row and row["bound"] is not None:
                axis.axhline(row["bound"], color=_PUBLISHED_COLOUR, linewidth=1.0, linestyle=dash)
        _logarithmic(axis.yaxis)
        axis.set_title(condition.replace(", reserve", ",\nreserve"))
        axis.set_xlabel("rotor angle within a stroke / deg")
    axes[0].set_ylabel("speed drop / (r/min)")
    _legend(figure, _rows(content, "dip"), {f"limit of the {statistic}": {"color": _PUBLISHED_COLOUR, "linestyle": dash}
                                            for statistic, dash in bounds.items()})
    return figure


# --- moving loads, ranges -------------------------------------------------------------------------------------------

def _curves(group: str, metrics: Sequence[tuple[str, str]], where: Callable[[list[str]], tuple[str, str, float]],
            x_label: str) -> Callable[[Content], Figure | None]:
    """Metrics over a number in the conditions; panels by metric and machine.

    metrics: (metric, statistic). where: the parts of a condition, without commas -> panel, line, number. A group with
    several lines has one colour per line, and one of a single line one colour per controller.
    """
    def draw(content: Content) -> Figure | None:
        rows = [row for row in _rows(content, group) if (row["figure"], row["statistic"]) in metrics]
        if not rows:
            return None
        places = [where(row["condition"].split(", ")) for row in rows]
        panels = list(dict.fromkeys((row["figure"], panel) for row, (panel, _, _) in zip(rows, places, strict=True)))
        panels.sort(key=lambda panel: [metric for metric, _ in metrics].index(panel[0]))
        lines = list(dict.fromkeys(line for _, line, _ in places))
        controllers = _controllers(rows)
        figure, axes = _panels(len(panels), columns=max(2, len(panels) // len(metrics)), height_in=2.8)
        for axis, (name, panel) in zip(axes, panels, strict=True):
            of = METRICS[name]
            for line in lines:
                for controller in controllers:
                    shown = [(x, row) for row, (its_panel, its_line, x) in zip(rows, places, strict=True)
                             if (row["figure"], its_panel, its_line) == (name, panel, line)
                             and controller in row["values"]]
                    colour = controller_colour(controller) if len(lines) == 1 else _LINES(
                        lines.index(line) / max(1, len(lines) - 1))
                    axis.plot([x for x, _ in shown], [_visible(row["values"][controller], of) for _, row in shown],
                              _MARKER.get(controller, "o") + "-", color=colour, markersize=4, linewidth=1.0)
                    missing = [x for x, row in shown if row["values"][controller] is None]
                    axis.plot(missing, [0.97] * len(missing), "x", color=colour, transform=axis.get_xaxis_transform())
                    targets = [(x, row["wanted"] * of.factor) for x, row in shown if row["wanted"]]
                    if targets:
                        axis.plot(*zip(*targets, strict=True), "_", color=_TARGET_COLOUR, markersize=14)
            _logarithmic(axis.xaxis)
            axis.set_xticks(sorted({x for _, _, x in places}))
            axis.minorticks_off()
            _logarithmic(axis.yaxis)
            axis.set_title(panel)
            axis.set_xlabel(x_label)
            axis.set_ylabel(f"{of.label}, {of.unit}" if of.unit else of.label, fontsize=7.5)
        if len(lines) == 1:
            _legend(figure, rows)
        else:
            handles = [Line2D([], [], color=_LINES(number / (len(lines) - 1)), marker="o")
                       for number in range(len(lines))]
            figure.legend(handles, lines, loc="outside upper right", ncols=len(lines))
        return figure

    return draw


def _costs(controller: str) -> Callable[[Content], Figure | None]:
    """Ratios to the run with the right file over the errors of the file, panels by metric, a marker per machine."""
    def draw(content: Content) -> Figure | None:
        rows = [row for row in _rows(content, "mismatch") if controller in {**row["values"], **row["failed"]}]
        shown = [row for row in rows if row["figure"].endswith("_to_right")]
        if not shown:
            return None
        machines, errors, names = (list(dict.fromkeys(parts)) for parts in zip(*(
            (*row["condition"].split(", "), row["figure"]) for row in shown), strict=True))
        names = [name for name in names if any(controller in row["values"] for row in shown if row["figure"] == name)]
        figure, axes = _panels(len(names), columns=4, height_in=0.9 + 0.17 * len(errors), sharey=True)
        for axis, name in zip(axes, names, strict=True):
            of = METRICS[name]
            for number, machine in enumerate(machines):
                look: Any = {"color": _MACHINE_COLOURS[number % len(_MACHINE_COLOURS)], "linestyle": "",
                             "marker": "os^D"[number % 4], "markersize": 4.5}
                places = {errors.index(row["condition"].split(", ")[1]) + 0.16 * (number - (len(machines) - 1) / 2):
                          row["values"].get(controller) for row in shown
                          if row["figure"] == name and row["condition"].split(", ")[0] == machine}
                axis.plot([value for value in places.values() if value is not None],
                          [y for y, value in places.items() if value is not None], **look)
                missing = [y for y, value in places.items() if value is None]
                axis.plot([0.98] * len(missing), missing, **{**look, "marker": "x"},
                          transform=axis.get_yaxis_transform())
            axis.axvline(1.0, color="#555555", linewidth=0.8)
            for y in range(1, len(errors)):
                axis.axhline(y - 0.5, color="#dddddd", linewidth=0.5)
            ratios = [value for row in shown if row["figure"] == name
                      and (value := row["values"].get(controller)) is not None]
            low, high = min([0.95, *ratios]), max([1.05, *ratios])
            axis.set_xlim(low / (high / low) ** 0.1, high * (high / low) ** 0.1)
            if high > 3.0:
                _logarithmic(axis.xaxis)
            axis.tick_params(axis="y", labelsize=7.5)
            axis.set_title(of.label, fontsize=8.0)
            axis.set_xlabel("of the right file's")
        axes[0].set_yticks(range(len(errors)), errors)
        axes[0].set_ylim(len(errors) - 0.5, -0.5)
        handles = [Line2D([], [], color=_MACHINE_COLOURS[number % len(_MACHINE_COLOURS)], marker="os^D"[number % 4],
                          linestyle="") for number in range(len(machines))]
        figure.legend(handles, machines, loc="outside upper right", ncols=len(machines))
        return figure

    return draw


def _visible(value: float | None, of: Metric) -> float:
    """For a logarithmic axis: at least the metric's resolution; nothing is drawn for an event that did not occur."""
    return np.nan if value is None else max(value * of.factor, of.resolution)


# --- studies --------------------------------------------------------------------------------------------------------

def _distributions(content: Content) -> Figure | None:
    """Cumulative distribution over the drives, one panel per metric, with its limit."""
    runs = [run for run in content["runs"] if run["condition"] == "random drives" and run["figures"]]
    rows = {row["figure"]: row for row in _rows(content, "robustness")
            if row["condition"] == "random drives" and row["statistic"] == "worst"}
    if not runs or not rows:
        return None
    figure, axes = _panels(len(rows), columns=3, height_in=2.5, sharey=True)
    for axis, (name, row) in zip(axes, rows.items(), strict=True):
        of = METRICS[name]
        for controller in _controllers_of_runs(runs):
            values = [run["figures"][name] for run in runs if run["controller"] == controller]
            numbers = sorted(value * of.factor for value in values if value is not None)
            axis.step(numbers, 100.0 * np.arange(1, len(numbers) + 1) / len(values),
                      color=controller_colour(controller), where="post", linewidth=1.3)
        if row["wanted"] is not None:
            axis.axvline(row["wanted"] * of.factor, color=_TARGET_COLOUR, linewidth=1.2, linestyle=(0, (5, 2)))
        if name in ("speed_error_percent", "cycle_percent", "speed_dip_rpm"):
            _logarithmic(axis.xaxis)
        axis.set_xlabel(f"{of.label}, {of.unit}")
    for axis in axes[::3]:
        axis.set_ylabel("drives, %")
    _legend(figure, list(rows.values()))
    return figure


def _changes(changes: Sequence[tuple[Change, float]]) -> Figure:
    figure, (axis,) = _panels(1, columns=1, height_in=0.8 + 0.2 * len(changes))
    for y, (change, percent) in enumerate(changes):
        colour = "#b3261e" if change.worse else "#1b7f5c"
        axis.plot([0.0, percent], [y, y], color=colour, linewidth=2.0)
        axis.plot(percent, y, "o", color=colour, markersize=4)
    axis.set_yticks(range(len(changes)), [f"{change.key[1]}, {change.controller}: {change.label}"
                                          for change, _ in changes], fontsize=7.5)
    axis.set_ylim(len(changes) - 0.5, -0.5)
    axis.axvline(0.0, color="#555555", linewidth=0.8)
    axis.set_xlabel("change, %")
    return figure


_PLOTS: dict[str, tuple[tuple[str, str, Callable[[Content], Figure | None]], ...]] = {
    "ripple": (
        ("Torque ripple by machine and rate",
         "K_t of the true torque, sampled every microsecond. Hollow: two pulses a period. Short lines: target;"
         " dashed: published value of the paper's controller.", _ripples),
        ("Torque over the paper's window", "Saturating machine, 40 kHz; each panel with its own scale. Every slice of"
         " the window spans from its minimum to its maximum.", _traces),
    ),
    "speeds": (("Torque ripple over speed", "Short lines: target.", _over_speed),),
    "loads": (("Torque ripple over load", "150 r/min; the mean torque is the load plus 0.31 N m of friction.",
               _over_load),),
    "torque_speed": (("Torque over speed", "Mean of the true torque in torque mode at the current limit, while a"
                      " dynamometer holds the shaft; below zero: braking. Black: the largest torque of a pulse of"
                      " voltage in each electrical revolution.", _torque_over_speed),),
    "dip": (("Speed drop over the rotor angle at the load step", "Dotted and dashed: theoretical limit of median and"
             " maximum (non-causal controller, voltage 0 µs (ideal sensing) or 100 µs after the step).", _over_angle),),
    "moving": (("Speed under a sine", "Peak-to-peak speed. Short lines: target.", _curves(
        "moving", (("speed_swing_rpm", ""),), lambda parts: (f"{parts[0]}, {parts[1]}", "", _number(parts[2])),
        "frequency / Hz")),),
    "ramps": (("Speed drop under a load ramp", "Short lines: target.", _curves(
        "ramps", (("speed_dip_rpm", ""),), lambda parts: (parts[0], "", _number(parts[1])), "ramp / ms")),),
    "inertia": (("Inertia other than assumed", "Short lines: target. Crosses: not recovered.", _curves(
        "inertia", (("recovery_ratio", ""), ("swing_percent", "worst")),
        lambda parts: (parts[0], "", float(parts[1].split()[-1])), "inertia / assumed inertia")),),
    "rates": (("Control rates", "One line per machine.", _curves(
        "rates", (("ripple", ""), ("speed_dip_rpm", "")), lambda parts: ("", parts[0], _number(parts[1])),
        "control rate / kHz")),),
    "encoders": (("Encoders", "Longest time with a torque against the load of more than a tenth of it, the largest over"
                  " the rotor angles, by speed. Short lines: target.", _curves(
        "encoders", (("against_periods", "worst"),), lambda parts: (
            ", ".join((parts[0], *parts[1].split(" and ")[1:])), parts[2], _number(parts[1])), "bits")),),
    "misalignment": (("Learning of a misalignment", "Torque ripple relative to the aligned drive's, by speed."
                      " Short lines: target.", _curves(
        "misalignment", (("ripple_3s_ratio", ""), ("ripple_6s_ratio", "")),
        lambda parts: (", ".join((parts[0], *parts[3:])), parts[1], _number(parts[2])), "misalignment / deg")),),
    "standing_error": (("Mean speed", "By load. Short lines: target.", _curves(
        "standing_error", (("mean_error_rpm", ""),), lambda parts: (parts[0], parts[2], _number(parts[1])),
        "speed / (r/min)")),),
    "hold": (("Load at standstill", "One line per machine. Short lines: target.", _curves(
        "hold", (("drift_deg", ""),), lambda parts: ("", parts[0], abs(_number(parts[1]))), "load / (N m)")),),
    "mismatch": tuple((
        f"Cost of a wrong machine file, {controller}", "By error of the firmware's file; right of 1: worse, for the"
        " torque too much. Crosses: never, or the drive ended in a fault.", _costs(controller))
        for controller in CONTROLLERS),
    "robustness": (("Random drives", "Share of the drives below a value; dashed: the limit.", _distributions),),
}  # fmt: skip


# --- helpers --------------------------------------------------------------------------------------------------------

def _png(draw: Callable[[Content], Figure | None], content: Content) -> bytes | None:
    with matplotlib.rc_context(_STYLE):
        figure = draw(content)
        if figure is None:
            return None
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=130, metadata={"Software": None})
        return file.getvalue()


def _panels(count: int, columns: int, height_in: float, sharey: bool = False) -> tuple[Figure, list[Axes]]:
    """`count` panels in rows of `columns`, each row height_in high."""
    columns = min(columns, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(11.0, 0.4 + height_in * rows), layout="constrained")
    axes = list(figure.subplots(rows, columns, squeeze=False, sharey=sharey).flat)
    for axis in axes[count:]:
        axis.remove()
    return figure, axes[:count]


def _logarithmic(axis: Axis) -> None:
    """Logarithmic scale with plain numbers; 2 and 5 are labelled only over short ranges."""
    axes = axis.axes
    (axes.set_xscale if axis is axes.xaxis else axes.set_yscale)("log")
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 300.0 * low else (1.0,)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _number(text: str) -> float:
    """The number at the start of a part of a condition."""
    return float(text.split(maxsplit=1)[0])


def _rows(content: Content, group: str) -> list[dict[str, Any]]:
    return [row for row in content["rows"] if row["group"] == group]


def _controllers(rows: Iterable[Mapping[str, Any]]) -> list[str]:
    return in_order(controller for row in rows for controller in row["values"])


def _controllers_of_runs(runs: Iterable[Mapping[str, Any]]) -> list[str]:
    return in_order(one["controller"] for one in runs)


def _legend(figure: Figure, rows: Sequence[Mapping[str, Any]], lines: Mapping[str, Any] = {}) -> None:
    """Controllers by their markers, then lines of these names and looks."""
    controllers = _controllers(rows)
    handles = [Line2D([], [], color=controller_colour(one), marker=_MARKER.get(one, "o"), linestyle="")
               for one in controllers]
    handles += [Line2D([], [], **look) for look in lines.values()]
    figure.legend(handles, [*controllers, *lines], loc="outside upper right", ncols=len(handles))
