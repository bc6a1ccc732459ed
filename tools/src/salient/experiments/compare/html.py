"""compare.html: one self-contained page with tables, plots, and the changes from the baseline; plots/GROUP.png beside
it: the plots of each group as files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from salient.experiments.compare import plots, table
from salient.experiments.compare.baseline import Change
from salient.experiments.compare.cases import TITLES
from salient.experiments.compare.table import Row
from salient.pages import Plot
from salient.pages import write_page as write_template

PLOTS = "plots"
"""Folder with the plots as files."""


def write_page(path: Path, rows: Sequence[Row], content: Mapping[str, Any], change_summary: str | None,
               changes: Sequence[Change], command: str, titles: Mapping[str, str] = TITLES) -> None:
    """Writes the page and the files of its plots for `rows` and `content` (of compare.json), titles by group.
    change_summary: text of baseline.summary, None without a baseline. Equal input gives equal bytes."""
    groups = [_group(name, titles[name], list(of), content) for name, of in groupby(rows, key=lambda row: row.key[0])]
    write_template(path, "compare.html", {
        "summary": table.summary(rows),
        "missed": [_missed(row) for row in rows if row.reached is False],
        "changes": change_summary,
        "changes_plot": plots.changes_plot(changes),
        "groups": groups,
        "command": command,
    })
    _write_plots(path.parent / PLOTS, {group["name"]: group["plots"] for group in groups})


def _write_plots(folder: Path, plots_of: Mapping[str, Sequence[Plot]]) -> None:
    """GROUP.png, GROUP_2.png and so on; files of an earlier run are removed."""
    for earlier in folder.glob("*.png"):
        earlier.unlink()
    for group, of in plots_of.items():
        for number, plot in enumerate(of, start=1):
            folder.mkdir(exist_ok=True)
            (folder / f"{group}{f'_{number}' if number > 1 else ''}.png").write_bytes(plot.png)


def _missed(row: Row) -> str:
    """A target that is not reached, with the value and the reason."""
    group, condition, metric, _ = row.key
    text = (f"{group}, {condition}: {row.label} {table.cell(row, row.target.controller)}, target"
            f" {table.format_limit(metric, row.target.limit)}.")
    return f"{text} {row.target.reason}".rstrip()


def _group(name: str, title: str, rows: Sequence[Row], content: Mapping[str, Any]) -> dict[str, Any]:
    controllers = table.controllers_of(rows)
    conditions = []
    for condition, of_condition in groupby(rows, key=lambda row: row.key[1]):
        condition_rows = list(of_condition)
        conditions.append({"title": condition, "failed": list(table.failed_of(condition_rows).items()),
                           "rows": [_row(row, controllers) for row in condition_rows]})
    return {"name": name, "title": title[0].upper() + title[1:], "plots": plots.group_plots(name, content),
            "controllers": controllers, "conditions": conditions}


def _row(row: Row, controllers: Sequence[str]) -> dict[str, Any]:
    metric, target = row.key[2], row.target
    state = "unjudged" if row.too_few_samples else {True: "reached", False: "missed", None: ""}[row.reached]
    return {
        "label": row.label,
        "cells": [*(table.cell(row, controller) for controller in controllers),
                  table.format_limit(metric, target.limit), table.format_limit(metric, target.bound)],
        "published": table.format_published(row),
        "state": state,
        "status": table.status(row),
    }
