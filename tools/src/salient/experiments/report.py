"""report.html: one self-contained page with this drive's metrics, the paper's published values, and plots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from salient.pages import Plot, write_page

Metrics = Mapping[str, Mapping[str, float | None]]
"""Controller -> metric -> value, None when the event did not occur or no value was published."""

CONTROLLER_DESCRIPTION = {
    "traditional": "PI speed control and three-level hysteresis DITC",
    "paper": "sliding mode speed control, BP-PID duty in DITC",
    "salient": "sliding mode, torque sharing, predictive flux PWM",
}
EXPERIMENT_TITLE = {
    "start_600": "Start to {start_rpm:g} r/min, no load",
    "load_step_150": "{step_rpm:g} r/min, load step of {load_Nm:g} N m at {step_at_s:g} s",
}
"""Titles, with keys of conditions.operating_point, as below."""
SHORT_TITLE = {"start_600": "start to {start_rpm:g} r/min",
               "load_step_150": "{step_rpm:g} r/min, step of {load_Nm:g} N m"}
STEADY_STATE_TITLE = {"start_600": "{start_rpm:g} r/min, no load",
                      "load_step_150": "{step_rpm:g} r/min, {load_Nm:g} N m"}
"""Operating points of the power balance, by experiment."""
METRIC_ROWS = {
    "settling_time_s": ("settling time to ±0.5 %", "s", 4, 1.0),
    "overshoot_percent": ("overshoot", "%", 2, 1.0),
    "max_speed_rpm": ("maximum speed", "r/min", 1, 1.0),
    "speed_dip_rpm": ("speed drop after the step", "r/min", 2, 1.0),
    "recovery_time_s": ("recovery time to ±0.5 %", "ms", 2, 1e3),
    "torque_max_Nm": ("max. torque, steady", "N m", 3, 1.0),
    "torque_min_Nm": ("min. torque, steady", "N m", 3, 1.0),
    "torque_mean_Nm": ("mean torque, steady", "N m", 3, 1.0),
    "torque_ripple": ("torque ripple K_t", "", 4, 1.0),
}
"""Metric in results.json -> label, unit, decimals, factor into that unit."""
LOSS_ROWS = {
    "input_W": ("input, from the DC link", "W", 1),
    "copper_W": ("windings", "W", 1),
    "converter_W": ("switches and diodes", "W", 1),
    "friction_W": ("friction", "W", 1),
    "output_W": ("output, to the load", "W", 1),
    "stored_W": ("stored in fields and rotation", "W", 1),
    "efficiency_percent": ("efficiency", "%", 1),
    "returned_W": ("returned to the DC link", "W", 1),
    "phase_current_rms_A": ("phase current, RMS", "A", 2),
    "iron_estimate_W": ("iron, an estimate", "W", 2),
}
"""Key of results.json's losses -> label, unit, decimals."""
NO_EVENT = {"settling_time_s": "not in this run", "recovery_time_s": "not in this run"}
_MISSING = "–"


def write_report(path: Path, results: Mapping[str, Any], plots: Sequence[Plot], commands: Sequence[str],
                 files: Sequence[tuple[str, Sequence[tuple[str, str]]]]) -> None:
    """Writes the page for `results` (the content of results.json).

    `plots` are inlined. `commands` are the shell lines that reproduce the page. `files` are linked: (title,
    [(text, path relative to the page), ...]). Equal input gives equal bytes.
    """
    conditions = results["conditions"]
    rate_khz = conditions["control_rate_hz"] / 1000
    write_page(path, "report.html", {
        "control_rate_khz": f"{rate_khz:g}",
        "period_us": f"{1000 / rate_khz:g}",
        "machine": conditions["machine"],
        "tiles": [_tile(results, *tile) for tile in _TILES],
        "tables": [_table(results, experiment) for experiment in results["experiments"]],
        "losses": _losses(results["losses"], conditions["operating_point"]),
        "plots": plots,
        "ripple": {controller: f"{metrics['torque_ripple']:.3g}"
                   for controller, metrics in results["experiments"]["load_step_150"].items()},
        "published_ripple": f"{results['paper']['load_step_150']['traditional']['torque_ripple']:g}",
        "notes": results["paper_notes"],
        "conditions": _flattened("", conditions),
        "commands": "\n".join(commands),
        "files": files,
    })


def published_of(results: Mapping[str, Any], experiment: str) -> Metrics:
    """The published values of an experiment; none when it is at other speeds or loads than the paper's."""
    point = results["conditions"]["operating_point"]
    is_paper = (point["start_rpm"], point["step_rpm"], point["load_Nm"]) == (600.0, 150.0, 8.0)
    published: Metrics = results["paper"].get(experiment, {}) if is_paper else {}
    return published


def format_metric(name: str, value: float | None) -> str:
    """A metric with its unit as plain text, for example "0.0691 s"."""
    _, unit, decimals, factor = METRIC_ROWS[name]
    if value is None:
        return NO_EVENT.get(name, "not given")
    number = f"{value * factor:.{decimals}f}"
    return f"{number} {unit}" if unit else number


