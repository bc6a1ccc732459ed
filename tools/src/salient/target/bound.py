"""Computed bound of an interrupt: the largest number of instructions on any path through its machine code.

Implicit path enumeration (Y.-T. S. Li, S. Malik, "Performance analysis of embedded software using implicit path
enumeration", DAC 1995): the executions of each edge of the control-flow graph are unknowns of an integer program, with
the flow through each block, the bounds of loops and the facts of bound_facts.py as constraints and the number of
instructions as the objective. Every call has its own copy of the callee's graph. Instructions are counted as by
emulator/qemu/instructions.c, from the first one of the handler to its return; those that an IT block skips count.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array

from salient.elf import ElfImage, Instruction, SourceLocation
from salient.errors import UsageError
from salient.paths import ROOT
from salient.target.bound_facts import Facts, LibraryFact, Names
from salient.target.c_loops import LoopStatement, loop_statements
from salient.target.control_flow import Block, ControlFlow, Loop, dominators, loops, place, predecessors

CONTROL = "control_handler"
"""Symbol of the control interrupt's handler; with the suffix _return the symbol of the code after its call."""

_Node = tuple[int, int]
"""Number of a copy of a function, address of a block."""
_Edge = tuple[_Node | None, _Node | None]
"""None: the start or the end of the interrupt."""
_Call = tuple[tuple[str, int], ...]
"""Functions and lines into which a function is inlined."""
_Row = dict[int, float]
"""Coefficients by column."""

_COUNTED_FOR = re.compile(r"\bfor \(\w[\w ]* (\w+) = 0; \1 < (?:\w+(?:->|\.))*(\w+); (?:\1\+\+|\+\+\1)\)")


@dataclass
class _Copy:
    """A function for one call. site: None for the handler."""

    entry: int
    site: _Node | None
    blocks: dict[int, Block]
    size: int | None = None


@dataclass(frozen=True)
class LoopBound:
    """A loop of a copy of a function. times: maximum executions of its first block per entry."""

    copy: int
    loop: Loop
    times: int
    line: str


@dataclass
class _Constraint:
    """low <= coefficients of the edges <= high, in one interrupt. name: for messages."""

    name: str
    row: _Row
    high: float
    low: float = -np.inf


@dataclass(frozen=True)
class Bound:
    """instructions: of the longest path. executed: executions of each instruction on it, by address."""

    instructions: int
    executed: Counter[int]
    model: Model = field(repr=False)

    def by_function(self) -> list[tuple[str, int, int]]:
        """Function, instructions, and executions of the most frequent one; the largest first. Inlined code counts for
        the inlined function."""
        return self._by(lambda here: here.function)

    def by_line(self) -> list[tuple[str, int, int]]:
        """As by_function, by source line."""
        return self._by(lambda here: f"{here.file}:{here.line}")

    def _by(self, name: Callable[[SourceLocation], str]) -> list[tuple[str, int, int]]:
        instructions: Counter[str] = Counter()
        times: dict[str, int] = {}
        for address, count in self.executed.items():
            key = name(self.model.chain(address)[0])
            instructions[key] += count
            times[key] = max(times.get(key, 0), count)
        return [(key, count, times[key]) for key, count in instructions.most_common() if count]


