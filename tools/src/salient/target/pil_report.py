"""The page and the picture of `salient pil`: what control interrupts cost, by law and over time."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import matplotlib

matplotlib.use("Agg")

import numpy as np
from matplotlib.figure import Figure

from salient.experiments.plots import CONTROLLER_COLOUR, STYLE, extremes
from salient.experiments.report import CONTROLLER_NAME
from salient.experiments.report import STYLE as PAGE_STYLE
from salient.experiments.scenario import Scenario

PICTURE = "interrupts.png"
_COLUMN_IN = 4.4
_PARTS_DRAWN = 14
_BINS = 80


def write_pil_report(out: Path, scenario: Scenario, content: Mapping[str, Any],
                     interrupts: Mapping[str, np.ndarray]) -> None:
    """Writes out/report.html and out/PICTURE. content: of processor.json; interrupts: instructions of each, by
    controller. Equal input gives equal bytes."""
    draw_interrupts(out / PICTURE, content, interrupts)
    controllers = content["controllers"]
    data = base64.b64encode((out / PICTURE).read_bytes()).decode("ascii")
    heads = "".join(f'<th style="color:{_colour(name)}">{CONTROLLER_NAME[name]}</th>' for name in controllers)
    page = _PAGE.substitute(
        style=PAGE_STYLE,
        scenario=escape(scenario.name),
        lead=escape(f"{scenario.duration_s:g} s of virtual time on the machine {Path(scenario.machine).stem}, control"
                    f" at {content['control_rate_hz'] / 1000:g} kHz, the firmware on {content['target']} in QEMU."
                    " Instructions are counted and exact."),
        heads=heads,
        cost=_rows(controllers, _COST),
        estimate=_estimate(controllers),
        parts=_rows(controllers, {part: lambda of, part=part: _of_part(of, part) for part in _parts(controllers)}),
        stack=_rows(controllers, _STACK),
        coverage=_coverage(controllers),
        image=data,
    )
    (out / "report.html").write_text(page, encoding="utf-8")


def draw_interrupts(path: Path, content: Mapping[str, Any], interrupts: Mapping[str, np.ndarray]) -> None:
    """One column a controller: instructions over time, how often how many, and the mean by part."""
    with matplotlib.rc_context(STYLE):
        width_in = _COLUMN_IN * len(interrupts) + 1.2
        figure = Figure(figsize=(width_in, 9.0), dpi=110, layout="constrained")
        axes = figure.subplots(3, len(interrupts), squeeze=False, height_ratios=(1.0, 0.9, 1.3))
        highest = max(int(counts.max()) for counts in interrupts.values())
        for column, (controller, counts) in enumerate(interrupts.items()):
            of = content["controllers"][controller]
            time, often, parts = axes[:, column]
            seconds = np.arange(1, len(counts) + 1) / content["control_rate_hz"]
            time.plot(*extremes(seconds, counts), color=_colour(controller), linewidth=0.8)
            time.set_ylim(0, 1.08 * highest)
            time.set_xlim(0, seconds[-1])
            time.set_xlabel("time, s")
            time.set_title(CONTROLLER_NAME[controller])
            often.hist(counts, bins=np.linspace(0, 1.08 * highest, _BINS), color=_colour(controller), log=True)
            often.set_xlim(0, 1.08 * highest)
            often.set_xlabel("instructions")
            made = of["instructions"]
            for value in made.values():
                often.axvline(value, color="#333333", linewidth=0.8, linestyle=":")
            often.set_title("typical {typical}, 99 in 100 up to {of_99_percent}, worst {worst}".format_map(made),
                            fontsize=9.5)
            largest = [(name, mean) for name, mean in of["mean_by_part"].items() if mean >= 0.05][:_PARTS_DRAWN]
            parts.barh([name for name, _ in largest], [mean for _, mean in largest], color=_colour(controller))
            for row, (name, mean) in enumerate(largest):
                parts.annotate(f"{name} {mean:.0f}", (mean, row), xytext=(4, 0), textcoords="offset points",
                               fontsize=8.5, va="center")
            parts.set_xlim(0, 1.3 * largest[0][1])
            parts.set_ylim(_PARTS_DRAWN - 0.5, -0.5)
            parts.set_yticks([])
            parts.grid(axis="y", visible=False)
            parts.set_xlabel("instructions an interrupt, mean, by part")
        axes[0, 0].set_ylabel("instructions of an interrupt")
        axes[1, 0].set_ylabel("interrupts")
        figure.savefig(path, metadata={"Software": None})


_COST = {
    "control interrupts": lambda of: f"{of['interrupts']}",
    "instructions, typical": lambda of: f"{of['instructions']['typical']}",
    "99 in 100 up to": lambda of: f"{of['instructions']['of_99_percent']}",
    "worst": lambda of: f"{of['instructions']['worst']}",
}
_STACK = {
    "background": lambda of: f"{of['stack_bytes']['background']}",
    "control interrupt, with the processor's own frame": lambda of: f"{of['stack_bytes']['interrupt']}",
    "together": lambda of: f"{of['stack_bytes']['deepest']}",
    "reserved by the linker script": lambda of: f"{of['stack_bytes']['reserved']}",
}


def _rows(controllers: Mapping[str, Any], cells: Mapping[str, Any]) -> str:
    return "\n".join(f'<tr><th scope="row">{escape(words)}</th>'
                     + "".join(f"<td>{escape(cell(of))}</td>" for of in controllers.values()) + "</tr>"
                     for words, cell in cells.items())


def _estimate(controllers: Mapping[str, Any]) -> str:
    """Nothing for a processor whose cycles an instruction nobody has estimated."""
    rates = next(iter(controllers.values())).get("fits_at_rate_hz")
    if rates is None:
        return ""
    heads = "".join(f'<th style="color:{_colour(name)}">{CONTROLLER_NAME[name]}</th>' for name in controllers)
    rows = {"cycles of the worst": lambda of: "{} to {}".format(*of["estimated_cycles_of_worst"])}
    rows |= {f"fits at {int(rate) // 1000} kHz": lambda of, rate=rate: of["fits_at_rate_hz"][rate] for rate in rates}
    return _ESTIMATE.substitute(heads=heads, rows=_rows(controllers, rows))


def _parts(controllers: Mapping[str, Any]) -> list[str]:
    """Of all controllers, the largest first."""
    largest: dict[str, float] = {}
    for of in controllers.values():
        for part, mean in of["mean_by_part"].items():
            largest[part] = max(mean, largest.get(part, 0.0))
    return [part for part in sorted(largest, key=lambda part: -largest[part]) if largest[part] >= 0.05]


def _of_part(of: Mapping[str, Any], part: str) -> str:
    mean, worst = (of[name].get(part, 0) for name in ("mean_by_part", "worst_by_part"))
    return f"{mean:.1f}, {worst}" if mean >= 0.05 or worst else "–"


def _coverage(controllers: Mapping[str, Any]) -> str:
    files = next(iter(controllers.values()))["coverage"]["files"]
    rows = {"all": None} | {file if file.startswith("firmware/") else Path(file).name: file for file in files}

    def cell(of: Mapping[str, Any], file: str | None) -> str:
        part = of["coverage"] if file is None else of["coverage"]["files"][file]
        total = part["instructions"]
        return f"{100 * part['executed'] / total:.0f} %, {100 * part['in_interrupts'] / total:.0f} %"

    count = {file: (next(iter(controllers.values()))["coverage"] if file is None else files[file])["instructions"]
             for file in rows.values()}
    return _rows(controllers, {f"{words}: {count[file]}": lambda of, file=file: cell(of, file)
                               for words, file in rows.items()})


def _colour(controller: str) -> str:
    return CONTROLLER_COLOUR[controller]


_ESTIMATE = Template("""<div class="tables"><table><thead><tr><th>estimated, at 170 MHz</th>$heads</tr></thead><tbody>
$rows
</tbody></table></div>
<p>1.1 to 1.5 cycles an instruction: a Cortex-M4 that does not wait for its flash. It fits when the worst interrupt of
this run ends before the next begins: yes or no whatever the estimate's end, else open.</p>""")

