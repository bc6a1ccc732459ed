"""Where things are: in the repository that this package is installed from, or in the package itself, a wheel, whose
folder data/ has the files that are needed in the places that they have in the repository (tools/setup.py)."""

import contextlib
import fcntl
import os
import sys
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TextIO

from salient.errors import UsageError, cannot_write, close_names, shown
from salient.guard import removes

_DATA = Path(__file__).resolve().parent / "data"
IS_WHEEL = _DATA.is_dir()
ROOT = _DATA if IS_WHEEL else _DATA.parents[3]
BUILD_VARIABLE = "SALIENT_BUILD"
_LOCK_TOLD_S = 5.0
_LOCK_LOOK_S = 0.02


def _build_folder() -> Path:
    if IS_WHEEL:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "salient"
    given = os.environ.get(BUILD_VARIABLE)
    if not given:
        return ROOT / "build"
    # Processes that this one starts in another folder mean the same one.
    folder = Path(given)
    with contextlib.suppress(FileNotFoundError):  # the present folder has been removed: told when this one is made
        folder = Path(os.path.abspath(given))  # noqa: PTH100 - without .., which Path keeps
    os.environ[BUILD_VARIABLE] = str(folder)
    return folder


BUILD = _build_folder()
"""Files made while the tools are used, and in a repository the programs: build/ in the repository, or the folder that
SALIENT_BUILD names, for a repository that cannot be written. Nothing else reads that variable."""
OUT = Path("out") if BUILD == ROOT / "build" or IS_WHEEL else BUILD / "out"
"""Parent of the folders of --out that are not given: in the present folder, or where everything else goes."""
COMMAND = "salient" if IS_WHEEL else "tools/salient"
PYTHON_PACKAGES = ROOT / "tools" / "requirements.lock"
MACHINES = ROOT / "tools" / "machines"
EXAMPLE_MACHINES = ROOT / "tools" / "examples" / "machines"
LOADS = ROOT / "tools" / "loads"
SCENARIOS = ROOT / "tools" / "scenarios"
DRIVE_DBC = ROOT / "firmware" / "comms" / "drive.dbc"
PARAMETERS = ROOT / "firmware" / "storage" / "parameters.def"
OBJECTS = ROOT / "firmware" / "comms" / "objects.toml"
REFERENCE = ROOT / "docs" / "reference"
"""Pages that generators and measurements write."""
TAB_PAGE = ROOT / "tools" / "src" / "salient" / "tab" / "page"
RIG_DBC = ROOT / "emulator" / "rig" / "rig.dbc"


def program(build: str, name: str) -> Path:
    """A program of a build, which may not exist; in a wheel all are for the host."""
    return ROOT / "bin" / name if IS_WHEEL else BUILD / build / "bin" / name


def from_root(path: Path) -> str:
    """A path in a message: short for what is in the repository."""
    return str(path.relative_to(ROOT) if path.is_relative_to(ROOT) else path)


@contextlib.contextmanager
def build_lock() -> Iterator[None]:
    """Makes the build folder and holds its lock: no two commands build at once. UsageError when nothing can be written
    there, or when it is the folder of another clone, whose packages and programs would be replaced."""
    with _open_lock():
        yield


def _open_lock() -> TextIO:
    with contextlib.ExitStack() as stack:
        try:
            BUILD.mkdir(parents=True, exist_ok=True)
            lock = stack.enter_context((BUILD / "launcher.lock").open("w"))
            _wait_for(lock)
            note = BUILD / "clone"
            owner = Path(os.fsdecode(note.read_bytes())) if note.exists() else ROOT
            if BUILD != ROOT / "build" and owner != ROOT and (owner / "tools").is_dir():
                raise UsageError(f"{BUILD_VARIABLE} {BUILD}: another clone is built there, {owner}; each needs a "
                                 "folder of its own")
            if owner != ROOT or not note.exists():
                note.write_bytes(os.fsencode(ROOT))
        except OSError as error:
            reason = ("not a folder" if isinstance(error, FileExistsError | NotADirectoryError) else error.strerror)
            raise UsageError(f"{BUILD}: {reason}; everything is built there, or in a writable folder that "
                             f"{BUILD_VARIABLE} names") from None
        stack.pop_all()
        return lock


def _wait_for(lock: TextIO) -> None:
    """Takes a lock; tells in a line that another command has it when that takes longer than a build that is up to
    date."""
    told_s = time.monotonic() + _LOCK_TOLD_S
    while time.monotonic() < told_s:
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        time.sleep(_LOCK_LOOK_S)
    print(f"salient: waiting for another command, which installs or builds in {from_root(BUILD)}", file=sys.stderr,
          flush=True)
    fcntl.flock(lock, fcntl.LOCK_EX)


def keep_text(path: Path, text: str) -> None:
    """Writes a file that others may write and read at the same time, where it does not have this text yet: a process
    sees a whole file or none."""
    if path.exists() and path.read_text(encoding="utf-8") == text:
        return
    write_whole(path, text.encode())


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file and its folder: another process sees the whole file or none, whatever ends this one. OSError; then
    a file that was there is as it was."""
    if path.exists() and not path.is_file():  # a device or a pipe, which is written, or a folder
        path.write_bytes(content)
        return
    path = path.resolve()  # a link stays one
    temporary = path.with_name(f"{path.name}.{os.urandom(8).hex()}")
    removes(temporary)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def make_folder(out: Path, removed: Sequence[str] = ()) -> None:
    """Makes the folder of --out, if needed; UsageError when nothing can be written there. removed: patterns of the
    files of an earlier run, which could be taken for the files of one that fails half-way."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=out).close()
        for pattern in removed:
            for path in out.glob(pattern):
                path.unlink()
    except OSError as error:
        raise cannot_write(f"--out {out}", error) from None


def keep_sources(option: str, written: Iterable[Path], *read: Path) -> None:
    """UsageError, a line that begins with the option: a file that is to be written is one that is read, by whatever
    name."""
    for path in written:
        for source in read:
            if path.exists() and source.exists() and path.samefile(source):
                raise UsageError(f"{option}: {source} is read, and would be overwritten; name another file")


def bundled_or_path(name_or_path: str, folder: Path, suffix: str, key: str, *more: Path) -> Path:
    """The file meant by the name of a bundled one in a folder, the first of several, or by a path; UsageError, which
    begins with the key, when there is none."""
    folders, path = (folder, *more), Path(name_or_path)
    try:
        for bundled in (each / f"{name_or_path}{suffix}" for each in folders):
            if bundled.is_file():
                return bundled
        if path.is_file():
            return path.resolve()
    except OSError:
        pass  # a name too long for a file: there is none
    names = sorted(p.stem for each in folders for p in each.glob(f"*{suffix}"))
    raise UsageError(f"{key} {shown(name_or_path)}: no such file, and no bundled {key.replace('_', ' ')} of that name; "
                     f"{close_names(path.stem, names)}")


def scenario_path(name_or_path: Path) -> Path:
    """The file of a bundled scenario by its name, else the path as it was given; UsageError when nothing is there."""
    try:
        found = bundled_or_path(str(name_or_path), SCENARIOS, ".toml", "scenario")
    except UsageError:
        if not os.path.lexists(name_or_path):
            raise
        return name_or_path
    return found if found.parent == SCENARIOS else name_or_path
