"""Page and plot of `salient pil`: instructions of the control interrupt over time and by module, stack, coverage."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib.figure import Figure

from salient.experiments.plots import STYLE, extremes
from salient.experiments.scenario import Scenario
from salient.pages import Plot, controller_colour, controller_name, write_page

PLOT = "interrupts.png"
_CAPTION = ("Instructions of the control interrupts over time; their distribution (logarithmic count; dotted: median,"
            " p99 and maximum); and the mean by module of the firmware.")
_COLUMN_IN = 4.4
_MODULES_SHOWN = 14
_BINS = 80
_MODULE_MEAN_MIN = 0.05
"""Instructions; modules with a smaller mean are omitted."""

Results = Mapping[str, Any]
"""The part of processor.json of one controller."""


def write_pil_report(out: Path, scenario: Scenario, content: Mapping[str, Any],
                     interrupts: Mapping[str, np.ndarray]) -> None:
    """Writes out/report.html and out/PLOT. content: of processor.json; interrupts: instructions of each interrupt, by
    controller. Equal input gives equal bytes."""
    plot_interrupts(out / PLOT, content, interrupts)
    controllers = content["controllers"]
    write_page(out / "report.html", "pil.html", {
        "scenario": scenario.name,
        "duration_s": f"{scenario.duration_s:g}",
        "machine": Path(scenario.machine).stem,
        "control_rate_khz": f"{content['control_rate_hz'] / 1000:g}",
        "target": content["target"],
        "controllers": list(controllers),
        "profile": _rows(controllers, _PROFILE),
        "estimate": _estimate(controllers),
        "modules": [(name, [_module_cell(of, name) for of in controllers.values()]) for name in _modules(controllers)],
        "stack": _rows(controllers, _STACK),
        "coverage": _coverage(controllers),
        "plot": Plot("", _CAPTION, (out / PLOT).read_bytes()),
    })


def plot_interrupts(path: Path, content: Mapping[str, Any], interrupts: Mapping[str, np.ndarray]) -> None:
    """One column per controller: instructions over time, their distribution, and the mean by module."""
    with matplotlib.rc_context(STYLE):
        width_in = _COLUMN_IN * len(interrupts) + 1.2
        figure = Figure(figsize=(width_in, 9.0), dpi=110, layout="constrained")
        axes = figure.subplots(3, len(interrupts), squeeze=False, height_ratios=(1.0, 0.9, 1.3))
        limit = 1.08 * max(int(counts.max()) for counts in interrupts.values())
        for column, (controller, counts) in enumerate(interrupts.items()):
            of = content["controllers"][controller]
            colour = controller_colour(controller)
            over_time, distribution, modules = axes[:, column]
            seconds = np.arange(1, len(counts) + 1) / content["control_rate_hz"]
            over_time.plot(*extremes(seconds, counts), color=colour, linewidth=0.8)
            over_time.set_ylim(0, limit)
            over_time.set_xlim(0, seconds[-1])
            over_time.set_xlabel("time, s")
            over_time.set_title(controller_name(controller))
            distribution.hist(counts, bins=np.linspace(0, limit, _BINS).tolist(), color=colour, log=True)
            distribution.set_xlim(0, limit)
            distribution.set_xlabel("instructions")
            for value in of["instructions"].values():
                distribution.axvline(value, color="#333333", linewidth=0.8, linestyle=":")
            distribution.set_title("median {median}, p99 {p99}, max {max}".format_map(of["instructions"]), fontsize=9.5)
            largest = [(name, mean) for name, mean in of["mean_by_module"].items() if mean >= _MODULE_MEAN_MIN]
            largest = largest[:_MODULES_SHOWN]
            modules.barh([name for name, _ in largest], [mean for _, mean in largest], color=colour)
            for row, (name, mean) in enumerate(largest):
                modules.annotate(f"{name} {mean:.0f}", (mean, row), xytext=(4, 0), textcoords="offset points",
                                 fontsize=8.5, va="center")
            modules.set_xlim(0, 1.3 * largest[0][1])
            modules.set_ylim(_MODULES_SHOWN - 0.5, -0.5)
            modules.set_yticks([])
            modules.grid(axis="y", visible=False)
            modules.set_xlabel("mean instructions per interrupt by module")
        axes[0, 0].set_ylabel("instructions per interrupt")
        axes[1, 0].set_ylabel("interrupts")
        figure.savefig(path, metadata={"Software": None})


_Cell = Callable[[Results], str]

_PROFILE: dict[str, _Cell] = {
    "control interrupts": lambda of: f"{of['interrupts']}",
    "median": lambda of: f"{of['instructions']['median']}",
    "p99": lambda of: f"{of['instructions']['p99']}",
    "max": lambda of: f"{of['instructions']['max']}",
}
_STACK: dict[str, _Cell] = {
    "background": lambda of: f"{of['stack_bytes']['background']}",
    "control interrupt, with the exception frame": lambda of: f"{of['stack_bytes']['interrupt']}",
    "total": lambda of: f"{of['stack_bytes']['deepest']}",
    "reserved by the linker script": lambda of: f"{of['stack_bytes']['reserved']}",
}


def _rows(controllers: Mapping[str, Results], cells: Mapping[str, _Cell]) -> list[tuple[str, list[str]]]:
    return [(label, [cell(of) for of in controllers.values()]) for label, cell in cells.items()]


def _estimate(controllers: Mapping[str, Results]) -> list[tuple[str, list[str]]]:
    """Cycles and control rates; empty for a processor without an estimate of its cycles per instruction."""
    rates = next(iter(controllers.values())).get("fits_at_rate_hz")
    if rates is None:
        return []
    rows = [("cycles of the longest", ["{} to {}".format(*of["estimated_cycles_of_max"])
                                       for of in controllers.values()])]
    return rows + [(f"fits at {int(rate) // 1000} kHz", [of["fits_at_rate_hz"][rate] for of in controllers.values()])
                   for rate in rates]


def _modules(controllers: Mapping[str, Results]) -> list[str]:
    """Modules of all controllers, the largest mean first."""
    largest: dict[str, float] = {}
    for of in controllers.values():
        for name, mean in of["mean_by_module"].items():
            largest[name] = max(mean, largest.get(name, 0.0))
    return [name for name in sorted(largest, key=lambda name: -largest[name]) if largest[name] >= _MODULE_MEAN_MIN]


def _module_cell(of: Results, name: str) -> str:
    mean, longest = of["mean_by_module"].get(name, 0), of["max_by_module"].get(name, 0)
    return f"{mean:.1f}, {longest}" if mean >= _MODULE_MEAN_MIN or longest else "–"


def _coverage(controllers: Mapping[str, Results]) -> list[tuple[str, list[str]]]:
    first = next(iter(controllers.values()))["coverage"]
    rows = [(f"all: {first['instructions']}", [_coverage_cell(of["coverage"]) for of in controllers.values()])]
    for file, of_file in first["files"].items():
        label = file if file.startswith("firmware/") else Path(file).name
        rows.append((f"{label}: {of_file['instructions']}",
                     [_coverage_cell(of["coverage"]["files"][file]) for of in controllers.values()]))
    return rows


def _coverage_cell(part: Mapping[str, Any]) -> str:
    total = part["instructions"]
    return f"{100 * part['executed'] / total:.0f} %, {100 * part['in_interrupts'] / total:.0f} %"
