"""salient evidence: each claim about the drive with the measurement behind it, and whether that still holds.

A claim of tests/evidence.toml is a sentence, its assumptions, a command and the committed summary that the command has
left. It is red when the summary is missing, when it has failures, or when sources that the claim covers have changed
since the commit of the summary; comments of C and documents are no such change. Nothing here measures: `--run` runs
the commands of the red claims, each of which goes on where it was interrupted, and commits nothing.

    [[claim]]
    name = "worlds"
    sentence = "No drive in a world with faults breaks a rule of the campaign."
    assumptions = "docs/testing/campaigns.md#assumptions"
    command = "tools/salient campaign --first 1 --seeds 100000 --out {out}"
    keeps = { "summary.json" = "tests/campaign/faults.json" }  # files of {out}, and where they are committed
    summary = "tests/campaign/faults.json"                     # JSON or TOML, with `commit`
    table = "study"                                            # optional: tables of it, "*" for each; without: itself
    where = { controller = "salient" }                         # optional: only tables with these values
    counts = "finished"                                        # number of tries, as `failed`
    failed = "violations"                                      # a number, a list, or tables with a `count`
    at_most = 0                                                # failures
    covers = ["firmware", "hal", "emulator"]
    figure = "{counts:,} worlds, {failed:,} violations"        # of these two and of the keys of the summary
"""

from __future__ import annotations

import io
import json
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from salient import c_text
from salient.errors import RunFailed, UsageError, reason
from salient.pages import write_page
from salient.paths import OUT, ROOT, make_folder

CLAIMS = Path("tests") / "evidence.toml"
"""In the repository."""
C_SOURCES = (".c", ".h", ".cpp", ".def")
GOOD = "good"
MISSING, FAILING, STALE = "missing", "failing", "stale"
RED = (MISSING, FAILING, STALE)

Text = Annotated[str, Field(min_length=1)]


