"""MISRA C:2012 in firmware/ and hal/ by the add-on of cppcheck, with cppcheck's own warnings.

    python -m salient.experiments.misra [--list RULE ...] [--write] [--out DIR]

Each source is read with the options of the build that compiles it for its board: firmware/ and hal/stm32g4 of the
preset stm32g4, hal/qemu and hal/skeleton of cortex-m4 and rv32. Rules about several sources judge the firmware with one
port at a time. Generated code is left out, and so are the instructions of firmware/fixed/arm_dsp.h, whose C
alternatives are read. The add-on is called by itself: through cppcheck only the first finding of a line remains.

tests/misra.toml has the deviations: a rule, the reason, and the findings in each scope, a folder or a file. A finding
belongs to the narrowest scope. Rules about undefined behaviour and side effects have files as scopes. Exit code 1 for
a finding without a deviation, for more findings than stated, and for a scope that has none any more. --write states
fewer. DIR/runs.jsonl keeps the results for these sources: a later run reads only what has changed.
"""

from __future__ import annotations

import argparse
import hashlib
import inspect
import json
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from salient.builder import build_preset
from salient.errors import RunFailed, UsageError, exit_code, reason
from salient.experiments import tasks
from salient.experiments.campaign.runner import processor_s
from salient.paths import BUILD, OUT, ROOT, build_lock, from_root
from salient.progress import Progress, steps_of

TABLE = ROOT / "tests" / "misra.toml"
FOLDERS = ("firmware", "hal")
PRESETS = {"stm32g4": ("salient_port", "drive_layout"), "cortex-m4": ("salient_port", "skeleton"),
           "rv32": ("salient_port",)}
"""Preset: targets whose sources are read; the first preset that compiles a source of the firmware has it."""
OPTIONS = ("--std=c11", "--platform=unix32", "--enable=warning,style,performance,portability",
           "--template={file}\t{line}\t{column}\t{id}", "--template-location=",
           "-DINT32_C(number)=number##l", "-DUINT32_C(number)=number##ul", "-DINT64_C(number)=number##ll",
           "-DUINT64_C(number)=number##ull")
"""The headers of the C library are not read: cppcheck knows it, but not the suffixes of these constants."""
BY_FILE = re.compile(r"(1\.3|(9|13|17|18|21|22)\.\d+|12\.2|[a-z]\w+)$")
"""Rules about undefined behaviour and side effects, and all warnings of cppcheck: a deviation names files."""


class Finding(NamedTuple):
    """A breach of a rule, a number of MISRA C:2012 or the name of a warning of cppcheck."""

    file: str
    line: int
    column: int
    rule: str


@dataclass(frozen=True)
class Unit:
    """A source, the include paths and definitions of its build, and the port that it is a part of; none: all."""

    source: str
    options: tuple[str, ...]
    compiler: tuple[str, ...]
    port: str = ""


@dataclass(frozen=True)
class Deviation:
    """A rule that is broken for a reason, and how often in each scope, a folder or a file."""

    rule: str
    reason: str
    findings: Mapping[str, int]


# --- Table ----------------------------------------------------------------------------------------------------------

def deviations(path: Path = TABLE) -> list[Deviation]:
    """All of a table; UsageError names what is wrong with it."""
    try:
        found = [Deviation(entry["rule"], entry["reason"].strip(), entry["findings"])
                 for entry in tomllib.loads(path.read_text(encoding="utf-8"))["deviation"]]
    except (OSError, tomllib.TOMLDecodeError, KeyError, AttributeError) as error:
        raise UsageError(f"{path.name}: no table of deviations: {reason(error)}") from None
    places = Counter((each.rule, scope) for each in found for scope in each.findings)
    for each in found:
        if not each.reason or not each.findings:
            raise UsageError(f"{path.name}: {each.rule}: a deviation has a reason and findings")
        for scope, count in each.findings.items():
            wide = not Path(scope).suffix
            if scope.split("/")[0] not in FOLDERS or count < 1 or places[each.rule, scope] > 1:
                raise UsageError(f"{path.name}: {each.rule}: {scope}: no scope of its own with a count")
            if wide and BY_FILE.match(each.rule):
                raise UsageError(f"{path.name}: {each.rule}: {scope}: this rule is explained by file")
    return found


def text_of(table: Iterable[Deviation], head: str) -> str:
    """A table as it is committed, after its first comment."""
    parts = [head.rstrip() + "\n"]
    for each in table:
        counts = "".join(f'"{scope}" = {count}\n' for scope, count in each.findings.items())
        parts.append(f'[[deviation]]\nrule = "{each.rule}"\nreason = """\n{each.reason}"""\n'
                     f"[deviation.findings]\n{counts}")
    return "\n".join(parts)


