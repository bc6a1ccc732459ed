"""Includes of C and imports of Python point from higher layers to lower ones, without cycles.

Layers are listed from the lowest to the highest; a file belongs to the longest entry that is a prefix of its
path or module name. Lazy imports and those under TYPE_CHECKING count.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from salient.paths import ROOT

Graph = Mapping[str, set[str]]

C_LAYERS = (
    "hal/", "hal/qemu/", "firmware/fixed/", "firmware/control/", "firmware/storage/", "firmware/monitors/",
    "firmware/interrupts/", "firmware/comms/", "firmware/drive/",
    "emulator/plant/", "emulator/plant_library/", "emulator/plant_benchmark/", "emulator/fmi/", "emulator/rig/",
    "emulator/host/", "emulator/campaign/", "emulator/wasm/", "emulator/qemu/", "emulator/qemu/image/",
)  # fmt: skip
INCLUDE_ROOTS = ("", "hal", "firmware", "emulator")
FIRMWARE_FOR_THE_EMULATOR = {"firmware/drive/drive.h"}
JOINS_FIRMWARE_AND_EMULATOR = {"emulator/host/host_drive.h", "emulator/host/memory_flip.h",
                               "emulator/qemu/image/main.c"}

PYTHON_LAYERS = (
    "salient", "salient.errors", "salient.paths", "salient.progress", "salient.config", "salient.version",
    "salient.dbc", "salient.toml_file",
    "salient.cli", "salient.elf", "salient.vm", "salient.machine", "salient.finite_elements",
    "salient.generate", "salient.reference.torque_speed_bound", "salient.reference.copper_bound",
    "salient.bus", "salient.bench", "salient.suite", "salient.view", "salient.tab", "salient.bench.pytest_plugin",
    "salient.experiments", "salient.test_runner", "salient.wheel", "salient.cmake",
    "salient.benchmark.switching_pattern", "salient.reference", "salient.target", "salient.benchmark",
    "salient.__main__",
)  # fmt: skip


def includes(root: Path) -> Graph:
    """Files of the C layers, each with the files of the tree that it includes."""
    tops = (root / "hal", root / "firmware", root / "emulator")
    files = {str(path.relative_to(root)) for top in tops for path in top.rglob("*.[ch]")}
    graph = {}
    for file in files:
        names = re.findall(r'^\s*#\s*include\s+"([^"]+)"', (root / file).read_text(encoding="utf-8"), re.MULTILINE)
        places = ({str(Path(file).parent / name), *(str(Path(top) / name) for top in INCLUDE_ROOTS)} for name in names)
        graph[file] = set().union(*(place & files for place in places))
    return graph


def imports(package: Path) -> Graph:
    """Modules of a package, each with the modules of the package that it imports."""
    paths = {".".join(path.relative_to(package.parent).with_suffix("").parts): path for path in package.rglob("*.py")}
    modules = {name.removesuffix(".__init__"): path for name, path in paths.items()}
    graph = {}
    for module, path in modules.items():
        names = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{path}: a relative import"
                submodules = {f"{node.module}.{alias.name}" for alias in node.names} & set(modules)
                names |= submodules or {node.module}
        graph[module] = (names & set(modules)) - {module}
    return graph


def upwards(graph: Graph, layers: Sequence[str], separator: str) -> Iterator[str]:
    """Arrows to a higher layer, and files of no layer."""

    def level(name: str) -> int:
        return max((len(layer), index) for index, layer in enumerate(layers)
                   if name == layer or name.startswith(layer.rstrip(separator) + separator))[1]

    for source, targets in sorted(graph.items()):
        for target in sorted(targets):
            if level(target) > level(source):
                yield f"{source} -> {target}"


def circle(graph: Graph) -> list[str]:
    """A cycle of the graph, or an empty list."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def crossings(graph: Graph) -> Iterator[str]:
    """Includes that the order of layers allows and the design forbids: firmware of a port, emulator of firmware."""
    for source, targets in sorted(graph.items()):
        for target in sorted(targets):
            if source.startswith("firmware/") and target.startswith("hal/qemu/"):
                yield f"{source} -> {target}"
            joins = source in JOINS_FIRMWARE_AND_EMULATOR and target in FIRMWARE_FOR_THE_EMULATOR
            if source.startswith("emulator/") and target.startswith("firmware/") and not joins:
                yield f"{source} -> {target}"


def test_includes_follow_the_layers() -> None:
    graph = includes(ROOT)
    assert "emulator/rig/rig.h" in graph["emulator/rig/rig.c"] and "hal/hal.h" in graph["hal/hal_adc.h"]
    assert list(upwards(graph, C_LAYERS, "/")) == []
    assert list(crossings(graph)) == []
    assert circle(graph) == []


def test_imports_follow_the_layers() -> None:
    graph = imports(ROOT / "tools" / "src" / "salient")
    assert "salient.bench.session" in graph["salient.bench.bench"]
    assert list(upwards(graph, PYTHON_LAYERS, ".")) == []
    assert circle(graph) == []


@pytest.mark.parametrize(("file", "line", "found"), [
    ("hal/hal.h", '#include "drive/drive.h"', "hal/hal.h -> firmware/drive/drive.h"),
    ("firmware/control/law.h", '#include "drive/state.h"', "firmware/control/law.h -> firmware/drive/state.h"),
    ("firmware/drive/drive.c", '#include "qemu/mailbox.h"', "firmware/drive/drive.c -> hal/qemu/mailbox.h"),
    ("emulator/rig/rig.c", '#include "drive/drive.h"', "emulator/rig/rig.c -> firmware/drive/drive.h"),
    ("emulator/host/main.c", '#include "drive/state.h"', "emulator/host/main.c -> firmware/drive/state.h"),
])
def test_forbidden_include_is_found(tmp_path: Path, file: str, line: str, found: str) -> None:
    for name in ("hal/hal.h", "hal/qemu/mailbox.h", "firmware/drive/drive.h", "firmware/drive/state.h", file):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("")
    (tmp_path / file).write_text(f"{line}\n")
    graph = includes(tmp_path)
    assert [*upwards(graph, C_LAYERS, "/"), *crossings(graph)] == [found]


def test_cyclic_include_is_found(tmp_path: Path) -> None:
    (tmp_path / "hal").mkdir()
    (tmp_path / "hal" / "a.h").write_text('#include "b.h"\n')
    (tmp_path / "hal" / "b.h").write_text('#include "a.h"\n')
    assert set(circle(includes(tmp_path))) == {"hal/a.h", "hal/b.h"}


@pytest.mark.parametrize("text", [
    "from salient.bench import session\n",
    "import salient.bench.session\n",
    "def lazy():\n    from salient.bench.session import Session\n",
    "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from salient.bench.session import Session\n",
])
def test_forbidden_import_is_found(tmp_path: Path, text: str) -> None:
    package = tmp_path / "salient"
    for name, content in {"__init__": "", "errors": text, "bench/__init__": "",
                          "bench/session": "from salient.errors import UsageError\n"}.items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / f"{name}.py").write_text(content)
    graph = imports(package)
    assert list(upwards(graph, PYTHON_LAYERS, ".")) == ["salient.errors -> salient.bench.session"]
    assert set(circle(graph)) == {"salient.errors", "salient.bench.session"}