class Claim(BaseModel):
    """A table of the file; see above."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: Text
    sentence: Text
    assumptions: Text
    command: Text
    summary: Text
    covers: Annotated[list[Text], Field(min_length=1)]
    figure: Text
    failed: Text
    counts: Text
    at_most: Annotated[int, Field(ge=0)] = 0
    table: str = ""
    where: dict[str, str] = {}
    keeps: dict[str, str] = {}


@dataclass(frozen=True)
class Verdict:
    """Judgement of a claim. figure, commit and date are empty where they are unknown; why is empty when it is good."""

    claim: Claim
    state: str
    why: str
    figure: str = ""
    commit: str = ""
    date: str = ""


class _Missing(Exception):
    """The summary does not tell what the claim asks for; the text is the reason."""


def read_claims(path: Path) -> list[Claim]:
    """The claims of a file. UsageError names file, claim and key."""
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8")).get("claim", [])
    except (OSError, ValueError) as error:
        raise UsageError(f"{path}: {reason(error)}") from None
    claims = []
    for number, table in enumerate(tables, start=1):
        try:
            claims.append(Claim.model_validate(table))
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(map(str, first["loc"])) or "claim"
            raise UsageError(f"{path}: claim {table.get('name', number)}: {key}: {first['msg']}") from None
    names = [claim.name for claim in claims]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"{path}: claim {name}: name: used twice")
    return claims


def judge(claim: Claim, root: Path) -> Verdict:
    """Judges a claim by its committed summary and the history of the repository in `root`."""
    try:
        note = _read(root / claim.summary, claim)
        counts, failed = _total(note, claim, claim.counts), _total(note, claim, claim.failed)
        figure = _figure(claim, note, counts, failed)
        commit = _commit(note, claim)
        date = _date(commit, root)
    except _Missing as error:
        return Verdict(claim, MISSING, str(error))
    if counts == 0:
        return Verdict(claim, MISSING, f"{claim.summary} counts nothing", figure, commit, date)
    if failed > claim.at_most:
        return Verdict(claim, FAILING, f"{failed:,} failures, at most {claim.at_most:,}", figure, commit, date)
    changes = _changes(claim, commit, root)
    return Verdict(claim, STALE if changes else GOOD, changes, figure, commit, date)


def _read(path: Path, claim: Claim) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
        note = tomllib.loads(text) if path.suffix == ".toml" else json.loads(text)
    except OSError as error:
        raise _Missing(f"{claim.summary}: {error.strerror}") from None
    except ValueError as error:
        raise _Missing(f"{claim.summary}: {error}") from None
    if not isinstance(note, dict):
        raise _Missing(f"{claim.summary}: must be an object")
    return note


def _tables(note: Mapping[str, Any], claim: Claim) -> list[Mapping[str, Any]]:
    """The tables of the summary that the claim counts."""
    tables = list(note.values()) if claim.table == "*" else note.get(claim.table, []) if claim.table else [note]
    return [table for table in tables if all(table.get(name) == value for name, value in claim.where.items())]


def _total(note: Mapping[str, Any], claim: Claim, key: str) -> int:
    """Sum over the tables of the claim."""
    return sum(_count(table, claim, key) for table in _tables(note, claim))


def _commit(note: Mapping[str, Any], claim: Claim) -> str:
    """Commit of the summary, or the one that its tables have in common."""
    commits = {str(part["commit"]) for part in (note, *_tables(note, claim)) if "commit" in part}
    if len(commits) > 1:
        raise _Missing(f"{claim.summary} is of several commits: {', '.join(sorted(commits))}")
    return commits.pop() if commits else ""


def _count(table: Mapping[str, Any], claim: Claim, key: str) -> int:
    value: Any = table
    for part in key.split("."):
        if not isinstance(value, Mapping) or part not in value:
            raise _Missing(f"{claim.summary} has no {key}")
        value = value[part]
    if isinstance(value, Mapping):
        return sum(int(entry["count"]) if isinstance(entry, Mapping) else 1 for entry in value.values())
    return len(value) if isinstance(value, list) else int(value)


def _figure(claim: Claim, note: Mapping[str, Any], counts: int, failed: int) -> str:
    try:
        return claim.figure.format_map({**note, "counts": counts, "failed": failed})
    except (KeyError, ValueError, TypeError) as error:
        raise _Missing(f"{claim.summary}: figure: {error}") from None


def _git(root: Path, *arguments: str) -> str | None:
    """Output of a command of git; None when it fails."""
    done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=False)
    return done.stdout.strip() if done.returncode == 0 else None


def _date(commit: str, root: Path) -> str:
    """Date of a commit."""
    if commit.endswith(("+", "-dirty")):
        raise _Missing(f"measured with changes that were not committed, of {commit}")
    date = _git(root, "show", "-s", "--format=%cs", f"{commit}^{{commit}}") if commit else None
    if date is None:
        raise _Missing(f"commit {commit or 'unknown'} is not in this repository")
    return date


def _changes(claim: Claim, commit: str, root: Path) -> str:
    """Changes of the covered sources since a commit, in words; empty without any."""
    named = (_git(root, "diff", "--name-only", "--no-renames", commit, "--", *claim.covers) or "").splitlines()
    changed = [name for name, then in _texts(commit, [name for name in named if not name.endswith(".md")], root).items()
               if _significant(name, then) != _significant(name, _now(root / name))]
    if not changed:
        return ""
    commits = _git(root, "rev-list", "--count", f"{commit}..HEAD", "--", *changed) or "0"
    return (f"{len(changed):,} file{'s' if len(changed) > 1 else ''} of {', '.join(claim.covers)} changed since, in "
            f"{commits} commit{'' if commits == '1' else 's'}")


def _significant(name: str, text: bytes | None) -> bytes | str | None:
    """The part of a file that a measurement depends on: code of C and C++ without its comments; None: there is no
    file."""
    return c_text.code(text.decode()) if text is not None and name.endswith(C_SOURCES) else text


def _now(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None


def _texts(commit: str, names: Sequence[str], root: Path) -> dict[str, bytes | None]:
    """Files at a commit; None for one that it does not have."""
    asked = "".join(f"{commit}:{name}\n" for name in names).encode()
    answer = io.BytesIO(subprocess.run(["git", "-C", str(root), "cat-file", "--batch"], input=asked,
                                       capture_output=True, check=True).stdout)
    texts: dict[str, bytes | None] = {}
    for name in names:
        *_, kind, size = answer.readline().split()  # of an object there are name, type and size
        texts[name] = answer.read(int(size)) if kind == b"blob" else None
        if kind == b"blob":
            answer.readline()
    return texts


def run(out: Path, only: Sequence[str], *, rerun: bool) -> int:
    """Judges the claims, or only the named ones, and writes the page; returns 1 when one is red. rerun: runs the
    commands of the red ones before. UsageError: an unknown name; RunFailed: a command left no summary."""
    claims = read_claims(ROOT / CLAIMS)
    unknown = sorted(set(only) - {claim.name for claim in claims})
    if unknown:
        raise UsageError(f"unknown claim '{unknown[0]}': {', '.join(claim.name for claim in claims)}")
    chosen = [claim for name in only for claim in claims if claim.name == name] or claims
    if rerun:
        for claim in chosen:
            if judge(claim, ROOT).state in RED:
                _run(claim)
    verdicts = [judge(claim, ROOT) for claim in chosen]
    make_folder(out.parent)
    write_page(out, "evidence.html", content(verdicts))
    for verdict in verdicts:
        print(f"{verdict.state:8}{verdict.claim.name}: {verdict.figure or verdict.why}"
              + (f" ({verdict.why})" if verdict.figure and verdict.why else ""))
    red = sum(verdict.state in RED for verdict in verdicts)
    print(f"{len(verdicts) - red} of {len(verdicts)} claims hold for these sources\npage: {out}")
    return 1 if red else 0


def content(verdicts: Sequence[Verdict]) -> dict[str, Any]:
    """Content of the page."""
    return {"verdicts": verdicts, "good": sum(verdict.state == GOOD for verdict in verdicts),
            "head": _git(ROOT, "rev-parse", "--short=10", "HEAD") or "unknown", "claims": str(CLAIMS)}


def _run(claim: Claim) -> None:
    """Runs the command of a claim and keeps its summary, whatever that says. Its folder is of this commit alone: an
    interrupted run goes on, and none takes over what another commit has left."""
    folder = OUT / "evidence" / claim.name / (_git(ROOT, "rev-parse", "--short=10", "HEAD") or "unknown")
    make_folder(folder)
    arguments = [str(folder) if part == "{out}" else part for part in claim.command.split()]
    print(f"--- {claim.name}: {' '.join(arguments)}", flush=True)
    done = subprocess.run(arguments, cwd=ROOT, stdin=subprocess.DEVNULL, check=False)
    left = {folder / name: ROOT / kept for name, kept in claim.keeps.items()}
    for path in left:
        if not path.exists():
            raise RunFailed(f"{claim.name}: {arguments[0]} ended with {done.returncode} and left no {path}")
    for path, kept in left.items():
        shutil.copyfile(path, kept)
    if done.returncode != 0:
        print(f"{claim.name}: exit code {done.returncode}", file=sys.stderr)
