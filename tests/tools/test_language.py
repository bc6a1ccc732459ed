"""The rules of the language find what they forbid, and nothing else; the hook refuses long subjects."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from salient import language
from salient.paths import ROOT

LONG = " ".join(["word"] * 31) + "."


def breaches(folder: Path, name: str, text: str) -> list[str]:
    """Breaches of a file of a repository that has no other."""
    (folder / "firmware").mkdir(exist_ok=True)
    (folder / "firmware" / name).write_text(text, encoding="utf-8")
    return [breach for _, _, breach in language.breaches(folder)]


@pytest.mark.parametrize(("name", "text", "found"), [
    ("a.c", "/* Of the drive. */\n", ["begins with 'Of the'"]),
    ("a.h", "int a; // What it is\n", ["begins with 'What it'"]),
    ("a.py", '"""What a drive does."""\n# Of one.\n', ["begins with 'What a'", "begins with 'Of one'"]),
    ("a.cpp", "/* That of the drive. */ // torque, those of it\n", ["'That of'", "'those of'"]),
    ("a.h", "/* A speed as that\n * of the drive. */\n// one, not those\n// of two\n", ["'that of'", "'those of'"]),
    ("a.c", 'print("that of"); /* so that, of all, ... */ int of; // that\nof = 1;\n', []),
    ("a.c", """char a = '"', b = '\\''; /* that of */ char *c = "/*"; /* those of */\n""", ["'that of'", "'those of'"]),
    ("a.py", '"""A torque, that\nof a drive."""\n\nA = 1  # those of\n# as that\n# of b\n',
     ["'that of'", "'those of'", "'that of'"]),
    ("a.py", 'A = "that of"  # that\nB = "of"\n', []),
    ("a.py", 'A = 1\n"""As that of B."""\n', ["'that of'"]),
    ("a.c", "/* A torque that is none; there is none. */\n", ["'is none'"]),
    ("a.c", "/* Offset of the drive. */ /* Often. Whatever. */\n", []),
    ("a.md", "| of the drive | x |\n\n- What it is\n", ["begins with 'of the'", "begins with 'What it'"]),
    ("a.md", "The speed is that of the rotor, not those\nof others.\n", ["'that of'", "'those of'"]),
    ("a.c", "/* Until the\n * begin of it, and begin of a run */ // they begin; the beginning, from begin to end\n",
     ["'the begin'", "'begin of'"]),
    ("a.md", "Its begin\nand the start.\n", ["'Its begin'"]),
    ("a.md", f"Short. {LONG}\n", ["31 words: word word word word word word ..."]),
    ("a.md", f"```\n{LONG}\n```\n", []),
    ("a.md", f"- {' '.join(['word'] * 20)}\n- {' '.join(['word'] * 20)}\n", []),
    ("a.md", f"`{LONG}` is [code]({'x' * 9}).\n", [])])
def test_a_rule_finds_what_it_forbids(tmp_path: Path, name: str, text: str, found: list[str]) -> None:
    assert breaches(tmp_path, name, text) == found


def test_a_generated_page_may_have_long_sentences_but_says_the_noun(tmp_path: Path) -> None:
    page = tmp_path / "docs" / "reference"
    page.mkdir(parents=True)
    (page / "a.md").write_text(f"{LONG} The begin.\n\n| Speed | that of the rotor |\n", encoding="utf-8")
    assert [(number, breach) for _, number, breach in language.breaches(tmp_path)] == [
        (3, "'that of'")]


def test_an_exception_has_a_reason_and_is_needed(tmp_path: Path) -> None:
    breaches(tmp_path, "a.c", "/* Of the drive. */\n")
    name = "firmware/a.c: begins with 'Of the'"
    assert language.violations({name: "a quotation"}, tmp_path) == []
    assert language.violations({name: " "}, tmp_path) == ["firmware/a.c:1: begins with 'Of the'"]
    assert language.violations({name: "a", "b": "c"}, tmp_path) == [
        "b: an exception of language.toml that is not needed"]


def test_the_hook_refuses_a_subject_of_73_characters() -> None:
    spec = importlib.util.spec_from_file_location("commit_subject", ROOT / "tools" / "commit_subject.py")
    assert spec and spec.loader
    hook = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hook)
    assert hook.refusal(f"# comment\n{'x' * 72}\n\n{'y' * 90}\n") == ""
    assert hook.refusal("x" * 73) == f"subject has 73 characters, at most 72: {'x' * 73}"
    assert hook.refusal(f"Merge branch {'x' * 73}") == ""
