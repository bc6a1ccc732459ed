"""Rules of the language of comments and documents that a list of words (tools/spelling/en_gb.txt) cannot state;
exceptions by name, each with its reason, are in tools/spelling/language.toml.

- A comment, a row of a table and an item of a list do not begin with "Of" or "What".
- "none" follows "is" and "are" only after "there".
- "that of" and "those of" are not written in comments, docstrings and documents, nor across the end of a line: the noun
  is said. The pages in docs/reference hold the rows of DBCs, parameters and help texts to it.
- "begin" is a verb, the noun is "start" or "beginning"; in the same texts, the pages in docs/reference apart.
- A sentence of a document has at most 30 words.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator, Mapping
from pathlib import Path

from salient import c_text
from salient.exceptions import unexplained
from salient.paths import ROOT

EXCEPTIONS = ROOT / "tools" / "spelling" / "language.toml"
FOLDERS = ("firmware", "hal", "emulator", "tools", "tests", "docs")
SOURCES = (".c", ".h", ".cpp", ".py", ".def")
NOT_OURS = ("tools/src/salient/view/page/vendor/", "emulator/fmi/fmi3_")
GENERATED = "docs/reference/"
"""Pages whose sentences are the comments of DBCs, tables and parsers."""
WORDS_MAX = 30

_COMMENT = re.compile(r"""(?:/\*+|//|(?<!['"])#(?!["'])|\"\"\")\s?(?P<words>[A-Z]\w*(?: \w+)?)""")
_CELL = re.compile(r"^(?:\| |[-*] |\d+\. )(?P<words>\w+(?: \w+)?)")
_NONE = re.compile(r"(?<!there )\b(?:is|are) none\b")
_THAT_OF = re.compile(r"\b(?:that|those)\s+of\b", re.IGNORECASE)
_BEGIN = re.compile(r"\b(?:the|its|their)\s+begin\b|\bbegin\s+of\b", re.IGNORECASE)
_C_MARGIN = re.compile(r"^[ \t]*(?://+|\*(?!/))", re.MULTILINE)
_OPENINGS = ("of", "what")


def _opens_wrongly(words: str) -> bool:
    return words.lower().split()[0] in _OPENINGS


def _found(rule: re.Pattern[str], text: str, first: int = 1) -> Iterator[tuple[int, str]]:
    """Breaches of a rule, also across the end of a line. first: number of the text's first line."""
    yield from ((first + text.count("\n", 0, found.start()), f"'{' '.join(found[0].split())}'")
                for found in rule.finditer(text))


def _c_comments(text: str) -> Iterator[tuple[int, str]]:
    """Number of the first line, and text, of each comment without its margin; comments with // on successive lines are
    one."""
    for token in c_text.TOKEN.finditer(text):
        if token["comment"]:
            yield 1 + text.count("\n", 0, token.start()), _C_MARGIN.sub("", token["comment"])


def _python_comments(text: str) -> Iterator[tuple[int, str]]:
    """Likewise of Python: docstrings of anything, and comments, on successive lines as one."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            yield node.lineno, node.value.value
    first, lines = 0, list[str]()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            if token.start[0] != first + len(lines):
                yield first, "\n".join(lines)
                first, lines = token.start[0], []
            lines.append(token.string.lstrip("#"))
    yield first, "\n".join(lines)


def _in_source(text: str, *, python: bool) -> Iterator[tuple[int, str]]:
    for first, comment in (_python_comments if python else _c_comments)(text):
        yield from _found(_THAT_OF, comment, first)
        yield from _found(_BEGIN, comment, first)
    for number, line in enumerate(text.splitlines(), 1):
        yield from ((number, f"begins with '{found['words']}'") for found in _COMMENT.finditer(line)
                    if _opens_wrongly(found["words"]))
        yield from ((number, f"'{found[0]}'") for found in _NONE.finditer(line))


def _in_document(text: str, *, generated: bool) -> Iterator[tuple[int, str]]:
    for number, line in enumerate(text.splitlines(), 1):
        found = _CELL.match(line)
        if found and _opens_wrongly(found["words"]):
            yield number, f"begins with '{found['words']}'"
        yield from ((number, f"'{found[0]}'") for found in _NONE.finditer(line))
    yield from _found(_THAT_OF, text)
    if not generated:
        yield from _found(_BEGIN, text)
        for number, sentence in sentences(text):
            words = len(sentence.split())
            if words > WORDS_MAX:
                yield number, f"{words} words: {' '.join(sentence.split()[:6])} ..."


def sentences(text: str) -> Iterator[tuple[int, str]]:
    """Number of the first line, and text, of each sentence of a document. An item of a list ends
    one, a cell of a table and a semicolon in it, too; code and the target of a link are one word."""
    for number, block in _blocks(text):
        plain = re.sub(r"`[^`]*`", "code", block)
        plain = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", plain)
        yield from ((number, sentence) for sentence in re.split(r"(?<=[.!?])\s+", plain) if sentence.strip())


def _blocks(text: str) -> Iterator[tuple[int, str]]:
    """Paragraphs, items of lists and cells of tables, with the number of their first line."""
    fenced, first, block = False, 0, ""
    for number, line in enumerate([*text.splitlines(), ""], 1):
        fence = line.startswith("```")
        row = line.startswith("|")
        fresh = row or fence or fenced or not line.strip() or re.match(r"[-*] |\d+\. |#|<!--|    ", line) is not None
        if fresh and block:
            yield first, block
            block = ""
        fenced ^= fence
        if row:
            yield from ((number, part.strip()) for cell in line.split("|") for part in cell.split("; "))
        elif not (fence or fenced or line.startswith(("#", "<!--", "    "))) and line.strip():
            first, block = (number, line) if not block else (first, f"{block} {line.strip()}")


def breaches(root: Path = ROOT) -> Iterator[tuple[str, int, str]]:
    """File, line and breach of a rule."""
    files = [path for folder in FOLDERS for path in (root / folder).rglob("*") if path.suffix in (*SOURCES, ".md")]
    for path in sorted([*files, *(root / f"{page}.md" for page in ("README", "CONTRIBUTING", "CHANGELOG"))]):
        name = str(path.relative_to(root))
        if path.is_file() and not name.startswith(NOT_OURS):
            text = path.read_text(encoding="utf-8")
            found = _in_document(text, generated=name.startswith(GENERATED)) if path.suffix == ".md" \
                else _in_source(text, python=path.suffix == ".py")
            yield from ((name, number, breach) for number, breach in found)


def violations(exceptions: Mapping[str, str], root: Path = ROOT) -> list[str]:
    """One line for each breach without a reason, and for each exception that is not needed any more. An exception is
    named "FILE: BREACH"."""
    return unexplained(((f"{name}: {breach}", f"{name}:{number}: {breach}") for name, number, breach in breaches(root)),
                       exceptions, EXCEPTIONS)
