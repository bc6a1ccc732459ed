"""Where things are in the repository that this package is installed from."""

from pathlib import Path

from salient.errors import UsageError, shown

ROOT = Path(__file__).resolve().parents[3]
BUILD = ROOT / "build"
PYTHON_PACKAGES = ROOT / "tools" / "requirements.lock"
MACHINES = ROOT / "tools" / "machines"
LOADS = ROOT / "tools" / "loads"
SCENARIOS = ROOT / "tools" / "scenarios"
DRIVE_DBC = ROOT / "firmware" / "comms" / "drive.dbc"
PARAMETERS = ROOT / "firmware" / "drive" / "parameters.def"
TAB_PAGE = ROOT / "tools" / "src" / "salient" / "tab" / "page"
RIG_DBC = ROOT / "emulator" / "rig" / "rig.dbc"


def bundled_or_path(name_or_path: str, folder: Path, suffix: str, key: str) -> Path:
    """The file meant by the name of a bundled one in a folder, or by a path; UsageError, which begins with the key,
    when there is none."""
    bundled, path = folder / f"{name_or_path}{suffix}", Path(name_or_path)
    try:
        if bundled.is_file():
            return bundled
        if path.is_file():
            return path.resolve()
    except OSError:
        pass  # a name too long for a file: there is none
    names = ", ".join(sorted(p.stem for p in folder.glob(f"*{suffix}")))
    raise UsageError(f"{key} {shown(name_or_path)}: no such file, and no bundled {key.replace('_', ' ')} of that name"
                     f" ({names})")
