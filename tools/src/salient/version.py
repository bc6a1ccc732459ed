"""Version of firmware and tools, from the CMake project. Standard library only."""

import re

from salient.paths import ROOT

_PROJECT = ROOT / "CMakeLists.txt"
_found = re.search(r"^project\(salient VERSION ([0-9.]+)", _PROJECT.read_text(encoding="utf-8"), re.MULTILINE)
if _found is None:
    raise ValueError(f"{_PROJECT}: no line project(salient VERSION ...)")
VERSION = _found[1]
