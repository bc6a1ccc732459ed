"""Control-flow graph of the machine code of an image: blocks of instructions, their successors and calls, and loops."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from salient.elf import ElfImage, Instruction
from salient.errors import UsageError


@dataclass(frozen=True)
class Block:
    """Consecutive instructions that are executed together. Addresses: successors are the first instructions of the
    blocks that may follow in the same function, after the call if the block ends with one; call is the function called.
    returns: the block may leave the function. Instructions that an IT block skips belong to the block, as QEMU's blocks
    contain them too."""

    instructions: tuple[Instruction, ...]
    successors: tuple[int, ...]
    call: int | None
    returns: bool

    @property
    def address(self) -> int:
        return self.instructions[0].address


@dataclass(frozen=True)
class Flow:
    """Continuation of one instruction: as the fields of Block. next: addresses; empty and no return: it never ends."""

    next: tuple[int, ...]
    call: int | None = None
    returns: bool = False


class ControlFlow:
    """Blocks and loops of the functions of an image, by address of their first instruction; decoded when needed.

    UsageError for code of which the flow is unknown: calls through pointers, recursion, jumps into data.
    """

    def __init__(self, image: ElfImage) -> None:
        self.image = image
        instructions = image.instructions()
        self._at = {one.address: one for one in instructions}
        self._following = dict(zip(self._at, list(self._at)[1:], strict=False))
        self._order = list(self._at)
        self._decode = _riscv if image.is_riscv else _thumb
        self._functions: dict[int, dict[int, Block]] = {}

    def instruction(self, address: int) -> Instruction:
        """The instruction at an address; UsageError when there is none."""
        if address not in self._at:
            raise UsageError(f"{self.image.path.name}: a jump to {address:#x}, which is not an instruction")
        return self._at[address]

    def has(self, address: int) -> bool:
        """True when an instruction begins at an address."""
        return address in self._at

    def before(self, address: int, count: int) -> list[Instruction]:
        """The instructions before an address in the image, nearest first."""
        index = self._order.index(address)
        return [self._at[previous] for previous in reversed(self._order[max(0, index - count): index])]

    def following(self, address: int) -> int:
        """Address of the next instruction in memory, data skipped."""
        return self._following[address]

    def falls_to(self, one: Instruction) -> int:
        """Address of the instruction after one in memory."""
        following = self._following.get(one.address)
        if following is None or following - one.address not in (2, 4):
            raise UsageError(f"{place(one)}: execution continues in data")
        return following

    def function(self, entry: int) -> dict[int, Block]:
        """Blocks reachable from an entry without calls, by address; functions that it jumps to are part of it."""
        if entry not in self._functions:
            self._functions[entry] = self._blocks(entry)
        return self._functions[entry]

    def _blocks(self, entry: int) -> dict[int, Block]:
        flows: dict[int, Flow] = {}
        leaders, waiting = {entry}, [entry]
        while waiting:
            address = waiting.pop()
            if address in flows:
                continue
            one = self.instruction(address)
            flow = flows[address] = self._decode(self, one)
            if flow.call is not None or flow.returns or flow.next != (self._following.get(address),):
                leaders.update(flow.next)
            waiting += flow.next
        blocks = {}
        for leader in leaders:
            body, flow = [self._at[leader]], flows[leader]
            while flow.call is None and not flow.returns and len(flow.next) == 1 and flow.next[0] not in leaders:
                body.append(self._at[flow.next[0]])
                flow = flows[flow.next[0]]
            blocks[leader] = Block(tuple(body), flow.next, flow.call, flow.returns)
        return blocks


def place(one: Instruction) -> str:
    """An instruction for messages."""
    return f"{one.function}: {one.address:x}: {one.mnemonic} {one.operands}".strip()


# --- decoding -------------------------------------------------------------------------------------------------------

_TARGET = re.compile(r"\b([0-9a-f]+) <")
_CONDITIONS = "eq|ne|cs|hs|cc|lo|mi|pl|vs|vc|hi|ls|ge|lt|gt|le"


def _target(one: Instruction) -> int:
    found = _TARGET.search(one.operands)
    if not found:
        raise UsageError(f"{place(one)}: the target is unknown")
    return int(found[1], 16)


_THUMB_BRANCH = re.compile(rf"b({_CONDITIONS})?|cbn?z")
_THUMB_CALL = re.compile(rf"bl({_CONDITIONS})?")
_THUMB_POP = re.compile(rf"(?:pop|ldmia|ldr)({_CONDITIONS})?")
_THUMB_WRITES_PC = re.compile(r"pc\b|.*\{[^}]*\bpc\}")
_THUMB_READS_FIRST = re.compile(r"(?:cmp|cmn|tst|teq|str|stm|push|tb[bh])")


def _thumb(code: ControlFlow, one: Instruction) -> Flow:
    """Armv7-M, in the disassembly's unified syntax."""
    mnemonic = one.mnemonic.partition(".")[0]
    if branch := _THUMB_BRANCH.fullmatch(mnemonic):
        always = mnemonic == "b" and not branch[1]
        return Flow((_target(one),) if always else _unique(_target(one), code.falls_to(one)))
    if call := _THUMB_CALL.fullmatch(mnemonic):
        if call[1]:
            raise UsageError(f"{place(one)}: conditional calls are not supported")
        return Flow((code.falls_to(one),), call=_target(one))
    if mnemonic in ("tbb", "tbh"):
        return Flow(_thumb_table(code, one, 1 if mnemonic == "tbb" else 2))
    if found := re.fullmatch(rf"bx({_CONDITIONS})?", mnemonic):
        if one.operands != "lr":
            raise UsageError(f"{place(one)}: a jump through a pointer has no bound")
        return Flow((code.falls_to(one),) if found[1] else (), returns=True)
    if mnemonic.startswith("blx"):
        raise UsageError(f"{place(one)}: a call through a pointer has no bound")
    if _THUMB_WRITES_PC.match(one.operands) and not _THUMB_READS_FIRST.match(mnemonic):
        pop = _THUMB_POP.fullmatch(mnemonic)
        if not pop or (mnemonic != "pop" + (pop[1] or "") and not re.search(r"\bsp!|\[sp\], #", one.operands)):
            raise UsageError(f"{place(one)}: a jump through a pointer has no bound")
        return Flow((code.falls_to(one),) if pop[1] else (), returns=True)
    if mnemonic == "udf":
        return Flow(())
    return Flow((code.falls_to(one),))


