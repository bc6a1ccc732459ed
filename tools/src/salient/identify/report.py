"""The page of an identification: maps with bands, residuals, course of the experiments, a verdict on each quantity."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from salient.identify.link import FREEWHEELS
from salient.identify.result import INTERVAL, NOT_OBSERVABLE, Result
from salient.machine.file import Machine
from salient.pages import Plot, write_page

_CURVES = 7


def write_report(result: Result, identified: Machine, plate: Machine, path: Path) -> None:
    """Writes the page; equal results give equal bytes."""
    found = result.found
    counts = found.counts if found.counts is not None else np.zeros((1, 1), int)
    write_page(path, "identify.html", {
        "name": identified.name, "plate": plate.name, "pulses": int(result.rows.pulse.max()) + 1,
        "rows": len(result.rows.row), "seconds": f"{(result.log['time_us'][-1] - result.log['time_us'][0]) * 1e-6:.1f}",
        "order": ", ".join(f"{'abcdef'[phase]}: {found.order[phase]}" for phase in found.phases),
        "least": int(counts.min()), "windows": counts.shape[1],
        "corrected": f"{100.0 * result.corrected_Wb / float(result.flux_Wb.max()):.4f}",
        "residual": f"{1e3 * float(np.sqrt(np.mean(result.fit.residual_Wb**2))):.4f}",
        "heat": ", ".join(f"{'abcdef'[phase]} {heat:.0f} J" for phase, heat in _copper_J(result).items()),
        "quantities": [(each.name, f"{each.value:.6g}", f"{each.half_width:.2g}", each.unit, each.verdict)
                       for each in result.quantities],
        "not_observable": NOT_OBSERVABLE, "warnings": result.warnings,
        "plots": [_maps(result), _residuals(result), _course(result)],
    })


def _copper_J(result: Result) -> dict[int, float]:
    log = result.log
    step_s = np.minimum(np.diff(log["time_us"]) * 1e-6, 1.5e-3)
    power_W = result.fit.resistance_ohm * log["current_A"][:-1] ** 2
    return {phase: float(np.sum((power_W * step_s)[log["phase"][:-1] == phase])) for phase in result.found.phases}


def _figure(rows: int, columns: int, height: float) -> tuple[Any, Any]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns)


def _png(figure: Any) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, dpi=100, metadata={"Software": None}, format="png")
    return file.getvalue()


def _maps(result: Result) -> Plot:
    figure, (left, right) = _figure(1, 2, 4.5)
    angle_deg = np.degrees(result.angle_rad[:, 0])
    for column in np.linspace(0, result.current_A.shape[1] - 1, _CURVES).astype(int):
        label = f"{result.current_A[0, column]:.3g} A"
        for axes, value, deviation in ((left, result.flux_Wb, result.flux_deviation),
                                       (right, result.torque_Nm, result.torque_deviation)):
            line, = axes.plot(angle_deg, value[:, column], linewidth=1, label=label)
            band = 10.0 * INTERVAL * deviation[:, column]
            axes.fill_between(angle_deg, value[:, column] - band, value[:, column] + band, alpha=0.3,
                              color=line.get_color(), linewidth=0)
    for axes, label in ((left, "flux linkage, Wb"), (right, "torque of a phase, N m")):
        axes.set(xlabel="angle from aligned, degrees", ylabel=label)
        axes.grid(alpha=0.3)
    left.legend(fontsize="small")
    return Plot("Map", "Flux linkage and torque over the angle, by current. Bands are ten times the interval of 95 %.",
                _png(figure))


def _residuals(result: Result) -> Plot:
    figure, (left, right) = _figure(1, 2, 3.5)
    residual_mWb = 1e3 * result.fit.residual_Wb
    period = 360.0 / result.found.rotor_poles
    left.plot(np.degrees(result.rows.angle_rad) % period, residual_mWb, ".", markersize=1)
    left.set(xlabel="angle from aligned, degrees", ylabel="residual of the flux linkage, mWb")
    right.plot(result.rows.current_A, residual_mWb, ".", markersize=1)
    right.set(xlabel="current, A")
    for axes in (left, right):
        axes.grid(alpha=0.3)
    return Plot("Residuals", "What the fit leaves of the integral of the voltage, of every sample. A pattern over the "
                "angle is a corner that the map cannot follow; one over the current an effect that the model lacks.",
                _png(figure))


def _course(result: Result) -> Plot:
    figure, (upper, lower) = _figure(2, 1, 4.5)
    log = result.log
    time_s = (log["time_us"] - log["time_us"][0]) * 1e-6
    grid = np.arange(0.0, time_s[-1], 0.02)
    speed_rpm = 60.0 * np.gradient(np.interp(grid, time_s, log["turn"]), grid)
    upper.plot(grid, speed_rpm, linewidth=0.8)
    upper.set(ylabel="speed, r/min")
    peaks = [(pulse.log["time_us"][0], pulse.log["current_A"].max(), (pulse.log["state"] == FREEWHEELS).any())
             for pulse in result.found.pulses]
    lower.plot([(each[0] - log["time_us"][0]) * 1e-6 for each in peaks], [each[1] for each in peaks], ".", markersize=2)
    lower.axhline(result.limit_A, color="grey", linewidth=0.8)
    lower.set(xlabel="time, s", ylabel="largest current of a pulse, A")
    for axes in (upper, lower):
        axes.grid(alpha=0.3)
    return Plot("Course", f"Speed and pulses. The line is the limit, {result.limit_A:g} A; the fastest rotation was "
                f"{math.ceil(float(np.abs(speed_rpm).max()))} r/min.", _png(figure))
