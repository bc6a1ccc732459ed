"""Puts the page and everything that it needs into one HTML file that makes no request.

The scripts of the live page and of the tab are data: addresses in an import map; module, machines and
databases are one packed block.
"""

from __future__ import annotations

import base64
import json
import re
import struct
import zlib
from pathlib import Path
from urllib.parse import quote

import numpy as np

from salient.errors import UsageError
from salient.machine.cache import machine_image
from salient.machine.image import FLUX_MAP, HEADER
from salient.machine.path import machine_path
from salient.paths import BUILD, TAB_PAGE
from salient.tab.build_id import build_id
from salient.tab.data import bundled_machines, machine_data, shared_data
from salient.version import VERSION

MODULE = BUILD / "wasm" / "bin" / "salient.wasm"
_PACKAGE = TAB_PAGE.parents[1]
_VIEW_PAGE = _PACKAGE / "view" / "page"
_LOOK = _PACKAGE / "pages" / "look.css"
_ENTRY = "main_tab.js"
_ONLY_LIVE = ("live.js", "main.js")
_SPECIFIER = re.compile(r'(\b(?:from|import)\s+)"\.[^"]*?([\w-]+\.js)"')
_COMMENT = re.compile(r"^ *(?://.*|(?s:/\*\*.*?\*/))\n| +// .*$", re.MULTILINE)
"""Comments on lines of their own, and those after code; no text of the page has " // "."""
_UNESCAPED = " !$&'()*+,-./:;=?@[]_{|}~`^"
"""Characters that a data: address within an attribute of HTML has as they are."""


def tab_html(machine: str | None = None) -> str:
    """The file; with one more machine than the bundled ones. UsageError: no such machine."""
    machines = bundled_machines()
    if machine is not None and machine_path(machine).stem not in machines:
        machines.append(machine)
    html = (_VIEW_PAGE / "index.html").read_text(encoding="utf-8")
    html = re.sub(r'<link rel="stylesheet" href="([^"]*)">', lambda match: _style(match[1]), html)
    html = re.sub(r'<script src="([^"]*)"></script>', lambda match: _script(_VIEW_PAGE / match[1]), html)
    start = (f'<script type="importmap">{_import_map()}</script>\n'
             f'<script type="text/plain" id="tab-data">{_packed(machines)}</script>\n'
             f'<script type="module">import "salient/{_ENTRY}";</script>')
    return re.sub(r'<script type="module" src="main.js"></script>', lambda _: start, html)


def run(path: Path, machine: str | None) -> int:
    """Writes the file."""
    text = tab_html(machine).encode()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text)
    except OSError as error:
        raise UsageError(f"--out {path}: {error.strerror}") from None
    print(f"{path}: {len(text):,} bytes, {packed_bytes(text):,} after gzip -9; build {build_id()}")
    return 0


def packed_bytes(text: bytes) -> int:
    """Size after gzip -9."""
    return len(zlib.compress(text, 9, 31))


def _style(name: str) -> str:
    path = _LOOK if name == _LOOK.name else _VIEW_PAGE / name
    return f"<style>\n{path.read_text(encoding='utf-8')}</style>"


def _script(path: Path) -> str:
    return f"<script>\n{path.read_text(encoding='utf-8')}</script>"


def _import_map() -> str:
    scripts = {path.name: path for folder in (_VIEW_PAGE, TAB_PAGE) for path in sorted(folder.glob("*.js"))
               if path.name not in _ONLY_LIVE}
    imports = {f"salient/{name}": "data:text/javascript;charset=utf-8," + quote(_module_text(path), safe=_UNESCAPED)
               for name, path in scripts.items()}
    return json.dumps({"imports": imports}, separators=(",", ":"))


def _module_text(path: Path) -> str:
    """A module whose imports name modules of the map; without its comments."""
    return _SPECIFIER.sub(r'\1"salient/\2"', _COMMENT.sub("", path.read_text(encoding="utf-8")))


def _packed(machines: list[str]) -> str:
    """Base64 of a zlib stream: size of a JSON text, the text, and the files whose sizes it has; the doubles of a flux
    map, from maps[i] of image i on, by _transposed."""
    images = [machine_image(machine).read_bytes() for machine in machines]
    maps = [_flux_map_at(image) for image in images]
    files = [MODULE.read_bytes(), *map(_transposed, images, maps)]
    text = json.dumps({**shared_data(), **machine_data(machines), "build": build_id(), "version": VERSION,
                       "files": [len(data) for data in files], "maps": maps}, separators=(",", ":")).encode()
    content = b"".join([struct.pack("<I", len(text)), text, *files])
    return base64.b64encode(zlib.compress(content, 9)).decode()


def _flux_map_at(image: bytes) -> list[int]:
    """Where an image has its flux map, and how many doubles, which may be 0."""
    *_, tables, plant, flux_map, _ = HEADER.unpack_from(image)
    if flux_map not in (0, FLUX_MAP.size):
        raise ValueError(f"flux map of {flux_map} bytes")
    return [HEADER.size + tables + plant, flux_map // 8]


def _transposed(image: bytes, place: list[int]) -> bytes:
    """The image with its doubles as differences of neighbours, taken as whole numbers modulo 2^64, the bytes of equal
    weight together: a fifth smaller when packed, and exact (page/data.js)."""
    start, count = place
    end = start + 8 * count
    numbers = np.frombuffer(image[start:end], "<u8")
    differences = np.diff(numbers, prepend=np.zeros(1, "<u8"))
    return image[:start] + differences.view("u1").reshape(count, 8).T.tobytes() + image[end:]
