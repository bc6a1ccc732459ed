"""Where things are in the repository that this package is installed from."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[3]
BUILD = ROOT / "build"
PYTHON_PACKAGES = ROOT / "tools" / "requirements.lock"
MACHINES = ROOT / "tools" / "machines"
LOADS = ROOT / "tools" / "loads"
SCENARIOS = ROOT / "tools" / "scenarios"
DRIVE_DBC = ROOT / "firmware" / "comms" / "drive.dbc"
PARAMETERS = ROOT / "firmware" / "drive" / "parameters.def"
RIG_DBC = ROOT / "emulator" / "rig" / "rig.dbc"