_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Salient: $scenario on the processor</title>
<style>$style</style>
</head>
<body>
<h1>What $scenario takes of the processor</h1>
<p class="lead">$lead</p>

<h2>A control interrupt</h2>
<div class="tables"><table><thead><tr><th></th>$heads</tr></thead><tbody>
$cost
</tbody></table></div>
<p>From the handler's first instruction to its return.</p>
$estimate
<figure><img alt="Instructions of the control interrupts over time, how often how many, mean by part"
src="data:image/png;base64,$image"><figcaption>Instructions of the control interrupts over time; how often an interrupt
takes how many (the count is logarithmic); and the mean by the part of the firmware that they serve.</figcaption>
</figure>

<h2>By part</h2>
<div class="tables"><table><thead><tr><th>instructions of an interrupt: mean, worst</th>$heads</tr></thead><tbody>
$parts
</tbody></table></div>
<p>A part is a source file of the firmware: what the compiler inlines counts for the file that it was written in,
arithmetic for whoever uses it; port is the handler and the hardware layer.</p>

<h2>Stack</h2>
<div class="tables"><table><thead><tr><th>bytes, written to</th>$heads</tr></thead><tbody>
$stack
</tbody></table></div>

<h2>Coverage of the object code</h2>
<div class="tables"><table>
<thead><tr><th>source: its instructions; executed at all, in interrupts</th>$heads</tr></thead><tbody>
$coverage
</tbody></table></div>
<p>Which lines were missed is in processor.json.</p>
</body>
</html>
""")
