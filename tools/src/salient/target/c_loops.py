"""Loop statements of a C source file."""

from __future__ import annotations

import re
from dataclasses import dataclass

_NOT_CODE = re.compile(r"/\*.*?\*/|//[^\n]*|\"(?:\\.|[^\"\\\n])*\"|'(?:\\.|[^'\\\n])*'|^[ \t]*#(?:\\\n|[^\n])*",
                       re.DOTALL | re.MULTILINE)
_KEYWORD = re.compile(r"\b(?:for|while|do|if|else|switch)\b")
_PAIRS = {"(": ")", "{": "}"}


@dataclass(frozen=True)
class LoopStatement:
    """first, last: lines, from the keyword to the end of the body. head: text of `for (...)` or `while (...)`, white
    space as one space."""

    first: int
    last: int
    head: str


def loop_statements(source: str) -> list[LoopStatement]:
    """All loop statements, in the order of their first lines. Text with unbalanced brackets has none."""
    try:
        return _Parser(source).loops()
    except ValueError:
        return []


class _Parser:
    def __init__(self, source: str) -> None:
        self._text = _NOT_CODE.sub(lambda found: re.sub(r"[^\n]", " ", found[0]), source)
        self._found: dict[int, LoopStatement] = {}

    def loops(self) -> list[LoopStatement]:
        ends_of_do: set[int] = set()
        for keyword in _KEYWORD.finditer(self._text):
            begin = keyword.start()
            if begin in ends_of_do or keyword[0] not in ("for", "while", "do"):
                continue
            if keyword[0] == "do":
                test = self._skip_space(self._end_of_statement(keyword.end()))
                ends_of_do.add(test)
                end = self._closing(self._text.index("(", test))
                self._add(begin, end, test, end)
            else:
                head_end = self._closing(self._text.index("(", begin))
                self._add(begin, self._end_of_statement(head_end), begin, head_end)
        return [self._found[begin] for begin in sorted(self._found)]

    def _add(self, begin: int, end: int, head_begin: int, head_end: int) -> None:
        self._found[begin] = LoopStatement(self._line(begin), self._line(end - 1),
                                           " ".join(self._text[head_begin:head_end].split()))

    def _line(self, position: int) -> int:
        return self._text.count("\n", 0, position) + 1

    def _skip_space(self, position: int) -> int:
        while self._text[position:position + 1].isspace():
            position += 1
        return position

    def _closing(self, position: int) -> int:
        """Position after the bracket that closes the one at a position."""
        opening, closing = self._text[position], _PAIRS[self._text[position]]
        depth = 0
        for found in re.compile(rf"[{re.escape(opening + closing)}]").finditer(self._text, position):
            depth += 1 if found[0] == opening else -1
            if depth == 0:
                return found.end()
        raise ValueError("unbalanced brackets")

    def _end_of_statement(self, position: int) -> int:
        """Position after the statement that begins after a position."""
        position = self._skip_space(position)
        if self._text[position:position + 1] == "{":
            return self._closing(position)
        keyword = _KEYWORD.match(self._text, position)
        if not keyword:
            return self._text.index(";", position) + 1
        if keyword[0] in ("do", "else"):
            end = self._end_of_statement(keyword.end())
            return self._text.index(";", end) + 1 if keyword[0] == "do" else end
        end = self._end_of_statement(self._closing(self._text.index("(", position)))
        following = self._skip_space(end)
        has_else = keyword[0] == "if" and self._text.startswith("else", following)
        return self._end_of_statement(following) if has_else else end