class Model:
    """Integer program of an interrupt.

    configuration: name for the facts that hold in some configurations only. UsageError for a loop without bound, and
    for code of which the flow is unknown.
    """

    def __init__(self, image: ElfImage, facts: Facts, configuration: str, handler: str = CONTROL,
                 root: Path = ROOT) -> None:
        self.image = image
        self._facts = facts
        self._configuration = configuration
        self._root = root
        self._names = Names(image, root)
        self._code = ControlFlow(image)
        symbols = image.symbols()
        for symbol in (handler, f"{handler}_return"):
            if symbol not in symbols:
                raise UsageError(f"{image.path.name}: no symbol {symbol}")
        self._copies: list[_Copy] = []
        self._sources: dict[str, tuple[list[str], list[LoopStatement]]] = {}
        self._dominators: dict[int, dict[int, frozenset[int]]] = {}
        self._expand(symbols[handler], None, ())
        if symbols[f"{handler}_return"] & ~1 not in {
                one.address for block in self._copies[0].blocks.values() for one in block.instructions}:
            raise UsageError(f"{handler} does not reach {handler}_return")
        self._edges: dict[_Edge, int] = {}
        self._into: defaultdict[_Node, list[int]] = defaultdict(list)
        self._out_of: defaultdict[_Node, list[int]] = defaultdict(list)
        self._connect()
        self.loop_bounds: list[LoopBound] = []
        self._constraints = self._flow()
        self._bound_loops()
        self._columns = len(self._edges)
        self._integral = [True] * self._columns
        self._apply_facts()

    # --- graph ------------------------------------------------------------------------------------------------------

    def _expand(self, entry: int, site: _Node | None, above: tuple[int, ...]) -> None:
        if entry in above:
            raise UsageError(f"recursion: {self._code.instruction(entry).function}")
        blocks = _returning(self._code.function(entry))
        if not above and not blocks:
            raise UsageError(f"{self._code.instruction(entry).function} does not return")
        number = len(self._copies)
        size = self._constant_size(site) if site else None
        self._copies.append(_Copy(entry, site, blocks, size))
        for address, block in blocks.items():
            if block.call is not None:
                self._expand(block.call, (number, address), (*above, entry))

    def _connect(self) -> None:
        """Edges, with the calls: from the calling block to the callee, and from its returns to the next block."""
        self._edge(None, (0, self._copies[0].entry))
        for number, copy in enumerate(self._copies):
            back = None
            if copy.site:
                caller, at = copy.site
                self._edge(copy.site, (number, copy.entry))
                back = (caller, self._copies[caller].blocks[at].successors[0])
            for address, block in copy.blocks.items():
                if block.returns:
                    self._edge((number, address), back)
                if block.call is None:
                    for successor in block.successors:
                        if successor in copy.blocks:
                            self._edge((number, address), (number, successor))

    def _edge(self, begin: _Node | None, end: _Node | None) -> None:
        column = self._edges.setdefault((begin, end), len(self._edges))
        if begin is not None:
            self._out_of[begin].append(column)
        if end is not None:
            self._into[end].append(column)

    def _flow(self) -> list[_Constraint]:
        rows = [_Constraint("start", {0: 1.0}, 1.0, 1.0)]
        rows += [_Constraint("flow", {self._edges[copy.site, (number, copy.entry)]: 1.0}, 0.0)
                 for number, copy in enumerate(self._copies) if not copy.blocks]
        for node in self._nodes():
            row: defaultdict[int, float] = defaultdict(float)
            for column in self._into[node]:
                row[column] += 1.0
            for column in self._out_of[node]:
                row[column] -= 1.0
            rows.append(_Constraint("flow", {column: value for column, value in row.items() if value}, 0.0, 0.0))
        return rows

    def _nodes(self) -> Iterable[_Node]:
        for number, copy in enumerate(self._copies):
            for address in copy.blocks:
                yield number, address

    def _block(self, node: _Node) -> Block:
        return self._copies[node[0]].blocks[node[1]]

    @cached_property
    def _chains(self) -> dict[int, list[SourceLocation]]:
        addresses = {one.address for node in self._nodes() for one in self._block(node).instructions}
        return self.image.locations(sorted(addresses))

    @cached_property
    def _nodes_by_function(self) -> defaultdict[str, list[_Node]]:
        """Blocks with an instruction of a function or of what is inlined into it, by the function's name."""
        found: defaultdict[str, list[_Node]] = defaultdict(list)
        for node in self._nodes():
            functions = {here.function for one in self._block(node).instructions for here in self.chain(one.address)}
            for function in functions:
                found[function].append(node)
        return found

    def chain(self, address: int) -> list[SourceLocation]:
        """The location in which an instruction is written, then those into which it is inlined; the function of the
        linker's symbol where the image has no locations."""
        found = self._chains[address]
        if found and found[0].function != "??":
            return found
        return [SourceLocation(self._code.instruction(address).function, "?", 0)]

    # --- loops ------------------------------------------------------------------------------------------------------

    def _bound_loops(self) -> None:
        by_entry: dict[int, list[Loop]] = {}
        for number, copy in enumerate(self._copies):
            if copy.entry not in by_entry:
                outer = loops(copy.entry, copy.blocks)
                by_entry[copy.entry] = [loop for one in outer for loop in one.nest()]
            for loop in by_entry[copy.entry]:
                times, line = self._times(copy, loop, by_entry[copy.entry])
                self.loop_bounds.append(LoopBound(number, loop, times, line))
                row: defaultdict[int, float] = defaultdict(float)
                for column in self._columns_of(number, loop.repeats):
                    row[column] += 1.0
                begins = [self._edges[copy.site, (number, copy.entry)]] if loop.at_entry else []
                for column in (*self._columns_of(number, loop.entries), *begins):
                    row[column] -= times - 1.0
                self._constraints.append(_Constraint(f"loop at {line}", dict(row), 0.0))

    def _columns_of(self, copy: int, edges: Iterable[tuple[int, int]]) -> list[int]:
        """Columns of edges within a copy; an edge after a call is counted at the call."""
        columns: list[int] = []
        for begin, end in edges:
            if self._copies[copy].blocks[begin].call is None:
                columns.append(self._edges[(copy, begin), (copy, end)])
            else:
                columns += self._into[copy, begin]
        return columns

    def _times(self, copy: _Copy, loop: Loop, of_function: list[Loop]) -> tuple[int, str]:
        """Executions of the loop's first block per entry, and its source line."""
        function = self._code.instruction(copy.entry).function
        lines = self._lines(copy, loop)
        statements = [self._statement(*line, lines) for line in dict.fromkeys(lines[:len(loop.repeats)])]
        found = [(times, statement) for file, statement in statements
                 if (times := self._source_times(copy, file, statement, loop)) is not None]
        if found and len(found) == len(statements):
            times, statement = max(found, key=lambda one: one[0])
            return times, f"{lines[0][0]}:{statement.first}"
        for library in self._facts.library:
            if library.function == function:
                return self._library_times(copy, loop, of_function, library), function
        where = ", ".join(dict.fromkeys(f"{file}:{statement.first}" for file, statement in statements))
        raise UsageError(f"{self.image.path.name}: {function}: the loop at {where} has no bound: state one in"
                         " tests/target/bounds.toml")

    def _lines(self, copy: _Copy, loop: Loop) -> list[tuple[str, int]]:
        """Source lines of the instructions of a loop, its closing branches' first, without inner loops, in the
        function in which the loop is written: the innermost one, inlined or not, that has all of them."""
        closing = [copy.blocks[begin].instructions[-1] for begin, _ in loop.repeats]
        others = [one for address in sorted(loop.own) for one in copy.blocks[address].instructions]
        stacks = [list(reversed(self.chain(one.address))) for one in (*closing, *others)]
        depth = 0
        while all(len(stack) > depth + 1 and stack[depth] == stacks[0][depth]
                  and stack[depth + 1].function == stacks[0][depth + 1].function for stack in stacks):
            depth += 1
        return [(stack[depth].file, stack[depth].line) for stack in stacks]

    def _statement(self, file: str, line: int, lines: list[tuple[str, int]]) -> tuple[str, LoopStatement]:
        """The loop statement to which a closing branch on a line belongs: the innermost one around it that has all
        `lines` that are in the outermost one around it. A line that is in no loop statement stands for itself."""
        if file not in self._sources:
            path = self._root / file
            text = path.read_text(encoding="utf-8") if path.is_file() else ""
            self._sources[file] = text.splitlines(), loop_statements(text) if path.suffix in (".c", ".h") else []
        text_lines, statements = self._sources[file]
        around = [one for one in statements if one.first <= line <= one.last]
        if not around:
            return file, LoopStatement(line, line, text_lines[line - 1] if 0 < line <= len(text_lines) else "")
        nest = {number for name, number in lines if name == file and around[0].first <= number <= around[0].last}
        return file, next(one for one in reversed(around) if all(one.first <= number <= one.last for number in nest))

    def _source_times(self, copy: _Copy, file: str, statement: LoopStatement, loop: Loop) -> int | None:
        """Bound by a fact about a loop statement, or by the statement itself if it is a counted `for`."""
        fact = next((one for one in self._facts.loop if one.file == file and one.statement in statement.head
                     and self._holds(one.configurations)), None)
        if fact is not None and fact.tests is not None:
            return self._value(copy, fact.tests)
        iterations = fact.iterations if fact is not None else None
        counted = _COUNTED_FOR.search(statement.head)
        if iterations is None and counted and (counted[2].isdigit() or self._names.known(counted[2])):
            iterations = counted[2]
        if iterations is None:
            return None
        return self._value(copy, iterations) + (0 if loop.bottom_tested else 1)

    def _value(self, copy: _Copy, expression: str) -> int:
        """Value of a bound for a call."""
        if not re.search(r"\bsize\b", expression):
            return self._names.value(expression)
        if copy.size is None:
            site = place(self._block(copy.site).instructions[-1]) if copy.site else "the handler"
            raise UsageError(f"{self._code.instruction(copy.entry).function}: {site}: its size is no constant")
        return self._names.value(expression, size=copy.size)

    def _library_times(self, copy: _Copy, loop: Loop, of_function: list[Loop], library: LibraryFact) -> int:
        if len(library.tests) != len(of_function):
            raise UsageError(f"tests/target/bounds.toml: {library.function} has {len(of_function)} loops, not"
                             f" {len(library.tests)}")
        return self._value(copy, library.tests[sorted(one.header for one in of_function).index(loop.header)])

    def _constant_size(self, site: _Node) -> int | None:
        """Constant third argument of the call at the end of a block."""
        register = "a2" if self.image.is_riscv else "r2"
        for one in reversed(self._block(site).instructions[:-1]):
            constant = re.fullmatch(rf"{register},\s*#?(0x[0-9a-f]+|[0-9]+)", one.operands.partition("@")[0].strip())
            if constant and one.mnemonic.partition(".")[0] in ("mov", "movs", "movw", "li"):
                return int(constant[1], 0)
            if re.search(rf"\b{register}\b", one.operands):
                return None
        return None

    # --- facts ------------------------------------------------------------------------------------------------------

    def _apply_facts(self) -> None:
        for never in self._facts.never:
            if self._holds(never.configurations):
                for function in never.functions:
                    for nodes in self._copies_of(function):
                        for node in nodes:
                            self._constraints.append(_Constraint(f"never {function}", self._count(node), 0.0))
        for most in self._facts.at_most:
            if self._holds(most.configurations):
                executions = self._executions(most.function)
                if executions:
                    self._constraints.append(_Constraint(f"at most {most.times} times {most.function}",
                                                         dict.fromkeys(executions, 1.0), self._names.value(most.times)))
        for exclusive in self._facts.exclusive:
            if self._holds(exclusive.configurations):
                name = f"{', '.join(exclusive.functions)} exclude {', '.join(exclusive.excludes)}"
                others = [self._switch(other, name) for other in exclusive.excludes]
                for function in exclusive.functions:
                    runs = self._switch(function, name)
                    self._constraints += [_Constraint(name, {runs: 1.0, other: 1.0}, 1.0) for other in others]

    def _switch(self, function: str, name: str) -> int:
        """Column that is 1 if a function runs, else 0 or 1."""
        switch = self._column(integral=True)
        for nodes in self._copies_of(function):
            for node in nodes:
                self._constraints.append(_Constraint(name, {**self._count(node), switch: -self._most(node)}, 0.0))
        return switch

    def _holds(self, configurations: list[str] | None) -> bool:
        return configurations is None or self._configuration in configurations

    def _column(self, integral: bool) -> int:
        self._integral.append(integral)
        self._columns += 1
        return self._columns - 1

    def _count(self, node: _Node) -> _Row:
        """Executions of a block."""
        return dict.fromkeys(self._into[node], 1.0)

    def _copies_of(self, function: str) -> list[list[_Node]]:
        """Blocks that are executed only if a function is, by call of the function, inlined or not.

        All instructions of such a block belong to the function or to what is inlined into it: one that the compiler has
        mixed with others may be executed without it. Of these blocks some may be shared, because the compiler merges
        equal ends of functions and attributes them to one of them (_certain).
        """
        found: defaultdict[tuple[int, _Call], list[_Node]] = defaultdict(list)
        mixed: defaultdict[tuple[int, _Call], set[int]] = defaultdict(set)
        for node in self._nodes_by_function[function]:
            calls = {_call_of(function, self.chain(one.address)) for one in self._block(node).instructions}
            for call in calls - {None}:
                assert call is not None
                if len(calls) == 1:
                    found[node[0], call].append(node)
                else:
                    mixed[node[0], call].add(node[1])
        return [self._certain(nodes, mixed[key]) for key, nodes in found.items()]

    def _certain(self, nodes: list[_Node], mixed: set[int]) -> list[_Node]:
        """The blocks of a call that are not shared: those dominated by the one that dominates most of them, and those
        that are reached only from such blocks or from blocks in which the call is mixed with others."""
        number = nodes[0][0]
        copy = self._copies[number]
        if copy.entry not in self._dominators:
            self._dominators[copy.entry] = dominators(copy.entry, copy.blocks)
        dominated_by = self._dominators[copy.entry]
        most = Counter(above for _, address in nodes for above in dominated_by[address])
        entry = max((address for _, address in nodes), key=lambda address: most[address])
        certain = {address for _, address in nodes}
        before = predecessors(copy.blocks)
        while shared := {address for address in certain if entry not in dominated_by[address]
                         and any(one not in certain and one not in mixed for one in before[address])}:
            certain -= shared
        return [(number, address) for address in sorted(certain)]

    def _executions(self, function: str) -> list[int]:
        """One column for each call of a function, not below its number of executions: a block in a loop of the function
        is executed as often as the loop permits in each of them."""
        columns = []
        for nodes in self._copies_of(function):
            column = self._column(integral=False)
            columns.append(column)
            inside = set(nodes)
            for node in nodes:
                times = 1
                for bound in self._around(node):
                    if (bound.copy, bound.loop.header) in inside:
                        times *= bound.times
                self._constraints.append(
                    _Constraint(f"executions of {function}", {**self._count(node), column: -times}, 0.0))
        return columns

    def _around(self, node: _Node) -> list[LoopBound]:
        return [bound for bound in self.loop_bounds if bound.copy == node[0] and node[1] in bound.loop.blocks]

    def _most(self, node: _Node) -> int:
        """Upper limit of the executions of a block by the loops around it and around its callers."""
        site = self._copies[node[0]].site
        times = self._most(site) if site else 1
        for bound in self._around(node):
            times *= bound.times
        return times

    # --- solution ---------------------------------------------------------------------------------------------------

    def solve(self) -> Bound:
        """The longest path. UsageError when no path satisfies the facts."""
        weights = np.zeros(self._columns)
        for node in self._nodes():
            weights[self._into[node]] -= len(self._block(node).instructions)
        result = self._optimise(weights, self._constraints, integral=True)
        if result is None:
            raise UsageError(f"{self.image.path.name}, {self._configuration}: no path satisfies the facts")
        executed: Counter[int] = Counter()
        for node in self._nodes():
            times = round(float(result[self._into[node]].sum()))
            for one in self._block(node).instructions:
                executed[one.address] += times
        return Bound(executed.total(), executed, self)

    def contradiction(self, executed: Mapping[int, int], interrupts: int = 1) -> str | None:
        """Compares the model with executions of each instruction, by address, in a number of interrupts together: None
        when paths of the model add up to them, else the part of the model that they violate. With one interrupt the
        comparison is exact, with several it is a comparison of their mean."""
        blocks: defaultdict[tuple[Instruction, ...], list[_Node]] = defaultdict(list)
        for node in self._nodes():
            blocks[self._block(node).instructions].append(node)
        known = {one.address for instructions in blocks for one in instructions}
        for address, times in executed.items():
            if times and address not in known:
                return f"{place(self._code.instruction(address))}: executed, and on no path"
        every = [_Constraint(one.name, one.row, one.high * interrupts, one.low * interrupts)
                 for one in self._constraints]
        for instructions, nodes in blocks.items():
            times = executed.get(instructions[0].address, 0)
            if any(executed.get(one.address, 0) != times for one in instructions):
                return f"{place(instructions[0])}: a block of which only a part was executed"
            row: defaultdict[int, float] = defaultdict(float)
            for column in (column for node in nodes for column in self._into[node]):
                row[column] += 1.0
            every.append(_Constraint("observed", dict(row), times, times))
        nothing = np.zeros(self._columns)
        if self._optimise(nothing, every, integral=interrupts == 1) is not None:
            return None
        for name in dict.fromkeys(one.name for one in every if one.name not in ("start", "flow", "observed")):
            without = [one for one in every if one.name != name]
            if self._optimise(nothing, without, integral=interrupts == 1) is not None:
                return name
        return "the control flow"

    def _optimise(self, weights: np.ndarray, constraints: list[_Constraint], integral: bool) -> np.ndarray | None:
        entries = [(i, column, value) for i, one in enumerate(constraints) for column, value in one.row.items()]
        rows, columns, values = zip(*entries, strict=True)
        matrix = coo_array((values, (rows, columns)), shape=(len(constraints), self._columns)).tocsr()
        limits = LinearConstraint(matrix, [one.low for one in constraints], [one.high for one in constraints])
        result = milp(weights, constraints=limits, bounds=Bounds(0, np.inf),
                      integrality=np.array(self._integral, dtype=int) if integral else None)
        if result.status == 3:
            raise UsageError(f"{self.image.path.name}: the number of instructions has no bound")
        return result.x if result.success else None


def _call_of(function: str, chain: list[SourceLocation]) -> _Call | None:
    """The call of a function that an instruction belongs to: the places in which it is inlined; None if to none."""
    for level, here in enumerate(chain):
        if here.function == function:
            return tuple((outer.function, outer.line) for outer in chain[level + 1:])
    return None


def _returning(blocks: Mapping[int, Block]) -> dict[int, Block]:
    """The blocks from which the function can return: an interrupt that does not return has no duration."""
    before = predecessors(blocks)
    waiting = [address for address, block in blocks.items() if block.returns]
    found = set(waiting)
    while waiting:
        for address in before[waiting.pop()]:
            if address not in found:
                found.add(address)
                waiting.append(address)
    return {address: block for address, block in blocks.items() if address in found}
