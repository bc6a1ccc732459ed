"""Includes and calls of C and imports of Python point from higher layers to lower ones, without cycles.

Layers are listed from the lowest to the highest; a file belongs to the longest entry that is a prefix of its
path or module name. Lazy imports and those under TYPE_CHECKING count, and so does a function's address.
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
    "firmware/interrupts/", "firmware/comms/", "firmware/drive/", "firmware/layout/",
    "hal/skeleton/", "hal/stm32g4/",
    "emulator/plant/", "emulator/plant_library/", "emulator/plant_benchmark/", "emulator/fmi/", "emulator/rig/",
    "emulator/host/", "emulator/campaign/", "emulator/wasm/", "emulator/qemu/", "emulator/qemu/image/",
    "emulator/stm32g4/",
)  # fmt: skip
INCLUDE_ROOTS = ("", "hal", "firmware", "emulator")
FIRMWARE_FOR_THE_EMULATOR = {"firmware/drive/drive.h"}
PORTS = ("hal/qemu/", "hal/skeleton/", "hal/stm32g4/")
JOINS_FIRMWARE_AND_EMULATOR = {"emulator/host/host_drive.h", "emulator/host/memory_flip.h",
                               "emulator/qemu/image/main.c"}

WIRED_IN_CIRCLES = "emulator/stm32g4/"
"""The blocks of a part request each other as they are wired: a timer DMA, DMA a timer, a comparator a break."""

PYTHON_LAYERS = (
    "salient", "salient.guard", "salient.errors", "salient.paths", "salient.workers", "salient.progress",
    "salient.config", "salient.version", "salient.light_can", "salient.dbc", "salient.toml_file", "salient.exceptions",
    "salient.c_limits", "salient.language", "salient.turns",
    "salient.cli", "salient.elf", "salient.drive_layout", "salient.vm", "salient.machine", "salient.finite_elements",
    "salient.generate", "salient.board", "salient.reference.torque_speed_bound", "salient.reference.copper_bound",
    "salient.bus", "salient.bench", "salient.suite", "salient.view", "salient.tab", "salient.bench.pytest_plugin",
    "salient.identify", "salient.experiments", "salient.traceability", "salient.generate.diagnostic_coverage",
    "salient.generate.requirements", "salient.test_runner", "salient.wheel",
    "salient.cmake",
    "salient.benchmark.switching_pattern", "salient.reference", "salient.target", "salient.benchmark",
    "salient.documents", "salient.evidence",
    "salient.kept_files", "salient.__main__",
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


FUNCTION = re.compile(r"^(?!static\b|MAGNETICS_INLINE\b|typedef\b|return\b|else\b)[A-Za-z_][\w *]*?[ *]"
                      r"(?P<name>\w+)\([^;{}]*?\)\s*(?P<end>[{;])", re.MULTILINE)
"""Definition or declaration of a function that other files can call, in sources as clang-format leaves them."""
NOT_CODE = re.compile(r'/\*.*?\*/|//[^\n]*|"(?:\\.|[^"\\\n])*"|^\s*#\s*include[^\n]*', re.DOTALL | re.MULTILINE)


def reachable(graph: Graph, start: str) -> set[str]:
    """A file and all that it includes."""
    found, waiting = {start}, [start]
    while waiting:
        new = graph[waiting.pop()] - found
        found |= new
        waiting += new
    return found


def calls(root: Path) -> Graph:
    """Files of the C layers, each with the files that define the functions it calls or takes the address of.

    A function of the HAL, and one that several ports define, belongs to the header that declares it. A name counts
    where a header that declares it is included.
    """
    included = includes(root)
    code = {file: NOT_CODE.sub(" ", (root / file).read_text(encoding="utf-8")) for file in included}
    defined: dict[str, set[str]] = {}
    declared: dict[str, set[str]] = {}
    for file, text in code.items():
        for match in FUNCTION.finditer(text):
            (defined if match["end"] == "{" else declared).setdefault(match["name"], set()).add(file)
    graph: dict[str, set[str]] = {}
    for file, text in code.items():
        visible = reachable(included, file)
        names = set(re.findall(r"(?<![\w.>])[a-z]\w*", text)) & set(defined)
        graph[file] = set()
        for name in names:
            headers = declared.get(name, set())
            port = len(defined[name]) > 1 or any(header.startswith("hal/") for header in headers)
            if file not in defined[name] and headers & visible:
                graph[file] |= headers if port else defined[name]
        graph[file] -= {file}
    return graph


def modules(graph: Graph) -> Graph:
    """A source file and its header as one."""
    joined: dict[str, set[str]] = {}
    for file, targets in graph.items():
        module = str(Path(file).with_suffix(""))
        joined.setdefault(module, set()).update(str(Path(target).with_suffix("")) for target in targets)
    return {module: targets - {module} for module, targets in joined.items()}


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
            if source.startswith("firmware/") and target.startswith(PORTS):
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


def test_calls_follow_the_layers() -> None:
    graph = calls(ROOT)
    assert "emulator/rig/scheduler.c" in graph["emulator/rig/server.c"], "a call"
    assert "emulator/rig/stimulus.c" in graph["emulator/rig/rig.c"], "an address"
    assert "emulator/rig/can_bus.c" in graph["emulator/rig/shared_bus.h"], "a call from a header"
    assert "hal/hal_pwm.h" in graph["firmware/drive/drive.c"], "a port's function"
    assert list(upwards(graph, C_LAYERS, "/")) == []


def test_no_modules_call_each_other_in_a_circle() -> None:
    graph = {name: called for name, called in modules(calls(ROOT)).items() if not name.startswith(WIRED_IN_CIRCLES)}
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


def write_module(root: Path, module: str, function: str, body: str) -> None:
    """A module of one function, which takes and returns an int."""
    (root / module).parent.mkdir(parents=True, exist_ok=True)
    headers = "".join(f'#include "{name}"\n' for name in ("rig/b.h", "plant/a.h"))
    (root / f"{module}.h").write_text(f"int {function}(int value);\n")
    (root / f"{module}.c").write_text(f"{headers}\nint {function}(int value) {{\n    {body}\n}}\n")


@pytest.mark.parametrize(("body", "found"), [
    ("return b_step(value);", ["emulator/plant/a.c -> emulator/rig/b.c"]),
    ("static int (*const step)(int value) = b_step;\n    return step(value);",
     ["emulator/plant/a.c -> emulator/rig/b.c"]),
    ("return value; /* not b_step(value) */", []),
    ('return "b_step(value)"[value];', []),
    ("return state.b_step;", []),
])
def test_call_of_a_higher_layer_is_found(tmp_path: Path, body: str, found: list[str]) -> None:
    write_module(tmp_path, "emulator/plant/a", "a_step", body)
    write_module(tmp_path, "emulator/rig/b", "b_step", "return value;")
    assert list(upwards(calls(tmp_path), C_LAYERS, "/")) == found


def test_call_of_the_hal_is_no_call_of_its_port(tmp_path: Path) -> None:
    write_module(tmp_path, "emulator/plant/a", "a_step", "return b_step(value);")
    write_module(tmp_path, "emulator/rig/b", "b_step", "return value;")
    (tmp_path / "hal").mkdir()
    (tmp_path / "emulator/rig/b.h").rename(tmp_path / "hal/b.h")
    source = tmp_path / "emulator/plant/a.c"
    source.write_text(source.read_text().replace("rig/b.h", "b.h"))
    assert calls(tmp_path)["emulator/plant/a.c"] == {"hal/b.h"}


def test_circle_of_calls_is_found(tmp_path: Path) -> None:
    write_module(tmp_path, "emulator/plant/a", "a_step", "return b_step(value);")
    write_module(tmp_path, "emulator/rig/b", "b_step", "return a_step(value);")
    assert set(circle(modules(calls(tmp_path)))) == {"emulator/plant/a", "emulator/rig/b"}


def test_circle_through_a_header_is_found(tmp_path: Path) -> None:
    write_module(tmp_path, "emulator/rig/b", "b_step", "return a_step(value);")
    write_module(tmp_path, "emulator/plant/a", "a_step", "return value;")
    with (tmp_path / "emulator/plant/a.h").open("a") as header:
        header.write('#include "rig/b.h"\nstatic inline int a_twice(int value) {\n    return 2 * b_step(value);\n}\n')
    graph = calls(tmp_path)
    assert list(upwards(graph, C_LAYERS, "/")) == ["emulator/plant/a.h -> emulator/rig/b.c"]
    assert set(circle(modules(graph))) == {"emulator/plant/a", "emulator/rig/b"}


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
