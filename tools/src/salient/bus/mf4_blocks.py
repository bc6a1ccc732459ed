"""Blocks of an MF4 file (ASAM MDF 4): the links between them, texts, and data blocks of any kind as a stream of bytes.

Sizes and links come from a file that may be damaged: nothing is read twice, followed in a circle, or made of a size
that the file merely states.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import IO

from salient.bus.log_input import Damage

_HEAD = struct.Struct("<4s4xQQ")
FIRST_BLOCK = 64
_LINKS_MAX = 1 << 16
_TEXT_MAX = 1 << 16
_INFLATED_MAX = 1 << 26
"""Bytes of a compressed block; the standard has 4 MiB."""
_PIECE = 1 << 18
_COMPRESSED_PIECE = 1 << 12
"""Bytes decompressed at a time: before an error all is kept but for a piece."""
_DATA = (b"##DT", b"##SD", b"##RD", b"##DV")
_UNFINISHED_LENGTH = 4
"""Flag of a file that is not finished: the last data block reaches to the end of the file."""


@dataclass(frozen=True)
class Block:
    """A block: where it begins, its four letters, its links, and the bytes after them."""

    address: int
    kind: bytes
    links: tuple[int, ...]
    content: bytes

    def link(self, index: int) -> int:
        """A link, 0 where the block has fewer."""
        return self.links[index] if index < len(self.links) else 0

    def unpack(self, form: str) -> tuple[int, ...]:
        """Members at the beginning of the content. Damage: it is shorter."""
        if len(self.content) < struct.calcsize(form):
            raise Damage(f"byte {self.address}: a block of {len(self.content)} bytes of content")
        members: tuple[int, ...] = struct.unpack_from(form, self.content)
        return members


class Blocks:
    """The blocks of a file. unfinished: flags of a file whose writer did not end."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        self._size = stream.seek(0, 2)
        stream.seek(0)
        identification = stream.read(FIRST_BLOCK)
        if len(identification) < FIRST_BLOCK or identification[:8].strip() not in (b"MDF", b"UnFinMF"):
            raise Damage("byte 0: no header of MF4")
        if identification[8:9] != b"4":
            raise Damage("byte 8: no version 4 of MDF")
        is_finished = identification[:8].strip() == b"MDF"
        self.unfinished = 0 if is_finished else int.from_bytes(identification[60:62], "little")
        self._used: set[int] = set()

    def _head(self, address: int) -> tuple[bytes, int, int]:
        """Kind, length and number of links. Damage: no block begins there."""
        self._stream.seek(min(address, self._size))  # a link of 64 bits may lead beyond what a file can have
        head = self._stream.read(_HEAD.size)
        if len(head) < _HEAD.size:
            raise Damage(f"truncated: byte {address}: a block begins there, the file has {self._size} bytes")
        kind, length, count = _HEAD.unpack(head)
        if not kind.startswith(b"##") or count > _LINKS_MAX or length < _HEAD.size + 8 * count:
            raise Damage(f"byte {address}: no block of MF4 begins there")
        return kind, length, count

    def _use(self, address: int) -> None:
        """Damage: the block was there before; no two links to be followed lead to one."""
        if address in self._used:
            raise Damage(f"byte {address}: a second link leads to the block")
        self._used.add(address)

    def read(self, address: int, *kinds: bytes, is_shared: bool = False, most: int = 1 << 20) -> Block:
        """A block of one of some kinds. is_shared: several links may lead to it. Damage."""
        kind, length, count = self._head(address)
        if kind not in kinds:
            raise Damage(f"byte {address}: a block {kind[2:].decode('latin-1')!r:.6} instead of "
                         f"{kinds[0][2:].decode()!r}")
        if address + length > self._size:
            raise Damage(f"truncated: byte {address}: a block of {length} bytes, the file has {self._size}")
        if not is_shared:
            self._use(address)
        links = struct.unpack(f"<{count}Q", self._stream.read(8 * count))
        return Block(address, kind, links, self._stream.read(min(length - _HEAD.size - 8 * count, most)))

    def chain(self, address: int, kind: bytes) -> Iterator[Block]:
        """A block and those that follow it by their first links. Damage."""
        while address:
            block = self.read(address, kind)
            yield block
            address = block.link(0)

    def text(self, address: int) -> str:
        """The text of a block; several may share one."""
        content = self.read(address, b"##TX", b"##MD", is_shared=True, most=_TEXT_MAX).content
        return content.partition(b"\0")[0].decode("utf-8", errors="replace")

    def data(self, address: int) -> Iterator[bytes]:
        """The bytes of a data block, or of the data blocks of a list. Damage, after what can be read."""
        waiting = [address] if address else []
        while waiting:
            address = waiting.pop()
            kind, length, count = self._head(address)
            if kind in _DATA:
                self._use(address)
                yield from self._plain(address, length, _HEAD.size + 8 * count)
            elif kind == b"##DZ":
                yield from self._inflated(self.read(address, kind, most=_INFLATED_MAX))
            elif kind == b"##HL":
                waiting += [link for link in self.read(address, kind).links[:1] if link]
            else:
                links = self.read(address, b"##DL").links
                waiting += [link for link in (*links[:1], *reversed(links[1:])) if link]

    def _plain(self, address: int, length: int, begin: int) -> Iterator[bytes]:
        end = address + length
        if self.unfinished & _UNFINISHED_LENGTH and (length == begin or end >= self._size):
            end = self._size
        at = address + begin
        while at < min(end, self._size):
            self._stream.seek(at)
            piece = self._stream.read(min(_PIECE, end - at))
            at += len(piece)
            yield piece
        if end > self._size:
            raise Damage(f"truncated: byte {address}: a block of {length} bytes, the file has {self._size}")

    def _inflated(self, block: Block) -> Iterator[bytes]:
        where = f"byte {block.address}: a compressed block that cannot be decompressed"
        if len(block.content) < 24:
            raise Damage(f"{where}: {len(block.content)} bytes")
        _, method, columns, length, size = struct.unpack_from("<2sBxLQQ", block.content)
        if length > _INFLATED_MAX or size > len(block.content) - 24 or method > 1:
            raise Damage(f"{where}: {length} bytes in {size} by method {method}")
        pieces = _decompressed(block.content[24 : 24 + size], length, where)
        if method == 0:
            yield from pieces
            return
        data = b"".join(pieces)
        rows = length // columns if columns else 0
        cells = rows * columns
        yield b"".join(data[row:cells:rows] for row in range(rows)) + data[cells:]


def _decompressed(data: bytes, length: int, where: str) -> Iterator[bytes]:
    """Pieces of a length altogether. Damage, after those before the error."""
    decompressor = zlib.decompressobj()
    left = length
    for at in range(0, len(data), _COMPRESSED_PIECE):
        try:
            piece = decompressor.decompress(data[at : at + _COMPRESSED_PIECE], left + 1)
        except zlib.error as error:
            raise Damage(f"{where}: {error}") from None
        left -= len(piece)
        if left < 0:
            break
        yield piece
    if left or not decompressor.eof:
        raise Damage(f"{where}: not the {length} bytes that it states")
