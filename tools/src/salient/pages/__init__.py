"""HTML pages of the commands: Jinja templates on one base, without external files, equal bytes for equal content."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

CONTROLLER_COLOUR = {"traditional": "#c4551b", "paper": "#1e62a8", "salient": "#109a76"}
"""Distinguishable by lightness or hue also with colour-blindness (test_report.py); used by all plots and pages."""

CONTROLLER_NAME = {"traditional": "Traditional", "paper": "Paper", "salient": "Salient"}
_OTHER_COLOUR = "#444444"


@dataclass(frozen=True)
class Plot:
    """A plot of a page. png: the bytes of the file."""

    title: str
    caption: str
    png: bytes


def controller_colour(controller: str) -> str:
    """Colour "#rrggbb" of a controller in plots and pages."""
    return CONTROLLER_COLOUR.get(controller, _OTHER_COLOUR)


def controller_name(controller: str) -> str:
    """Name of a controller in plots and pages."""
    return CONTROLLER_NAME.get(controller, controller)


def write_page(path: Path, template: str, content: Mapping[str, Any]) -> None:
    """Writes `template`, a file of this package, filled with `content`; all text is escaped."""
    path.write_text(_environment().get_template(template).render(content), encoding="utf-8")


def _symbols(text: str) -> Markup:
    """Escaped text with K_t set as a symbol with an index."""
    return Markup(str(escape(text)).replace("K_t", "<i>K</i><sub>t</sub>"))


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")


@lru_cache
def _environment() -> Environment:
    environment = Environment(loader=PackageLoader("salient", "pages"), autoescape=True, undefined=StrictUndefined,
                              trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    environment.filters |= {
        "base64": _base64,
        "colour": controller_colour,
        "controller_name": controller_name,
        "symbols": _symbols,
    }
    return environment
