"""Arguments of the campaign's measurements, each a module with its usage as its text."""

from __future__ import annotations

import argparse
from pathlib import Path


def parser(module: str, text: str | None) -> argparse.ArgumentParser:
    """Parser of a module, with DIR for its results as first argument; text: of the module, its help."""
    made = argparse.ArgumentParser(f"python -m salient.experiments.campaign.{module}", description=text,
                                   formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)
    made.add_argument("out", type=Path, metavar="DIR", help="folder for the results; what it has is not run again")
    return made


def count(text: str) -> int:
    """A whole number from 1 on."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be a whole number from 1 on")
    return int(text)
