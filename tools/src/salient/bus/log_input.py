"""Bytes and lines of a log file as other tools, transfers and power cuts leave them: positions are known, memory is
bounded, and what is compressed by gzip is decompressed."""

from __future__ import annotations

import codecs
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

_PIECE = 1 << 16
_LINE_MAX = 1 << 16
"""Characters of a line; the longest frame has some 300, a comment may have more."""
_GZIP, _GZIP_WINDOW = b"\x1f\x8b", 31


class Damage(Exception):
    """A log ends to be readable; the text says where, as a line or a byte, and why."""


@dataclass(frozen=True)
class Line:
    """A line without its end. is_ended: whether it had one, as only the last may not."""

    number: int
    text: str
    is_ended: bool

    def damage(self, reason: str) -> Damage:
        """The error of a line that is not understood."""
        return Damage(f"{'' if self.is_ended else 'truncated: '}line {self.number}: {reason}")


class LogInput:
    """A log file that is read from its beginning to its end. OSError."""

    def __init__(self, path: Path) -> None:
        self._file: BinaryIO = path.open("rb")
        self.size = path.stat().st_size
        """Bytes of the file, compressed ones where it is compressed."""
        self.position = 0
        """Bytes that have been read, after decompression."""
        self.is_compressed = self._file.read(2) == _GZIP
        self._file.seek(0)
        self._decompressor = zlib.decompressobj(_GZIP_WINDOW)
        self._buffer = b""
        self._left_out, self._first_left_out = 0, ""

    def close(self) -> None:
        self._file.close()

    def read(self, size: int) -> bytes:
        """As many bytes, fewer at the end of the file. Damage: the compressed data end early or are not compressed."""
        data = self._file.read(size) if not self.is_compressed else self._decompressed(size)
        self.position += len(data)
        return data

    def _decompressed(self, size: int) -> bytes:
        parts: list[bytes] = []
        while size:
            if not self._buffer:
                try:
                    self._buffer = self._piece()
                except Damage:
                    if parts:  # told by the next read
                        break
                    raise
                if not self._buffer:
                    break
            parts.append(self._buffer[:size])
            self._buffer = self._buffer[size:]
            size -= len(parts[-1])
        return b"".join(parts)

    def _piece(self) -> bytes:
        """The next bytes; none at the end of the last member."""
        while True:
            data = self._decompressor.unconsumed_tail or self._decompressor.unused_data
            if self._decompressor.eof:
                data = data or self._file.read(_PIECE)
                if not data.strip(b"\0"):  # padding after the end, which gzip ignores
                    return b""
                self._decompressor = zlib.decompressobj(_GZIP_WINDOW)
            else:
                data = data or self._file.read(_PIECE)
            where = f"byte {self._file.tell()} of the compressed file"
            if not data:
                raise Damage(f"truncated: {where}: the end of what gzip compressed is missing")
            try:
                piece = self._decompressor.decompress(data, _PIECE)
            except zlib.error as error:
                raise Damage(f"before {where}: {error}") from None
            if piece:
                return piece

    def lines(self) -> Iterator[Line]:
        """Lines of text in UTF-8, UTF-16 with its mark, or any encoding that has ASCII as it is; a line may end with CR
        LF. Damage: see read; a line is too long."""
        number, tail = 0, ""
        chunk = self.read(_PIECE)
        wide = chunk[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        decoder = codecs.getincrementaldecoder("utf-16" if wide else "latin-1")(errors="replace")
        while chunk:
            lines = (tail + decoder.decode(chunk)).split("\n")
            tail = lines.pop()
            for text in lines:
                number += 1
                yield Line(number, _plain(text, number), True)
            if len(tail) > _LINE_MAX:
                raise Damage(f"line {number + 1} has more than {_LINE_MAX} characters")
            chunk = self.read(_PIECE)
        if tail:
            yield Line(number + 1, _plain(tail, number + 1), False)

    def leave_out(self, where: str) -> None:
        """Notes a part that cannot be a frame of the log, while what follows can be read. where: place and reason."""
        self._first_left_out = self._first_left_out or where
        self._left_out += 1

    @property
    def left_out(self) -> str:
        """Parts left out, for a message; empty when nothing was."""
        if self._left_out < 2:
            return self._first_left_out and f"left out: {self._first_left_out}"
        return f"left out: {self._first_left_out}, and {self._left_out - 1} more"


def _plain(text: str, number: int) -> str:
    """A line without CR and the mark of UTF-8."""
    return (text.removeprefix("\xef\xbb\xbf") if number == 1 else text).rstrip("\r")
