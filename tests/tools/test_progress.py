"""The line of progress: in place on a terminal that can erase it, and no wider."""

from __future__ import annotations

import io

import pytest

from salient.progress import Progress, steps_of

TEXT = "the controllers of one machine after the other, with its loads and seeds"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("columns", [20, 40, 200])
def test_line_in_place_is_no_wider_than_the_terminal(monkeypatch: pytest.MonkeyPatch, columns: int) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", str(columns))
    stream = Terminal()
    with Progress(2, stream) as progress:
        progress.step(TEXT)
    first, line, last = stream.getvalue().split("\r\x1b[K")
    assert (first, last) == ("", "")
    assert len(line) == min(columns - 1, len(f"[{24 * '#'}] 1/2 {TEXT}"))


@pytest.mark.parametrize("term", ["dumb", None])
def test_terminal_that_cannot_erase_has_a_line_for_each_step(monkeypatch: pytest.MonkeyPatch, term: str | None) -> None:
    if term is None:
        monkeypatch.delenv("TERM", raising=False)
    else:
        monkeypatch.setenv("TERM", term)
    stream = Terminal()
    with Progress(2, stream) as progress:
        progress.step(TEXT)
    assert stream.getvalue() == f"1/2 {TEXT}\n"
    assert steps_of(1000, stream) == 20