def format_published(name: str, value: float | None) -> str:
    """A published value, with the digits of the paper: "0.07 s"."""
    _, unit, _, factor = METRIC_ROWS[name]
    if value is None:
        return "not given"
    number = f"{value * factor:.10g}"
    return f"{number} {unit}" if unit else number


def captions(results: Mapping[str, Any]) -> dict[str, str]:
    """Captions of the plots with the metrics of this run, by name: figure_5, figure_6, figure_7, phase_currents."""
    start, step = results["experiments"]["start_600"], results["experiments"]["load_step_150"]
    point = results["conditions"]["operating_point"]
    start_rpm, step_rpm, window_s = point["start_rpm"], point["step_rpm"], point["window_s"]
    return {
        "figure_5":
            f"Speed from standstill to {start_rpm:g} r/min. The green band is ±0.5 %, the dot marks the settling time,"
            " the hollow diamond the published one. " + _each(start, "settling_time_s")
            + f" Bottom: detail around {start_rpm:g} r/min with the maximum speed (coloured) and the published one"
            " (grey).",
        "figure_6":
            f"Speed at {step_rpm:g} r/min with a load step of {point['load_Nm']:g} N m at {point['step_at_s']:g} s: the"
            " whole run, the time around the step, and the first 10 ms after it; the scales are the same for all"
            " controllers. "
            + _each(step, "speed_dip_rpm") + " " + _each(step, "recovery_time_s"),
        "figure_7":
            "True shaft torque around the load step (black: the load), in the steady window from"
            f" {window_s[0]:g} s to {window_s[1]:g} s with its extremes and its mean, and the millisecond around its"
            " maximum. Each column of pixels spans from the minimum to the maximum of its samples, so no spike is"
            " lost. "
            + _each(step, "torque_ripple"),
        "phase_currents":
            "Phase currents and torque over two strokes of the rotor in the steady window. During"
            " commutation both phases carry current, and the torque is hardest to control.",
    }


def _each(metrics: Metrics, name: str) -> str:
    label = METRIC_ROWS[name][0]
    return label[0].upper() + label[1:] + ": " + ", ".join(
        f"{controller} {format_metric(name, of[name])}" for controller, of in metrics.items()) + "."


_TILES = (("start_600", "settling_time_s", "start to {start_rpm:g} r/min, settling time"),
          ("load_step_150", "recovery_time_s", "{load_Nm:g} N m load step, recovery time"),
          ("load_step_150", "torque_ripple", "torque ripple"))


def _tile(results: Mapping[str, Any], experiment: str, name: str, title: str) -> dict[str, Any]:
    lines = []
    for controller, metrics in results["experiments"][experiment].items():
        published = published_of(results, experiment).get(controller)
        lines.append({"controller": controller, "value": format_metric(name, metrics[name]),
                      "published": format_published(name, published[name]) if published else ""})
    return {"title": title.format_map(results["conditions"]["operating_point"]), "lines": lines}


def _table(results: Mapping[str, Any], experiment: str) -> dict[str, Any]:
    metrics, published = results["experiments"][experiment], published_of(results, experiment)
    rows = []
    for name in next(iter(metrics.values())):
        label, unit, _, _ = METRIC_ROWS[name]
        cells = []
        for controller, of in metrics.items():
            cells.append({"text": _without_unit(format_metric(name, of[name]), unit), "published": False})
            if controller in published:
                text = _without_unit(format_published(name, published[controller][name]), unit)
                cells.append({"text": text, "published": True})
        rows.append({"label": f"{label}, {unit}" if unit else label, "cells": cells})
    heads = [{"controller": controller, "published": controller in published,
              "description": CONTROLLER_DESCRIPTION.get(controller, "")} for controller in metrics]
    title = EXPERIMENT_TITLE.get(experiment, experiment).format_map(results["conditions"]["operating_point"])
    return {"title": title, "heads": heads, "rows": rows}


def _losses(losses: Mapping[str, Mapping[str, Mapping[str, Any]]], point: Mapping[str, Any]) -> dict[str, Any]:
    """One table of all experiments."""
    columns = [(controller, of) for by_controller in losses.values() for controller, of in by_controller.items()]
    first = columns[0][1]
    return {
        "experiments": [{"title": STEADY_STATE_TITLE.get(experiment, experiment).format_map(point),
                         "columns": len(by_controller)}
                        for experiment, by_controller in losses.items()],
        "controllers": [controller for controller, _ in columns],
        "rows": [{"label": f"{label}, {unit}",
                  "cells": [_MISSING if of[name] is None else f"{of[name]:z.{decimals}f}" for _, of in columns]}
                 for name, (label, unit, decimals) in LOSS_ROWS.items() if name in first],
        "start_s": f"{first['window_s'][0]:g}",
        "end_s": f"{first['window_s'][1]:g}",
        "iron": "iron_estimate_W" in first,
    }


def _without_unit(text: str, unit: str) -> str:
    return text.removesuffix(f" {unit}") if unit else text


def _flattened(prefix: str, part: Mapping[str, Any]) -> list[tuple[str, str]]:
    """(dotted name, value) of nested mappings."""
    lines: list[tuple[str, str]] = []
    for key, value in part.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping):
            lines += _flattened(f"{name}.", value)
        else:
            lines.append((name, ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)))
    return lines
