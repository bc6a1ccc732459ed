"""The build of a drive in a tab, in links: a hash of everything that its bits follow from."""

from __future__ import annotations

import hashlib
from functools import lru_cache

from salient.paths import ROOT

_FOLDERS = ("firmware", "hal", "emulator", "cmake", "tools/machines", "tools/src/salient/machine",
            "tools/src/salient/generate")
_SUFFIXES = (".c", ".h", ".def", ".dbc", ".toml", ".csv", ".cmake", ".txt", ".py")
_CLIENT = ("world.js", "client.js", "run.js", "messages.js", "e2e.js")
_DIGITS = 12


@lru_cache
def build_id() -> str:
    """12 hexadecimal digits: of sources, machines, generators and the client in the page."""
    files = [path for folder in _FOLDERS for path in (ROOT / folder).rglob("*") if path.suffix in _SUFFIXES]
    files += [ROOT / "tools" / "src" / "salient" / "tab" / "page" / name for name in _CLIENT]
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:_DIGITS]
