"""Where things are in the repository that this package is installed from."""

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
BUILD = Path(os.environ.get("SALIENT_BUILD", ROOT / "build"))
"""Build folder; the environment variable SALIENT_BUILD names another one, as tests/target/compare_builds.py does."""
MACHINES = ROOT / "tools" / "machines"
LOADS = ROOT / "tools" / "loads"
SCENARIOS = ROOT / "tools" / "scenarios"
DRIVE_DBC = ROOT / "firmware" / "comms" / "drive.dbc"
RIG_DBC = ROOT / "emulator" / "rig" / "rig.dbc"
