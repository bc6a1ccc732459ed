"""python-can without its MF4 reader and writer, for programs of this package.

python-can loads asammdf where that is installed, and with it pandas: 0.6 s of processor time and 85 MB in each process.
`salient.bus.mf4` loads asammdf itself when a log is to be an MF4 file.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from types import ModuleType

_CLIENT, _LOADED, _LAST_NAME = "can.io.mf4", "asammdf", "MF4Reader"


class _WithoutMf4(MetaPathFinder):
    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> None:
        """Refuses asammdf while python-can's module is being imported, which takes it for not installed."""
        client = sys.modules.get(_CLIENT)
        if fullname == _LOADED and client is not None and not hasattr(client, _LAST_NAME):
            raise ModuleNotFoundError(f"{_LOADED} is loaded when it is used", name=_LOADED)


def without_mf4() -> None:
    """To be called before python-can is imported. Not in a process of somebody else, which may read MF4 files."""
    if not any(isinstance(finder, _WithoutMf4) for finder in sys.meta_path):
        sys.meta_path.insert(0, _WithoutMf4())
