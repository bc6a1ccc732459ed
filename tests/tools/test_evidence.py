"""tools/salient evidence: the claims of the repository are complete, and each kind of red is seen."""

import json
import re
import shlex
import subprocess

import pytest

from salient import evidence
from salient.cli import make_parser
from salient.errors import UsageError
from salient.evidence import CLAIMS, FAILING, GOOD, MISSING, STALE, content, judge, read_claims
from salient.pages import write_page
from salient.paths import ROOT

CLAIM = """[[claim]]
name = "worlds"
sentence = "No world fails."
assumptions = "docs/page.md"
command = "true {out}"
summary = "summary.json"
counts = "worlds"
failed = "violations"
covers = ["firmware", "hal"]
figure = "{counts} worlds of {kind}, {failed} violations"
"""


def git(root, *arguments):
    done = subprocess.run(["git", "-C", str(root), "-c", "user.name=a", "-c", "user.email=a@b", *arguments],
                          check=True, capture_output=True, text=True)
    return done.stdout.strip()


@pytest.fixture
def repository(tmp_path):
    """A repository with sources that a claim covers, and with its summary."""
    git(tmp_path, "init", "-q")
    for name in ("firmware", "docs"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text("1\n", encoding="utf-8")
    commit(tmp_path, "sources")
    write_summary(tmp_path)
    (tmp_path / "evidence.toml").write_text(CLAIM, encoding="utf-8")
    commit(tmp_path, "evidence")
    return tmp_path


def commit(root, subject):
    git(root, "add", "-A")
    git(root, "commit", "-q", "-m", subject)


def write_summary(root, **changes):
    note = {"kind": "faults", "worlds": 10, "violations": {}, "commit": git(root, "rev-parse", "--short=10", "HEAD")}
    note |= changes
    (root / "summary.json").write_text(json.dumps({key: value for key, value in note.items() if value is not None}),
                                       encoding="utf-8")


def verdict(root):
    (claim,) = read_claims(root / "evidence.toml")
    return judge(claim, root)


def test_a_claim_with_a_summary_of_its_sources_is_good(repository):
    of = verdict(repository)
    assert (of.state, of.why, of.figure) == (GOOD, "", "10 worlds of faults, 0 violations")
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", of.date)


def test_a_change_that_the_claim_does_not_cover_leaves_it_good(repository):
    (repository / "docs" / "file").write_text("2\n", encoding="utf-8")
    commit(repository, "documents")
    assert verdict(repository).state == GOOD


@pytest.mark.parametrize("committed", [True, False])
def test_a_claim_is_stale_when_a_source_that_it_covers_has_changed(committed, repository):
    (repository / "firmware" / "file").write_text("2\n", encoding="utf-8")
    if committed:
        commit(repository, "change")
    of = verdict(repository)
    assert of.state == STALE
    assert of.why == f"1 file of firmware, hal changed since, in {int(committed)} commit{'' if committed else 's'}"


@pytest.mark.parametrize(("name", "text"), [
    ("law.c", 'int law = 1; // as before\n/* "a" */\n\n    const char *url = "http://a"; /* b\n */\n'),
    ("README.md", "other\n"),
])
def test_comments_of_c_and_documents_leave_a_claim_good(name, text, repository):
    source = repository / "firmware" / "law.c"
    source.write_text('int law = 1;\nconst char *url = "http://a"; /* c */\n', encoding="utf-8")
    commit(repository, "law")
    write_summary(repository)
    (repository / "firmware" / name).write_text(text, encoding="utf-8")
    commit(repository, "words")
    assert verdict(repository).state == GOOD


@pytest.mark.parametrize("text", [
    "int law = 2;\n#define A\nint b;\n", 'int law = 1; // "\n#define A int b;\n', "int law = 1;\n#define A\n", None,
])
def test_another_line_of_code_and_a_file_that_has_gone_make_a_claim_stale(text, repository):
    source = repository / "firmware" / "law.c"
    source.write_text("int law = 1;\n#define A\nint b;\n", encoding="utf-8")
    commit(repository, "law")
    write_summary(repository)
    source.unlink()
    if text is not None:
        source.write_text(text, encoding="utf-8")
    assert verdict(repository).why == "1 file of firmware, hal changed since, in 0 commits"


def test_a_new_file_makes_a_claim_stale(repository):
    (repository / "hal").mkdir()
    (repository / "hal" / "port.h").write_text("/* nothing else */\n", encoding="utf-8")
    commit(repository, "port")
    assert verdict(repository).why == "1 file of firmware, hal changed since, in 1 commit"


@pytest.mark.parametrize(("violations", "number"), [
    ({"a": {"count": 2}, "b": {"count": 1}}, 3), (["a", "b"], 2), (1, 1),
])
def test_a_claim_with_failures_is_failing_however_they_are_written(violations, number, repository):
    write_summary(repository, violations=violations)
    of = verdict(repository)
    assert (of.state, of.why) == (FAILING, f"{number} failures, at most 0")


def test_failures_up_to_the_claimed_number_are_good(repository):
    text = CLAIM.replace('failed = "violations"', 'failed = "violations"\nat_most = 2')
    (repository / "evidence.toml").write_text(text, encoding="utf-8")
    for number, state in ((2, GOOD), (3, FAILING)):
        write_summary(repository, violations=number)
        assert verdict(repository).state == state


@pytest.mark.parametrize(("changes", "why"), [
    ({"commit": "0123456789"}, "commit 0123456789 is not in this repository"),
    ({"commit": None}, "commit unknown is not in this repository"),
    ({"commit": "0123456789+"}, "measured with changes that were not committed, of 0123456789+"),
    ({"commit": "0123456-dirty"}, "measured with changes that were not committed, of 0123456-dirty"),
    ({"violations": None}, "summary.json has no violations"),
    ({"kind": None}, "summary.json: figure: 'kind'"),
    ({"worlds": 0}, "summary.json counts nothing"),
])
def test_a_summary_that_does_not_carry_the_claim_is_missing(changes, why, repository):
    write_summary(repository, **changes)
    of = verdict(repository)
    assert (of.state, of.why) == (MISSING, why)


@pytest.mark.parametrize("text", [None, "{", "[1]"])
def test_a_summary_that_cannot_be_read_is_missing(text, repository):
    (repository / "summary.json").unlink()
    if text is not None:
        (repository / "summary.json").write_text(text, encoding="utf-8")
    of = verdict(repository)
    assert (of.state, of.why.startswith("summary.json: ")) == (MISSING, True)


def test_tables_are_summed_and_must_be_of_one_commit(repository):
    text = CLAIM.replace('counts = "worlds"', 'table = "*"\ncounts = "worlds"').replace(" of {kind}", "")
    (repository / "evidence.toml").write_text(text, encoding="utf-8")
    head = git(repository, "rev-parse", "HEAD")
    tables = {name: {"worlds": 5, "violations": 0, "commit": head} for name in "ab"}
    (repository / "summary.json").write_text(json.dumps(tables), encoding="utf-8")
    assert (verdict(repository).state, verdict(repository).figure) == (GOOD, "10 worlds, 0 violations")
    tables["b"]["commit"] = "other"
    (repository / "summary.json").write_text(json.dumps(tables), encoding="utf-8")
    assert verdict(repository).why == f"summary.json is of several commits: {', '.join(sorted((head, 'other')))}"


@pytest.mark.parametrize(("old", "new", "error"), [
    ('name = "worlds"', "", "claim 1: name: Field required"),
    ('counts = "worlds"', 'count = "worlds"', "claim worlds: counts: Field required"),
    ('counts = "worlds"', 'counts = "worlds"\nat_most = -1',
     "claim worlds: at_most: Input should be greater than or equal to 0"),
    ("[[claim]]", CLAIM + "[[claim]]", "claim worlds: name: used twice"),
])
def test_a_wrong_claim_is_one_error_that_names_it(old, new, error, tmp_path):
    path = tmp_path / "evidence.toml"
    path.write_text(CLAIM.replace(old, new), encoding="utf-8")
    with pytest.raises(UsageError) as raised:
        read_claims(path)
    assert str(raised.value) == f"{path}: {error}"


def test_claims_that_are_not_there_are_one_error_that_names_them_once(tmp_path):
    path = tmp_path / "evidence.toml"
    with pytest.raises(UsageError) as raised:
        read_claims(path)
    assert str(raised.value) == f"{path}: No such file or directory"


def test_the_page_shows_each_state(repository, tmp_path):
    (claim,) = read_claims(repository / "evidence.toml")
    verdicts = [evidence.Verdict(claim, state, state) for state in (GOOD, MISSING, FAILING, STALE)]
    page = tmp_path / "page.html"
    write_page(page, "evidence.html", content(verdicts))
    text = page.read_text(encoding="utf-8")
    assert "1 of 4 claims hold" in text
    for state in (GOOD, MISSING, FAILING, STALE):
        assert text.count(f'<span class="state {state}">{state}</span>') == 1


def test_red_claims_are_run_again_and_their_summary_is_kept(repository, tmp_path, monkeypatch, capsys):
    script = repository / "measure.py"
    script.write_text("import pathlib, shutil, sys\n"
                      "shutil.copyfile('new.json', pathlib.Path(sys.argv[1]) / 'left.json')\n", encoding="utf-8")
    (repository / "evidence.toml").write_text(CLAIM.replace(
        'command = "true {out}"', 'command = "python3 measure.py {out}"\nkeeps = { "left.json" = "summary.json" }'),
        encoding="utf-8")
    write_summary(repository)
    (repository / "summary.json").rename(repository / "new.json")
    monkeypatch.setattr(evidence, "ROOT", repository)
    monkeypatch.setattr(evidence, "OUT", tmp_path / "out")
    monkeypatch.setattr(evidence, "CLAIMS", "evidence.toml")
    assert evidence.run(tmp_path / "page.html", [], rerun=False) == 1
    assert capsys.readouterr().out.startswith("missing worlds: summary.json: No such file")
    assert evidence.run(tmp_path / "page.html", [], rerun=True) == 0
    assert "good    worlds: 10 worlds of faults, 0 violations\n1 of 1 claims hold" in capsys.readouterr().out


def test_claims_of_this_repository_name_what_exists():
    for claim in read_claims(ROOT / CLAIMS):
        words = shlex.split(claim.command)
        if words[0] == "tools/salient":
            make_parser().parse_args(words[1:])
        else:
            assert words[:2] == ["build/venv/bin/python", "-m"]
            assert (ROOT / "tools" / "src" / words[2].replace(".", "/")).with_suffix(".py").exists()
        page, _, anchor = claim.assumptions.partition("#")
        headings = re.findall("^#+ (.*)$", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE)
        assert anchor in {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
        assert all((ROOT / covered).exists() for covered in claim.covers)
        assert claim.summary in claim.keeps.values() or not claim.keeps


def test_an_unknown_claim_is_one_error(tmp_path):
    with pytest.raises(UsageError, match=r"^unknown claim 'world': worlds, "):
        evidence.run(tmp_path / "page.html", ["world"], rerun=False)


def test_figures_of_the_readme_are_those_of_the_summaries():
    figures = {judge(claim, ROOT).figure for claim in read_claims(ROOT / CLAIMS)}
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (table,) = re.findall(r"\| claim \| last measured \|\n\| --- \| --- \|\n((?:\|.*\n)+)", text)
    shown = [line.strip("|\n ").split(" | ")[1] for line in table.splitlines()]
    assert len(shown) == 3
    assert set(shown) <= figures