_THUMB_INDEX = re.compile(r"\[pc, (r\d+)")


def _thumb_table(code: ControlFlow, one: Instruction, width: int) -> tuple[int, ...]:
    """Targets of tbb and tbh. The table is the data between the instruction and the next one, with padding of 0, or as
    much of it as the index, compared before, reaches: constants may follow in the same gap."""
    base, end = one.address + 4, code.following(one.address)
    largest = _thumb_index_max(code, one)
    if largest is not None:
        end = min(end, base + width * (largest + 1))
    entries = (int.from_bytes(code.image.read(at, width), "little") for at in range(base, end - width + 1, width))
    return _unique(*(base + 2 * entry for entry in entries if entry))


def _thumb_index_max(code: ControlFlow, one: Instruction) -> int | None:
    """N of `cmp index, #N` and `bhi` immediately before a jump by table."""
    index = _THUMB_INDEX.match(one.operands)
    branch, compared = code.before(one.address, 2)
    limit = re.fullmatch(rf"{index[1]}, #(\d+)(?:\s.*)?", compared.operands) if index else None
    is_limit = limit and re.fullmatch(r"bhi(\.[nw])?", branch.mnemonic) and compared.mnemonic in ("cmp", "cmp.w")
    return int(limit[1]) if limit and is_limit else None


