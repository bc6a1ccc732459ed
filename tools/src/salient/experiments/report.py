"""report.html: one self-contained page with this drive's figures beside the paper's, and pictures."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from salient.experiments.plots import CONTROLLER_COLOUR

Merits = Mapping[str, Mapping[str, float | None]]

CONTROLLER_NAME = {"traditional": "Traditional", "paper": "Paper", "salient": "Salient"}
CONTROLLER_WORDS = {
    "traditional": "PI speed control and three-level hysteresis DITC",
    "paper": "sliding mode speed control, BP-PID duty in DITC",
    "salient": "sliding mode, torque sharing, predictive flux PWM, BP-PID trim",
}
EXPERIMENT_NAME = {
    "start_600": "Start to 600 r/min, no load",
    "load_step_150": "150 r/min, load step of 8 N m at 0.13 s",
}
# The states that the losses are taken in.
STEADY_STATE_NAME = {"start_600": "600 r/min, no load", "load_step_150": "150 r/min, 8 N m"}
# name in results.json -> words, unit, decimals, factor into that unit
ROWS = {
    "settling_time_s": ("settled within ±0.5 % after", "s", 4, 1.0),
    "overshoot_percent": ("overshoot", "%", 2, 1.0),
    "max_speed_rpm": ("highest speed", "r/min", 1, 1.0),
    "speed_dip_rpm": ("speed dip after the step", "r/min", 2, 1.0),
    "recovery_time_s": ("back within ±0.5 % after", "ms", 2, 1e3),
    "torque_max_Nm": ("highest torque, 0.3 to 0.4 s", "N m", 3, 1.0),
    "torque_min_Nm": ("lowest torque, 0.3 to 0.4 s", "N m", 3, 1.0),
    "torque_mean_Nm": ("mean torque, 0.3 to 0.4 s", "N m", 3, 1.0),
    "torque_ripple": ("torque ripple <i>K</i><sub>t</sub>", "", 4, 1.0),
}
# In results.json's losses -> words, unit, decimals
LOSS_ROWS = {
    "input_W": ("input, from the DC link", "W", 1),
    "copper_W": ("windings", "W", 1),
    "converter_W": ("switches and diodes", "W", 1),
    "friction_W": ("friction", "W", 1),
    "output_W": ("output, to the load", "W", 1),
    "stored_W": ("kept in fields and speed", "W", 1),
    "efficiency_percent": ("efficiency", "%", 1),
    "returned_W": ("drawn and given back to the link", "W", 1),
    "phase_current_rms_A": ("phase current, RMS", "A", 2),
    "iron_estimate_W": ("iron, an estimate", "W", 2),
}
NEVER = {"settling_time_s": "not in this run", "recovery_time_s": "not in this run"}


@dataclass(frozen=True)
class Picture:
    """A picture of the report: the PNG, a title and one or two sentences that say what one sees."""

    path: Path
    title: str
    caption: str


def write_report(path: Path, results: Mapping[str, Any], pictures: Sequence[Picture], commands: Sequence[str],
                 files: Sequence[tuple[str, Sequence[tuple[str, str]]]]) -> None:
    """Writes the page for `results` (results.json's content).

    `pictures` are inlined. `commands` are the shell lines that give this page again. `files` are (what they are of,
    [(words, path relative to the page), ...]), linked. Equal input gives equal bytes.
    """
    page = _PAGE.substitute(
        style=STYLE,
        headline=_headline(results),
        tiles=_tiles(results),
        tables="\n".join(_table(results, experiment) for experiment in results["experiments"]),
        losses=_losses(results["losses"]),
        pictures="\n".join(_picture(picture) for picture in pictures),
        why=_why(results),
        notes="\n".join(f"<li>{escape(note)}</li>" for note in results["paper_notes"]),
        conditions=_conditions(results["conditions"]),
        commands=escape("\n".join(commands)),
        files="\n".join(f"<li>{escape(of)}: {', '.join(_link(*link) for link in links)}</li>" for of, links in files),
    )
    path.write_text(page, encoding="utf-8")


def words_for(name: str, value: float | None) -> str:
    """A figure of merit with its unit as plain text, for example "0.0691 s"."""
    _, unit, decimals, factor = ROWS[name]
    if value is None:
        return NEVER.get(name, "not given")
    number = f"{value * factor:.{decimals}f}"
    return f"{number} {unit}" if unit else number


def printed_words_for(name: str, value: float | None) -> str:
    """A figure that the paper prints, with the digits that it prints: "0.07 s"."""
    _, unit, _, factor = ROWS[name]
    if value is None:
        return "not given"
    number = f"{value * factor:.10g}"
    return f"{number} {unit}" if unit else number


def captions(results: Mapping[str, Any]) -> dict[str, str]:
    """What one sees in each picture, with the figures of this run: figure_5, figure_6, figure_7, phase_currents."""
    start, step = results["experiments"]["start_600"], results["experiments"]["load_step_150"]
    return {
        "figure_5":
            "Speed from standstill to 600 r/min. The green band is ±0.5 %, the dot is where the speed enters it for"
            " good, the hollow diamond is the time that the paper prints. " + _each(start, "settling_time_s")
            + " Below, the neighbourhood of 600 r/min with the highest speed (coloured) and the paper's (grey).",
        "figure_6":
            "Speed at 150 r/min when 8 N m of load are switched on at 0.13 s: the whole run, the time around the step,"
            " and the first 10 ms after it; the scales are the same for all controllers. "
            + _each(step, "speed_dip_rpm") + " " + _each(step, "recovery_time_s"),
        "figure_7":
            "True shaft torque around the load step (black: the load), in the steady window from 0.3 s to 0.4 s with"
            " its extremes and its mean, and the millisecond around its highest value. Each column of pixels reaches"
            " from the lowest to the highest sample in it, so no spike is lost in drawing. "
            + _each(step, "torque_ripple"),
        "phase_currents":
            "Phase currents and torque over two strokes of the rotor (60 degrees) in the steady window. Where one phase"
            " hands over to the next, both carry current and the torque is hardest to hold.",
    }


# --- pieces ---------------------------------------------------------------------------------------------------------

def _each(merits: Merits, name: str) -> str:
    label = ROWS[name][0].replace("<i>K</i><sub>t</sub>", "K_t")
    return label[0].upper() + label[1:] + ": " + ", ".join(
        f"{controller} {words_for(name, of[name])}"
        for controller, of in merits.items()) + "."


def _headline(results: Mapping[str, Any]) -> str:
    conditions = results["conditions"]
    return (f"Fixed-point firmware at {conditions['control_rate_hz'] / 1000:g} kHz, commanded and logged over CAN, on"
            f" the emulated machine “{escape(str(conditions['machine']))}”. Each controller runs both experiments; the"
            " paper's printed figures stand beside.")


def _tiles(results: Mapping[str, Any]) -> str:
    tiles = (("start_600", "settling_time_s", "start to 600 r/min, settled"),
             ("load_step_150", "recovery_time_s", "8 N m step, back in the band"),
             ("load_step_150", "torque_ripple", "torque ripple"))
    return "\n".join(_tile(results, *tile) for tile in tiles)


def _tile(results: Mapping[str, Any], experiment: str, name: str, words: str) -> str:
    lines = []
    for controller, of in results["experiments"][experiment].items():
        printed = results["paper"].get(experiment, {}).get(controller)
        beside = f"<small>printed: {printed_words_for(name, printed[name])}</small>" if printed else ""
        lines.append(f'<p><span>{_name(controller)}</span><b style="color:{_colour(controller)}">'
                     f"{words_for(name, of[name])}</b>{beside}</p>")
    return f'<div class="tile"><h3>{escape(words)}</h3>{"".join(lines)}</div>'


def _table(results: Mapping[str, Any], experiment: str) -> str:
    merits, printed = results["experiments"][experiment], results["paper"].get(experiment, {})
    heads = "".join(f'<th colspan="{1 + (controller in printed)}" style="color:{_colour(controller)}">'
                    f"{_name(controller)}<small>{escape(CONTROLLER_WORDS.get(controller, ''))}</small></th>"
                    for controller in merits)
    columns = "".join("<th>here</th>" + "<th class=paper>printed</th>" * (controller in printed)
                      for controller in merits)
    rows = []
    for name in next(iter(merits.values())):
        words, unit, _, _ = ROWS[name]
        cells = "".join(f"<td>{_bare(words_for(name, of[name]), unit)}</td>"
                        + (f"<td class=paper>{_bare(printed_words_for(name, printed[controller][name]), unit)}</td>"
                           if controller in printed else "")
                        for controller, of in merits.items())
        rows.append(f'<tr><th scope="row">{words}{f", {unit}" if unit else ""}</th>{cells}</tr>')
    return (f"<h3>{escape(EXPERIMENT_NAME.get(experiment, experiment))}</h3>\n<table><thead><tr><th></th>{heads}</tr>"
            f"<tr><th></th>{columns}</tr></thead>\n<tbody>" + "\n".join(rows) + "</tbody></table>")


def _losses(losses: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> str:
    """One table of all experiments, and what its words mean."""
    columns = [(controller, of) for by_controller in losses.values() for controller, of in by_controller.items()]
    experiments = "".join(f'<th colspan="{len(by_controller)}">{escape(STEADY_STATE_NAME.get(experiment, experiment))}'
                          "</th>" for experiment, by_controller in losses.items())
    controllers = "".join(f'<th style="color:{_colour(controller)}">{_name(controller)}</th>'
                          for controller, _ in columns)
    rows = "\n".join(
        f'<tr><th scope="row">{words}, {unit}</th>'
        + "".join(f"<td>{'–' if of[name] is None else f'{of[name]:z.{decimals}f}'}</td>" for _, of in columns)
        + "</tr>"
        for name, (words, unit, decimals) in LOSS_ROWS.items() if name in columns[0][1])
    start_s, end_s = columns[0][1]["window_s"]
    iron = _IRON_WORDS if "iron_estimate_W" in columns[0][1] else ""
    return f"""<table><thead><tr><th></th>{experiments}</tr><tr><th></th>{controllers}</tr></thead>
<tbody>
{rows}
</tbody></table>
<p>Mean powers from {start_s:g} to {end_s:g} s by the emulator's energy ledger: input = windings + devices + friction +
output + what is stored at the end and was not at the beginning. Efficiency is the output over output and losses, so
that what is stored counts neither way; without load there is none. Devices without drops in the machine file lose
nothing.{iron}</p>"""


_IRON_WORDS = """ The iron's loss is estimated from the recorded currents (improved generalized Steinmetz equation, a
stator pole's flux for all of the iron); it is no part of the ledger, the input or the efficiency, and not given for
samples more than 1 µs apart."""


def _link(words: str, target: str) -> str:
    return f'<a href="{escape(target)}">{escape(words)}</a>'


def _bare(words: str, unit: str) -> str:
    return words.removesuffix(f" {unit}") if unit else words


def _name(controller: str) -> str:
    return CONTROLLER_NAME.get(controller, escape(controller))


def _colour(controller: str) -> str:
    return CONTROLLER_COLOUR.get(controller, "#444444")


def _picture(picture: Picture) -> str:
    data = base64.b64encode(picture.path.read_bytes()).decode("ascii")
    return (f'<figure><h3>{escape(picture.title)}</h3><img alt="{escape(picture.caption)}"'
            f' src="data:image/png;base64,{data}"><figcaption>{escape(picture.caption)}</figcaption></figure>')


def _why(results: Mapping[str, Any]) -> str:
    rate_khz = results["conditions"]["control_rate_hz"] / 1000
    ripple = {controller: of["torque_ripple"] for controller, of in results["experiments"]["load_step_150"].items()}
    printed = results["paper"]["load_step_150"]
    paragraphs = []
    if "traditional" in ripple:
        paragraphs.append(f"""The traditional controller's <i>K</i><sub>t</sub> is {ripple["traditional"]:.3g} here, and
{printed["traditional"]["torque_ripple"]:g} in print. At {rate_khz:g} kHz the switches can change every
{1000 / rate_khz:g} µs, and what is decided on one sample acts a period later; meanwhile the full supply voltage drives
the current, and the torque with it, beyond the band. So the ripple of a hysteresis controller is set by its sampling
rate, not by its band, and falls as the rate rises (<code>--control-rate-hz</code>): at {rate_khz:g} kHz it is far from
the paper's figures whatever the tuning. They are those of a simulation with a very small step, not of a drive with an
interrupt.""")
    if "paper" in ripple:
        paragraphs.append(f"""What a real sampling rate can use of the paper's idea is the BP-PID's output as the duty
of the active phase, which grades the voltage within a period. That is the controller called paper here; its
<i>K</i><sub>t</sub> is {ripple["paper"]:.3g}.""")
    if "salient" in ripple:
        paragraphs.append(f"""The controller called salient shares the torque out among the phases along a curve that
the voltage can follow, and gives each phase the duty that takes its flux linkage to its share within a period; the
BP-PID's output is a trim on top. Its <i>K</i><sub>t</sub> is {ripple["salient"]:.3g}.""")
    paragraphs.append("""The dip after a load step depends on the rotor angle at the step and on the delay until the
voltage answers. The paper's 0.4 r/min needs a lucky angle and a load that is known beforehand; a dip at one angle, the
one here included, is one sample and no property of the drive.""")
    return "\n".join(f"<p>{paragraph}</p>" for paragraph in paragraphs)


def _conditions(conditions: Mapping[str, Any]) -> str:
    def rows(prefix: str, part: Mapping[str, Any]) -> list[str]:
        lines = []
        for key, value in part.items():
            name = f"{prefix}{key}"
            if isinstance(value, Mapping):
                lines += rows(f"{name}.", value)
            else:
                shown = ", ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
                lines.append(f'<tr><th scope="row"><code>{escape(name)}</code></th><td>{escape(shown)}</td></tr>')
        return lines

    return "<table class=conditions><tbody>" + "\n".join(rows("", conditions)) + "</tbody></table>"


# Of every page that a command writes.
STYLE = """
:root { color-scheme: light; font-size: 16px; }
body { margin: 0 auto; max-width: 1060px; padding: 2.2rem 1.4rem 4rem; background: #fff; color: #222;
       font: 1rem/1.55 system-ui, "Segoe UI", "Liberation Sans", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 .5rem; }
h2 { font-size: 1.25rem; margin: 2.6rem 0 .6rem; padding-top: .8rem; border-top: 1px solid #ddd; }
h3 { font-size: 1rem; margin: 1.6rem 0 .4rem; }
sub { font-size: .75em; line-height: 0; }
p { max-width: 76ch; }
.lead { font-size: 1.06rem; color: #444; margin-top: 0; }
.tiles { display: flex; flex-wrap: wrap; gap: 1rem; margin: 1.4rem 0; }
.tile { flex: 1 1 240px; border: 1px solid #ddd; border-radius: 8px; padding: .8rem 1rem; break-inside: avoid; }
.tile h3 { margin: 0 0 .4rem; font-weight: 600; font-size: .86rem; color: #555; }
.tile p { margin: .3rem 0; display: grid; grid-template-columns: 5.6rem 1fr; align-items: baseline; }
.tile b { font-size: 1.3rem; font-variant-numeric: tabular-nums; }
.tile small { grid-column: 2; line-height: 1.2; }
.tile small, th small { color: #777; font-weight: normal; }
th small { display: block; font-size: .78rem; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; break-inside: avoid; }
th, td { padding: .32rem .6rem; border-bottom: 1px solid #e6e6e6; text-align: right; vertical-align: bottom; }
th[scope=row] { text-align: left; font-weight: normal; }
thead th { border-bottom: 1px solid #bbb; }
.paper { color: #767676; }
thead th:first-child { text-align: left; }
.tables table { table-layout: fixed; }
.tables th:first-child { width: 30%; }
.conditions { width: auto; }
.conditions td { text-align: left; }
figure { margin: 1.8rem 0 2.4rem; break-inside: avoid; }
figure img { width: 100%; height: auto; display: block; }
figcaption { max-width: 82ch; color: #444; font-size: .93rem; margin-top: .5rem; }
pre { background: #f6f6f4; border: 1px solid #e4e4e0; border-radius: 6px; padding: .8rem 1rem; overflow-x: auto;
      white-space: pre-wrap; }
code, pre { font: .9em/1.5 ui-monospace, "Liberation Mono", "DejaVu Sans Mono", monospace; }
li { max-width: 80ch; margin: .2rem 0; }
a { color: #1e62a8; }
@media print {
  @page { size: A4; margin: 15mm; }
  :root { font-size: 9pt; }
  body { max-width: none; padding: 0; }
  h1 { font-size: 15pt; }
  h2 { font-size: 12pt; margin-top: 1.4rem; padding-top: .5rem; }
  h3 { font-size: 10pt; margin-top: .9rem; }
  th, td { padding: .18rem .4rem; }
  .tiles { gap: .6rem; margin: .8rem 0; }
  .tile { flex-basis: 160px; }
  .tile b { font-size: 11pt; }
  .tables th:first-child { width: 34%; }
  figure { margin: .8rem 0 1rem; }
  h2, h3 { break-after: avoid; }
  pre { border-color: #ccc; }
}
"""

_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Salient: the paper's two experiments</title>
<style>$style</style>
</head>
<body>
<h1>Salient: the paper's two experiments, run on a drive</h1>
<p class="lead">$headline</p>
<div class="tiles">
$tiles
</div>

<h2>Beside the paper</h2>
<div class="tables">
$tables
</div>
<p>“here” is measured on the emulator's true state, not on what the drive believes; “printed” is what Zhao and Deng
print for their simulation.</p>

<h2>Where the power goes</h2>
<div class="tables">
$losses
</div>

<h2>What it looks like</h2>
$pictures

<h2>Why the ripple is not the paper's</h2>
$why

<h2>About the printed figures</h2>
<ul>
$notes
</ul>

<h2>Conditions</h2>
$conditions

<h2>Again</h2>
<p>Equal commands give equal results and CAN logs, byte for byte.</p>
<pre>$commands</pre>
<ul>
$files
</ul>
</body>
</html>
""")
