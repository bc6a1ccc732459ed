"""Facts about the control flow that machine code does not show: bounds of loops and infeasible paths, each with its
reason. tests/target/bounds.toml states them; its head describes the format."""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated

from pydantic import Field

from salient.elf import ElfImage
from salient.errors import UsageError
from salient.paths import ROOT
from salient.target.c_loops import loop_statements
from salient.toml_file import Table, TextFileError, checked, read_toml, validate

FILE = ROOT / "tests" / "target" / "bounds.toml"

_Text = Annotated[str, checked("a text", lambda value: bool(value.strip()))]


class LoopFact(Table):
    """Bound of a loop of `file`; `statement` is a part of its `for (...)` or `while (...)`, or the assignment of a
    structure, with its semicolon, that the compiler makes a loop. iterations: of the body of a counted loop, which
    always ends by its count; tests: evaluations of the condition of a search. Of several facts about a loop the first
    one that holds in the configuration applies."""

    file: _Text
    statement: _Text
    reason: _Text
    iterations: str | None = None
    tests: str | None = None
    configurations: list[str] | None = None


class LibraryFact(Table):
    """Bounds of the loops of a function without source, in the order of their addresses: executions of the first
    block."""

    function: _Text
    tests: list[str]
    reason: _Text


class NeverFact(Table):
    """Functions that do not run in some configurations."""

    functions: list[str]
    configurations: list[str]
    reason: _Text


class ExclusiveFact(Table):
    """Functions of which none runs in an interrupt in which one of `functions` runs."""

    functions: list[str]
    excludes: list[str]
    reason: _Text
    configurations: list[str] | None = None


class AtMostFact(Table):
    """Maximum number of executions of a function in an interrupt."""

    function: _Text
    times: str
    reason: _Text
    configurations: list[str] | None = None


class Facts(Table):
    """Content of the file."""

    loop: list[LoopFact] = Field(default_factory=list)
    library: list[LibraryFact] = Field(default_factory=list)
    never: list[NeverFact] = Field(default_factory=list)
    exclusive: list[ExclusiveFact] = Field(default_factory=list)
    at_most: list[AtMostFact] = Field(default_factory=list)


def read_facts(path: Path = FILE, root: Path = ROOT) -> Facts:
    """Reads the facts. UsageError for a mistake in the file, or when a fact names a function or a statement that is
    not in the sources below `root`."""
    try:
        facts = validate(Facts, read_toml(path))
    except TextFileError as error:
        raise UsageError(f"{path}: {error}") from None
    for loop in facts.loop:
        if (loop.iterations is None) == (loop.tests is None):
            raise UsageError(f"{path}: loop {loop.statement}: must have either iterations or tests")
        source = root / loop.file
        text = source.read_text(encoding="utf-8") if source.is_file() else ""
        assignment = loop.statement.endswith(";") and loop.statement in text
        if not assignment and not any(loop.statement in one.head for one in loop_statements(text)):
            raise UsageError(f"{path}: {loop.file} has no loop {loop.statement}")
    named = [name for one in facts.never for name in one.functions]
    named += [name for one in facts.exclusive for name in (*one.functions, *one.excludes)]
    named += [one.function for one in facts.at_most]
    text = "\n".join(source.read_text(encoding="utf-8") for folder in ("firmware", "hal", "tests/target")
                     for source in sorted((root / folder).rglob("*.[ch]")))
    for name in named:
        if not re.search(rf"\b{re.escape(name)}\(", text):
            raise UsageError(f"{path}: no function {name} in the firmware")
    return facts


# --- expressions ----------------------------------------------------------------------------------------------------

_OPERATIONS: dict[type, Callable[[int, int], int]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod}


class Names:
    """Values of the names in bounds: macros of the headers of firmware and HAL that are numbers, and `phases`, the
    number of phases of the machine whose tables are in the image."""

    def __init__(self, image: ElfImage, root: Path = ROOT) -> None:
        self._image = image
        self._root = root

    def value(self, expression: str, **more: int) -> int:
        """Value of an expression of names, whole numbers, +, -, *, //, %; UsageError for anything else."""
        try:
            return self._evaluate(ast.parse(expression, mode="eval").body, more)
        except (SyntaxError, ValueError, KeyError):
            raise UsageError(f"{expression}: must consist of numbers, macros of the firmware, phases and"
                             " + - * // %") from None

    def known(self, name: str) -> bool:
        """True when the name has a value."""
        return name == "phases" or name in self._macros

    def _evaluate(self, node: ast.expr, more: Mapping[str, int]) -> int:
        if isinstance(node, ast.Constant) and type(node.value) is int:
            return node.value
        if isinstance(node, ast.BinOp) and type(node.op) in _OPERATIONS:
            return _OPERATIONS[type(node.op)](self._evaluate(node.left, more), self._evaluate(node.right, more))
        if isinstance(node, ast.Name):
            if node.id in more:
                return more[node.id]
            if node.id == "phases":
                return self._phases
            return self._macros[node.id]
        raise ValueError

    @cached_property
    def _macros(self) -> dict[str, int]:
        headers = [*(self._root / "firmware").rglob("*.h"), *(self._root / "hal").rglob("*.h"),
                   *self._image.path.parents[1].glob("firmware/codec/*.h")]
        found: dict[str, set[int]] = {}
        for header in headers:
            for name, value in re.findall(r"^#define (\w+) \(?(\d+)u?\)?(?=\s|$)",
                                          header.read_text(encoding="utf-8"), re.MULTILINE):
                found.setdefault(name, set()).add(int(value))
        return {name: values.pop() for name, values in found.items() if len(values) == 1}

    @cached_property
    def _phases(self) -> int:
        """First member of machine_tables."""
        address = self._image.symbols().get("machine_tables")
        if address is None:
            raise UsageError(f"{self._image.path}: no machine_tables")
        return self._image.read(address, 1)[0]
