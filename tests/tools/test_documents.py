"""The documents: sizes, links and anchors on a forge, paths that they name, generated pages, and the site."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from salient.documents import CONFIGURATION
from salient.generate import commands, signals
from salient.paths import REFERENCE, ROOT

DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
FOLDERS = ("firmware", "hal", "emulator", "tools", "tests")
READ_MES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("README.md"))
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *READ_MES, *PAGES]
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
PATH = re.compile(r"`((?:docs|firmware|hal|emulator|tools|tests|cmake|\.ci|\.github)/[\w./-]+\.\w+)`")
PAGE_BYTES, READ_ME_BYTES, FIRST_PAGE_BYTES, CHANGES_LINES = 12_000, 3_000, 7_000, 40


def prose(text: str) -> Iterator[tuple[int, str]]:
    """Lines outside of fenced blocks, with their numbers."""
    fenced = False
    for number, line in enumerate(text.splitlines(), 1):
        if line.startswith("```"):
            fenced = not fenced
        elif not fenced:
            yield number, line


def anchors(path: Path) -> set[str]:
    """Anchors of the headings, as a forge and MkDocs make them."""
    heads = [line.lstrip("#").strip() for _, line in prose(path.read_text(encoding="utf-8")) if line.startswith("#")]
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def broken(path: Path) -> list[str]:
    """Links of a document that lead nowhere, or out of docs/, which the site has not."""
    found = []
    for number, line in prose(path.read_text(encoding="utf-8")):
        for target in LINK.findall(re.sub(r"`[^`]*`", "", line)):
            name, _, anchor = target.partition("#")
            if re.match(r"https?:", target):
                continue
            to = (path.parent / name).resolve() if name else path
            bad = not to.is_file() or (anchor and anchor not in anchors(to))
            if bad or (DOCS in path.parents and DOCS not in to.parents):
                found.append(f"{path.relative_to(ROOT)}:{number}: {target}")
    return found


def test_a_page_has_at_most_12_kB_a_folder_3_and_the_first_page_7() -> None:
    hand_written = [path for path in PAGES if path.parent != REFERENCE]
    assert len(hand_written) > 25
    too_large = [(str(path.relative_to(ROOT)), path.stat().st_size) for limit, paths in (
        (PAGE_BYTES, hand_written), (READ_ME_BYTES, READ_MES), (FIRST_PAGE_BYTES, [ROOT / "README.md"]))
        for path in paths if path.stat().st_size > limit]
    assert too_large == []


def test_the_first_release_has_at_most_40_lines() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    releases = re.split(r"^## ", text, flags=re.MULTILINE)[1:]
    assert re.match(r"\d+\.\d+\.\d+ - \d{4}-\d{2}-\d{2}\n", releases[-1])
    assert 5 < len(releases[-1].splitlines()) <= CHANGES_LINES


def test_links_and_anchors_of_the_documents_lead_somewhere() -> None:
    assert [link for path in DOCUMENTS for link in broken(path)] == []


def test_a_broken_link_or_anchor_is_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# One, two\n[a](page.md#one-two) [b](#three)\n[c](none.md)\n", encoding="utf-8")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(f"{__name__}.ROOT", tmp_path)
        assert broken(page) == ["page.md:2: #three", "page.md:3: none.md"]


def test_paths_that_the_documents_name_exist() -> None:
    missing = [f"{path.relative_to(ROOT)}: {name}" for path in DOCUMENTS if path.name != "CHANGELOG.md"
               for name in PATH.findall(path.read_text(encoding="utf-8"))
               if not (ROOT / name).exists()]
    assert missing == []


def test_every_picture_is_beside_the_command_that_makes_it() -> None:
    table = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8").split("| picture |")[1].split("\n\n")[0]
    named = {name for row in table.splitlines()[2:] for name in re.findall(r"`([^`]+)`", row.split(" | ")[0])}
    assert named == {path.name for path in (ROOT / "docs" / "images").iterdir() if path.suffix in (".png", ".svg")}


def test_lists_and_tables_follow_an_empty_line_as_markdown_of_the_site_needs() -> None:
    found = []
    for path in PAGES:
        before = ""
        for number, line in prose(path.read_text(encoding="utf-8")):
            starts = re.match(r"[-*] |\d+\. |\| ", line)
            kind = line[:1] if line.startswith("|") else "list"
            if starts and before.strip() and not before.startswith((" ", "|" if kind == "|" else "-", "*")) \
                    and not (kind == "list" and re.match(r"\d+\. ", before)):
                found.append(f"{path.relative_to(ROOT)}:{number}")
            before = line
    assert found == []


def test_pages_of_commands_and_signals_are_generated() -> None:
    assert commands.PAGE.read_text(encoding="utf-8") == commands.page(), "run tools/salient docs --generate"
    for path, text in signals.pages().items():
        assert path.read_text(encoding="utf-8") == text, "run tools/salient docs --generate"


def test_every_page_is_in_the_contents_of_the_site() -> None:
    listed = re.findall(r": ([\w/-]+\.md)$", CONFIGURATION.read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(listed) == [str(path.relative_to(DOCS)) for path in PAGES]


@pytest.mark.in_turns
def test_the_site_is_built_without_a_warning(salient, tmp_path: Path) -> None:
    done = salient("docs", "--out", tmp_path / "site")
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site" / "start" / "can.html").read_text(encoding="utf-8")
    assert "untested" not in page and 'src="https://' not in page


@pytest.mark.in_turns
def test_a_warning_fails_the_build_of_the_site(monkeypatch, tmp_path: Path) -> None:
    from salient import documents
    from salient.errors import RunFailed

    root = tmp_path / "root"
    (root / "docs").mkdir(parents=True)
    (root / "docs" / "index.md").write_text("# Page\n\n[nowhere](nowhere.md)\n", encoding="utf-8")
    (root / "mkdocs.yml").write_text("site_name: x\ntheme: readthedocs\n", encoding="utf-8")
    monkeypatch.setattr(documents, "CONFIGURATION", root / "mkdocs.yml")
    with pytest.raises(RunFailed, match=r"nowhere\.md"):
        documents.run(tmp_path / "site")
