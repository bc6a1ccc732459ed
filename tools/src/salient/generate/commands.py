"""Writes the reference page of the commands and their options from the command line's own parser.

    python -m salient.generate.commands

writes docs/reference/commands.md.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator

from salient.cli import make_parser
from salient.generate.files import cell
from salient.paths import BUILD, OUT, REFERENCE, from_root

PAGE = REFERENCE / "commands.md"

_HEAD = """# Commands

Generated from `tools/src/salient/cli.py` by `python -m salient.generate.commands`; do not edit.

`tools/salient COMMAND` sets up what is missing, builds, and runs. `--help` after a command prints the same text.
`--no-install` names what is missing instead of installing it.

| exit code | meaning |
| --- | --- |
| 0 | done |
| 1 | the tested thing failed |
| 2 | usage error: one line names the file, key or option |
"""


def _subcommands(parser: argparse.ArgumentParser) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield from action.choices.items()


def _cell(text: str) -> str:
    """A text within a row of a table; folders are those without SALIENT_BUILD."""
    for folder, shown in ((str(OUT), "out"), (from_root(BUILD), "build")):
        text = text.replace(folder, shown)
    return cell(text.replace("|", " or "))


def _row(parser: argparse.ArgumentParser, action: argparse.Action) -> str:
    metavar = action.metavar if isinstance(action.metavar, str) else ""
    if not action.option_strings:
        name = metavar or action.dest
    elif action.nargs == 0:
        name = action.option_strings[-1]
    else:
        more = {"+": " ...", "?": ""}.get(str(action.nargs), "")
        name = f"{action.option_strings[-1]} {metavar or action.dest.upper()}{more}"
    text = parser._get_formatter()._expand_help(action) if action.help else ""
    return f"| `{_cell(name)}` | {_cell(text)} |"


def _section(name: str, parser: argparse.ArgumentParser, level: str) -> Iterator[str]:
    yield f"\n{level} {name}\n\n{_sentence(_cell(parser.description or ''))}\n"
    actions = [action for action in parser._actions if action.dest not in ("help", "no_install")
               and not isinstance(action, argparse._SubParsersAction)]
    if actions:
        yield "\n| argument | meaning |\n| --- | --- |\n"
        yield from (f"{_row(parser, action)}\n" for action in actions)
    for action, of in _subcommands(parser):
        yield from _section(f"{name} {action}", of, f"{level}#")


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}"


def page() -> str:
    """The reference page."""
    return _HEAD + "".join(line for name, parser in _subcommands(make_parser())
                           for line in _section(name, parser, "##"))


def main() -> int:
    """Writes the page; returns the exit code."""
    PAGE.write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