_RISCV_BRANCH = re.compile(r"b(eq|ne|lt|ge|gt|le)(u|z)?")
_RISCV_ANNOTATED = re.compile(r"#\s*([0-9a-f]+) <")


def _riscv(code: ControlFlow, one: Instruction) -> Flow:  # noqa: PLR0911 - a return for each kind of instruction
    """RV32IMAC, with the disassembler's pseudo-instructions."""
    mnemonic = one.mnemonic
    if _RISCV_BRANCH.fullmatch(mnemonic):
        return Flow(_unique(_target(one), code.falls_to(one)))
    if mnemonic == "j":
        return Flow((_target(one),))
    if mnemonic in ("ret", "mret"):
        return Flow((), returns=True)
    if mnemonic == "jal":
        return Flow((code.falls_to(one),), call=_target(one))
    if mnemonic == "jalr":
        annotated = _RISCV_ANNOTATED.search(one.operands)
        if not annotated:
            raise UsageError(f"{place(one)}: a call through a pointer has no bound")
        return Flow((code.falls_to(one),), call=int(annotated[1], 16))
    if mnemonic == "jr":
        if annotated := _RISCV_ANNOTATED.search(one.operands):
            return Flow((int(annotated[1], 16),))
        return Flow(_riscv_table(code, one))
    if mnemonic in ("ebreak", "unimp"):
        return Flow(())
    return Flow((code.falls_to(one),))


def _riscv_table(code: ControlFlow, one: Instruction) -> tuple[int, ...]:
    """Targets of the jump table of a switch: words at an address that the instructions before build from constants,
    as many of them as are addresses of the same function or its cold part. The next words of the image may be such
    addresses too, then the bound only becomes larger."""
    base = _riscv_table_address(code, one)
    own = one.function.partition(".cold")[0]
    targets: list[int] = []
    while True:
        target = int.from_bytes(code.image.read(base + 4 * len(targets), 4), "little")
        if not code.has(target) or code.instruction(target).function.partition(".cold")[0] != own:
            break
        targets.append(target)
    if not targets:
        raise UsageError(f"{place(one)}: a jump through a pointer has no bound")
    return _unique(*targets)


_RISCV_OPERANDS = re.compile(r"[,()\s]+")
_NUMBER = re.compile(r"-?(?:0x[0-9a-f]+|[0-9]+)")
_RISCV_SEARCHED = 24
"""Instructions before a jump in which its table's address is made."""


def _riscv_table_address(code: ControlFlow, one: Instruction) -> int:
    """lw before the jump reads from the sum of a scaled index and the table's address."""
    earlier = code.before(one.address, _RISCV_SEARCHED)
    for i, load in enumerate(earlier):
        words = _RISCV_OPERANDS.split(load.operands)
        if words[0] == one.operands.strip():
            address = _riscv_constant(words[2], earlier[i + 1:]) if load.mnemonic == "lw" else None
            if address is not None:
                return (address + int(words[1], 0)) & 0xFFFFFFFF
            break
    raise UsageError(f"{place(one)}: a jump through a pointer has no bound")


def _riscv_constant(register: str, earlier: list[Instruction]) -> int | None:
    """The constant in a register, or in a sum the constant summand; earlier: instructions before, nearest first."""
    for i, one in enumerate(earlier):
        text, _, _ = one.operands.partition("#")
        words = _RISCV_OPERANDS.split(text.strip())
        if words[0] != register:
            continue
        if annotated := _RISCV_ANNOTATED.search(one.operands):
            return int(annotated[1], 16)
        if one.mnemonic == "lui":
            return int(words[1], 0) << 12
        if one.mnemonic in ("addi", "add") and _NUMBER.fullmatch(words[2]):
            value = _riscv_constant(words[1], earlier[i + 1:])
            return None if value is None else value + int(words[2], 0)
        if one.mnemonic == "add":
            values = [_riscv_constant(word, earlier[i + 1:]) for word in words[1:]]
            return next((value for value in values if value is not None), None)
        return None
    return None