def _scope_of(finding: Finding, table: Iterable[Deviation]) -> str | None:
    """The narrowest scope of its rule, None without one."""
    scopes = [scope for each in table if each.rule == finding.rule for scope in each.findings
              if finding.file == scope or finding.file.startswith(f"{scope}/")]
    return max(scopes, key=len, default=None)


def judge(found: Iterable[Finding], table: Sequence[Deviation]) -> list[str]:
    """A line for each finding without a deviation, each scope that has more than it states, and each that has none."""
    lines = []
    counts: Counter[tuple[str, str]] = Counter()
    for finding in sorted(found):
        scope = _scope_of(finding, table)
        if scope is None:
            lines.append(f"{finding.file}:{finding.line}: {finding.rule}: no deviation of {TABLE.name}")
        else:
            counts[finding.rule, scope] += 1
    for each in table:
        for scope, stated in each.findings.items():
            number = counts[each.rule, scope]
            if number > stated:
                lines.append(f"{scope}: {each.rule}: {number} findings, {stated} stated; --list {each.rule}")
            elif number == 0:
                lines.append(f"{scope}: {each.rule}: a deviation of {TABLE.name} that is not needed")
    return lines


def lowered(found: Iterable[Finding], table: Sequence[Deviation]) -> list[Deviation]:
    """The table with the counts of these findings where they are fewer, without scopes that have none."""
    counts = Counter((finding.rule, _scope_of(finding, table)) for finding in found)
    fewer = [replace(each, findings={scope: min(stated, counts[each.rule, scope])
                                     for scope, stated in each.findings.items() if counts[each.rule, scope]})
             for each in table]
    return [each for each in fewer if each.findings]


# --- Sources --------------------------------------------------------------------------------------------------------

def build() -> None:
    """Generated headers, and the commands of the compilers."""
    with build_lock():
        for preset, targets in PRESETS.items():
            log = BUILD / "build.log"
            if not build_preset(ROOT, BUILD / preset, targets, log, lambda: None):
                raise UsageError(f"{preset} cannot be built: {log.read_text(encoding='utf-8')[-2000:]}")


def units() -> list[Unit]:
    """All sources, each once for all ports, or once for each of its own."""
    found: dict[tuple[str, str], Unit] = {}
    for preset, targets in PRESETS.items():
        for entry in json.loads((BUILD / preset / "compile_commands.json").read_text(encoding="utf-8")):
            line = shlex.split(entry["command"])
            target = re.search(r"(?:^|/)(\w+)\.dir/", line[line.index("-o") + 1])
            path = Path(entry["file"])
            inside = any(path.is_relative_to(ROOT / folder) for folder in FOLDERS)
            if not inside or target is None or target[1] not in (*targets, "salient_firmware"):
                continue
            source = path.relative_to(ROOT).as_posix()
            port = "" if source.startswith("firmware/") else f"{preset} {target[1]}"
            options = tuple(part for part in line if part.startswith(("-I", "-D")))
            compiler = (line[0], *(part for part in line if part.startswith("-m")))
            found.setdefault((source, port), Unit(source, options, compiler, port))
    return list(found.values())


@cache
def addon() -> Path:
    """The add-on, which comes with cppcheck; UsageError without it."""
    try:
        return next(path for place in ("lib/*/cppcheck", "share/cppcheck", "lib/cppcheck")
                    for path in Path("/usr").glob(f"{place}/addons/misra.py") if shutil.which("cppcheck"))
    except StopIteration:
        raise UsageError("cppcheck is missing: apt-get install cppcheck") from None


def key(unit: Unit) -> str:
    """Hash of what the findings in a source depend on."""
    compiled = tasks.compiled_digest([*unit.compiler, *unit.options], unit.source)
    digest = hashlib.sha256(repr((unit, OPTIONS, tasks.file_digest(addon()), compiled)).encode())
    digest.update((inspect.getsource(analyse) + inspect.getsource(_by_addon)).encode())
    return digest.hexdigest()[:16]


# --- Findings -------------------------------------------------------------------------------------------------------

def copy_sources(folder: Path) -> None:
    """The sources in a folder, because the add-on writes beside them."""
    for name in FOLDERS:
        shutil.copytree(ROOT / name, folder / name)


