"""The command line of tools/salient compare. Standard library only, as salient.cli is."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

WORSE_PERCENT = 10.0
"""Of a ripple, an extreme of one run, changes of some percent are chance."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """What compare takes; the names of groups are looked at in salient.experiments.compare.command."""
    parser.add_argument("groups", nargs="*", metavar="GROUP", help="what to measure (default all but the long ones)")
    parser.add_argument("--list", action="store_true", help="say which groups there are")
    parser.add_argument("--quick", action="store_true", help="fewer machines, rates and angles: some 20 s")
    parser.add_argument("--out", type=Path, default=Path("out/compare"), metavar="DIR",
                        help="folder (default out/compare)")
    parser.add_argument("--jobs", type=_jobs, metavar="N", help="runs at a time (default as many as there are cores)")
    parser.add_argument("--baseline", type=Path, metavar="DIR|FILE",
                        help="folder or compare.json of an earlier run: report changes, exit code 1 if worse")
    parser.add_argument("--worse-percent", type=_percent, default=WORSE_PERCENT, metavar="X",
                        help=f"a change beyond this counts (default {WORSE_PERCENT:g})")


def _jobs(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= 1024:
        raise argparse.ArgumentTypeError(f"{text}: allowed are whole numbers from 1 to 1024")
    return int(text)


def _percent(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 <= value <= 1000.0:
        raise argparse.ArgumentTypeError(f"{text}: allowed are numbers from 0 to 1000")
    return value
