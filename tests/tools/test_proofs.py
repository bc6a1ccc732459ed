"""Proofs of the firmware: the table fits sources and harnesses, a proof holds, and fails with its bug."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from salient.errors import UsageError
from salient.experiments import proofs as module
from salient.experiments.proofs import HARNESSES, SUMMARY, Proof, check, functions, judge, key, program, proofs, summary

EVERY = proofs()
GOOD = {"holds": True, "bug_found": True, "processor_s": 1.0}


@pytest.mark.parametrize("proof", EVERY, ids=lambda proof: proof.name)
def test_the_text_of_its_bug_is_there_once(proof: Proof) -> None:
    assert proof.bug.new in proof.bug.text()


def test_every_harness_is_run_once() -> None:
    harnesses = [name for path in HARNESSES.glob("*.c")
                 for name in re.findall(r"^void prove_(\w+)\(", path.read_text(encoding="utf-8"), re.MULTILINE)]
    assert sorted(harnesses) == sorted(proof.name for proof in EVERY)


def test_a_function_counts_only_when_all_its_proofs_hold_and_find_their_bugs() -> None:
    of = [proof for proof in EVERY if proof.name in ("multiply", "products")]
    name = "firmware/fixed/fixed.h: fixed_multiply"
    assert all(name in proof.functions for proof in of) and len(of) == 2
    counts = [summary([(of[0], GOOD), (of[1], result)])["proved"]
              for result in (GOOD, {**GOOD, "holds": False}, {**GOOD, "bug_found": False})]
    assert counts[0] > counts[1] == counts[2]


def test_functions_behind_assertions_and_macros_are_counted() -> None:
    assert {"firmware/fixed/fixed.h: fixed_saturate", "firmware/fixed/divide.c: fixed_divide"} <= set(functions())
    assert len(functions()) > 1000


def test_the_committed_summary_is_of_these_proofs_and_functions() -> None:
    note = json.loads(SUMMARY.read_text(encoding="utf-8"))
    assert note["proofs"] == len(EVERY) and note["failed"] == note["bug_not_found"] == []
    assert note["proved"] == len({name for proof in EVERY for name in proof.functions})


@pytest.mark.parametrize(("text", "message"), [
    ("", "no table"), ('[[proof]]\nname = "a"', "no table"),
    ('[[proof]]\nname = "a"\nsource = "fixed.c"\nbug = ["f", "a", "b"]\nproves = { "f.c" = ["g"] }',
     "no function f.c: g"),
    ('[[proof]]\nname = "a"\nsource = "fixed.c"\nbug = ["f", "a", "b"]\nproves = {}', "fixed.c has no prove_a"),
])
def test_a_wrong_table_is_an_error_that_names_it(text: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "proofs.toml").write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match=message):
        proofs(tmp_path / "proofs.toml")


def test_without_apt_the_program_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(module, "CBMC", tmp_path / "none")
    monkeypatch.setattr("shutil.which", lambda name: None)
    with pytest.raises(UsageError, match="cbmc is missing, and there is no apt-get"):
        program()


def test_a_result_is_kept_for_these_sources_only(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    source = tmp_path / "a.c"
    proof = Proof("a", source, (), EVERY[0].bug, 1)
    keys = []
    for text in ("int a;", "int b;", "int a;"):
        source.write_text(text, encoding="utf-8")
        keys.append(key(proof))
    assert keys[0] == keys[2] != keys[1]


@pytest.mark.in_turns
def test_a_wrong_claim_an_overflow_and_a_longer_loop_fail(tmp_path: Path) -> None:
    claims = {"int32_t a": "CLAIM(a != 7);", "int32_t b": "(void)(b + 1);", "unsigned c": "while (c != 0) { c /= 2; }",
              "uint32_t d": "CLAIM(d + 1u == 0u || d + 1u > d);"}
    for holds, (argument, body) in zip([False, False, False, True], claims.items(), strict=True):
        source = tmp_path / "a.c"
        source.write_text(f'#include "proof.h"\nvoid prove_a({argument}) {{ {body} }}\n', encoding="utf-8")
        found, failed = check(Proof("a", source, (), EVERY[0].bug, 3), program())
        assert found == holds and bool(failed) != holds, body
    source.write_text("no C", encoding="utf-8")
    with pytest.raises(UsageError, match="CBMC ends with code"):
        check(Proof("a", source, (), EVERY[0].bug, 3), program())


@pytest.mark.in_turns
@pytest.mark.parametrize("proof", [proof for proof in EVERY if not proof.slow], ids=lambda proof: proof.name)
def test_a_proof_holds_and_fails_with_its_bug(proof: Proof) -> None:
    result = judge((proof, program()))
    assert result["holds"], result["failed"]
    assert result["bug_found"]