def analyse(arguments: tuple[Unit, Path]) -> dict[str, Any]:
    """Findings in a source of a folder and in what it includes, and what the rules about several sources need."""
    unit, folder = arguments
    own_paths = tuple(f"-I{ROOT / name}" for name in FOLDERS)
    options = [option.replace(str(ROOT), str(folder), 1) if option.startswith(own_paths) else option
               for option in unit.options]
    with tempfile.TemporaryDirectory(dir=folder, prefix="run-") as name:
        # Ports share sources: each is read at a place of its own, with the paths that its includes have.
        source = Path(name) / Path(unit.source).name
        shutil.copy(folder / unit.source, source)
        beside = f"-I{(folder / unit.source).parent}"
        own = subprocess.run(["cppcheck", "--quiet", "--dump", *OPTIONS, *options, beside, str(source)],
                             capture_output=True, text=True, check=False)
        if own.returncode != 0:
            raise RunFailed(f"{unit.source}: cppcheck: {(own.stdout + own.stderr).strip()[-1000:]}")
        found = [Finding(file, int(line), int(column), rule) for file, line, column, rule in
                 (text.split("\t") for text in own.stderr.splitlines() if text)]
        found += _by_addon([f"{source}.dump"])
        if strange := [each for each in found if not each.file.startswith((str(folder), str(BUILD)))]:
            raise RunFailed(f"{unit.source}: cppcheck cannot read it: {strange[0].rule}")
        records = [json.loads(line) for line in Path(f"{source}.ctu-info").read_text(encoding="utf-8").splitlines()]

    def named(path: str) -> str:
        return unit.source if path == str(source) else path.removeprefix(f"{folder}/")

    for record in records:
        record["data"] = [{**item, **({"file": named(item["file"])} if "file" in item else {})}
                          for item in record["data"]]
    return {"found": sorted({each._replace(file=named(each.file)) for each in found}), "records": records}


def _by_addon(files: Sequence[str]) -> list[Finding]:
    """Findings of the add-on, by the place and number of the rule."""
    done = subprocess.run([sys.executable, str(addon()), "--cli", *files], capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1) or "Traceback" in done.stderr:
        raise RunFailed(f"{files[0]}: {addon().name}: {done.stderr.strip()[-1000:]}")
    entries = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    return [Finding(entry["file"], entry["linenr"], entry["column"], entry["errorId"].removeprefix("c2012-"))
            for entry in entries]


def across(results: Sequence[tuple[Unit, Mapping[str, Any]]], folder: Path) -> Iterator[Finding]:
    """Findings of the rules about several sources, in the firmware with each port."""
    for port in sorted({unit.port for unit, _ in results} - {""}):
        names = []
        for number, (unit, result) in enumerate(results):
            if unit.port in ("", port):
                names.append(str(folder / f"{number}.ctu-info"))
                Path(names[-1]).write_text("".join(json.dumps(record) + "\n" for record in result["records"]),
                                           encoding="utf-8")
        yield from _by_addon(names)


def measure(out: Path) -> list[Finding]:
    """All findings in sources of firmware/ and hal/."""
    addon()
    build()
    results = []
    with tempfile.TemporaryDirectory(prefix="salient-") as name:
        folder = Path(name)
        copy_sources(folder)
        looks = [tasks.Task(key(unit), (unit, folder)) for unit in units()]
        with Progress(steps_of(len(looks), sys.stderr), sys.stderr, len(looks)) as progress:
            for task, result in tasks.run(looks, analyse, out):
                results.append((task.arguments[0], result))
                progress.item(task.arguments[0].source)
        results.sort(key=lambda item: (item[0].source, item[0].port))
        found = {Finding(*each) for _, result in results for each in result["found"]}
        found |= set(across(results, folder))
    return sorted(each for each in found if each.file.split("/")[0] in FOLDERS)


def main() -> int:
    """Measures, judges or writes; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m salient.experiments.misra", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)
    parser.add_argument("--list", nargs="*", metavar="RULE", help="list the findings of these rules, by default of all")
    parser.add_argument("--write", action="store_true", help=f"state fewer findings in {from_root(TABLE)}")
    parser.add_argument("--out", type=Path, default=OUT / "misra", metavar="DIR", help=f"default {OUT}/misra")
    options = parser.parse_args()
    begin_s = processor_s()
    table = deviations()
    found = measure(options.out.resolve())
    if options.list is not None:
        for finding in found:
            if not options.list or finding.rule in options.list:
                text = (ROOT / finding.file).read_text(encoding="utf-8").splitlines()[finding.line - 1].strip()
                print(f"{finding.file}:{finding.line}: {finding.rule}: {text}")
    if options.write:
        table = lowered(found, table)
        head = TABLE.read_text(encoding="utf-8").partition("[[")[0]
        TABLE.write_text(text_of(table, head), encoding="utf-8")
    lines = judge(found, table)
    for line in lines:
        print(line)
    print(f"{len(found)} findings of {len({finding.rule for finding in found})} rules in "
          f"{processor_s() - begin_s:.0f} s of CPU time: {len(lines)} are not as {from_root(TABLE)} says")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