def _unique(*addresses: int) -> tuple[int, ...]:
    return tuple(dict.fromkeys(addresses))


# --- loops ----------------------------------------------------------------------------------------------------------

@dataclass
class Loop:
    """A strongly connected part of a function. Edges are pairs of block addresses. entries: from outside; repeats: from
    inside to `header`. at_entry: the function begins in the loop, which is one more entry for each call. bottom_tested:
    it is left only from blocks that may also repeat it."""

    header: int
    blocks: frozenset[int]
    entries: list[tuple[int, int]]
    repeats: list[tuple[int, int]]
    at_entry: bool
    bottom_tested: bool
    inner: list[Loop] = field(default_factory=list)

    @property
    def own(self) -> frozenset[int]:
        """Blocks that belong to no inner loop."""
        return self.blocks.difference(*(inner.blocks for inner in self.inner))

    def nest(self) -> Iterator[Loop]:
        """The loop and all its inner loops, inner loops first."""
        for inner in self.inner:
            yield from inner.nest()
        yield self


def loops(entry: int, blocks: Mapping[int, Block]) -> list[Loop]:
    """Outermost loops of a function, with their inner loops."""
    edges = {address: {one for one in block.successors if one in blocks} for address, block in blocks.items()}
    returning = {address for address, block in blocks.items() if block.returns}
    return _loops(entry, set(blocks), edges, returning)


def _loops(entry: int, nodes: set[int], edges: Mapping[int, set[int]], returning: set[int]) -> list[Loop]:
    found = []
    for part in _components(nodes, edges):
        inside = [(a, b) for a in part for b in edges[a] if b in part]
        if not inside:
            continue
        entries = [(a, b) for a in edges if a not in part for b in edges[a] if b in part]
        heads = {b for _, b in entries} | ({entry} & part)
        header = min(heads)
        repeats = [edge for edge in inside if edge[1] == header]
        latches = {a for a, _ in repeats}
        loop = Loop(header, frozenset(part), entries, repeats, entry in part,
                    all(a in latches for a in part if edges[a] - part or a in returning))
        reduced = {a: {b for b in edges[a] if (a, b) not in repeats} for a in edges}
        loop.inner = _loops(entry, part, reduced, returning)
        found.append(loop)
    return found


def predecessors(blocks: Mapping[int, Block]) -> dict[int, list[int]]:
    """For each block those after which it may follow."""
    before: dict[int, list[int]] = {address: [] for address in blocks}
    for address, block in blocks.items():
        for successor in block.successors:
            if successor in before:
                before[successor].append(address)
    return before


def dominators(entry: int, blocks: Mapping[int, Block]) -> dict[int, frozenset[int]]:
    """For each block the blocks that lie on every path to it from the entry, with itself."""
    before = predecessors(blocks)
    every = frozenset(blocks)
    found = dict.fromkeys(blocks, every) | {entry: frozenset((entry,))}
    changed = True
    while changed:
        changed = False
        for address in blocks:
            if address != entry:
                common = frozenset.intersection(every, *(found[one] for one in before[address])) | {address}
                changed |= common != found[address]
                found[address] = common
    return found


def _components(nodes: Iterable[int], edges: Mapping[int, set[int]]) -> list[set[int]]:
    """Strongly connected components."""
    addresses = sorted(nodes)
    index = {address: i for i, address in enumerate(addresses)}
    rows, columns = [], []
    for address in addresses:
        for successor in edges[address] & index.keys():
            rows.append(index[address])
            columns.append(index[successor])
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(len(addresses), len(addresses)))
    count, labels = connected_components(graph, connection="strong")
    found: list[set[int]] = [set() for _ in range(count)]
    for address, label in zip(addresses, labels, strict=True):
        found[label].add(address)
    return found
