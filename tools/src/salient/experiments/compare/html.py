"""compare.html: one self-contained page with the tables, the pictures, and what changed."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape
from itertools import groupby
from pathlib import Path
from string import Template
from typing import Any

from salient.experiments.compare import plots
from salient.experiments.compare.baseline import Change
from salient.experiments.compare.cases import GROUPS
from salient.experiments.compare.table import (
    Row,
    cell,
    controllers_of,
    failed_of,
    limit_words,
    mark,
    printed_words,
    verdict,
)
from salient.experiments.plots import CONTROLLER_COLOUR


def write_page(path: Path, rows: Sequence[Row], content: Mapping[str, Any], compared: str | None,
               changes: Sequence[Change], command: str) -> None:
    """Writes the page for `rows` and `content` (compare.json's). compared: what compare/baseline.py says, if an
    earlier run was named. Equal input gives equal bytes."""
    path.write_text(_PAGE.substitute(
        verdict=escape(verdict(rows)),
        missed=_missed(rows),
        compared=_compared(compared, changes),
        groups="\n".join(_group(group, list(of), content) for group, of in groupby(rows, key=lambda row: row.key[0])),
        command=escape(command),
    ), encoding="utf-8")


def _missed(rows: Sequence[Row]) -> str:
    """The wanted figures that are not reached, each with the figure and the reason."""
    lines = []
    for row in rows:
        if row.reached is False:
            group, condition, figure, _ = row.key
            reason = f" {escape(row.target.reason)}" if row.target.reason else ""
            lines.append(f"<li>{escape(group)}, {escape(condition)}: {escape(row.words)}"
                         f" {cell(row, row.target.controller)}, wanted {limit_words(figure, row.target.wanted)}."
                         f"{reason}</li>")
    return f"<p>Not reached:</p>\n<ul>{''.join(lines)}</ul>" if lines else ""


def _compared(compared: str | None, changes: Sequence[Change]) -> str:
    if compared is None:
        return ""
    picture = plots.changes_picture(changes)
    return (f"<h2>Against the earlier run</h2>\n<pre>{escape(compared)}</pre>\n"
            + (_picture(picture) if picture else ""))


def _group(group: str, rows: Sequence[Row], content: Mapping[str, Any]) -> str:
    return (f'<h2 id="{group}">{escape(GROUPS[group].title[0].upper() + GROUPS[group].title[1:])}</h2>\n'
            + "\n".join(_picture(picture) for picture in plots.group_pictures(group, content)) + _table(rows))


def _table(rows: Sequence[Row]) -> str:
    columns = controllers_of(rows)
    heads = "".join(f'<th style="color:{CONTROLLER_COLOUR.get(one, "#444")}">{escape(one)}</th>' for one in columns)
    lines = []
    for condition, of_condition in groupby(rows, key=lambda row: row.key[1]):
        shown = list(of_condition)
        why = "".join(f"<br><small>{escape(controller)}: {escape(text)}</small>"
                      for controller, text in failed_of(shown).items())
        lines.append(f'<tr class=condition><th colspan="{len(columns) + 5}">{escape(condition)}{why}</th></tr>')
        lines += [_line(row, columns) for row in shown]
    return (f"<table><thead><tr><th></th>{heads}<th>wanted</th><th>bound</th><th class=printed>printed</th><th></th>"
            "</tr></thead>\n<tbody>" + "\n".join(lines) + "</tbody></table>")


def _line(row: Row, columns: Sequence[str]) -> str:
    figure, target = row.key[2], row.target
    state = {True: "reached", False: "missed", None: ""}[row.reached]
    cells = "".join(f"<td>{escape(words)}</td>" for words in (
        *(cell(row, controller) for controller in columns), limit_words(figure, target.wanted),
        limit_words(figure, target.bound)))
    return (f'<tr><th scope="row">{escape(row.words)}</th>{cells}<td class=printed>{escape(printed_words(row))}</td>'
            f'<td class="{state}">{mark(row)}</td></tr>')


def _picture(picture: plots.Picture) -> str:
    data = base64.b64encode(picture.png).decode("ascii")
    return (f'<figure><h3>{escape(picture.title)}</h3><img alt="{escape(picture.caption)}"'
            f' src="data:image/png;base64,{data}"><figcaption>{escape(picture.caption)}</figcaption></figure>')


_PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Salient: the controllers compared</title>
<style>
:root { color-scheme: light; }
body { margin: 0 auto; max-width: 1060px; padding: 2rem 1.4rem 4rem; background: #fff; color: #222;
       font: 1rem/1.5 system-ui, "Segoe UI", "Liberation Sans", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.7rem; margin: 0 0 .5rem; }
h2 { font-size: 1.25rem; margin: 2.4rem 0 .6rem; padding-top: .8rem; border-top: 1px solid #ddd; }
h3 { font-size: 1rem; margin: 1.4rem 0 .4rem; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: .92rem; }
th, td { padding: .2rem .6rem; border-bottom: 1px solid #eee; text-align: right; white-space: nowrap; }
th[scope=row], .condition th { text-align: left; font-weight: normal; white-space: normal; }
.condition th { padding-top: .7rem; font-weight: 600; }
th[scope=row] { padding-left: 1.4rem; }
.printed, figcaption, small { color: #666; }
.reached { color: #1b7f5c; }
.missed { color: #b3261e; font-weight: 600; }
figure { margin: 1.2rem 0 2rem; }
figure img { width: 100%; height: auto; display: block; }
figcaption { max-width: 84ch; font-size: .93rem; }
pre { background: #f6f6f4; border: 1px solid #e4e4e0; border-radius: 6px; padding: .7rem 1rem; overflow-x: auto;
      font: .85em/1.45 ui-monospace, "Liberation Mono", "DejaVu Sans Mono", monospace; }
</style>
</head>
<body>
<h1>The controllers beside each other</h1>
<p>Measured on the emulator's true state. Wanted: at most so much of the controller that aims at it. Bound: what no
drive can go below. Printed: the paper's own figures, traditional / paper. A star: of the runs that ended well.</p>
<p><b>$verdict.</b></p>
$missed
$compared
$groups
<h2>Again</h2>
<pre>$command</pre>
</body>
</html>
""")
