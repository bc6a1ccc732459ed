"""The computed bound of an interrupt: of small programs it is known by hand; of the firmware it permits every run."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from salient.bench.programs import image
from salient.config import CONTROLLERS
from salient.elf import ElfImage
from salient.errors import UsageError
from salient.paths import ROOT
from salient.target import long_run
from salient.target.bound import Model
from salient.target.bound_facts import FILE, Facts, Names, read_facts
from salient.target.bound_report import bound, by_module
from salient.target.c_loops import loop_statements

CORTEX_M4 = ["arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb"]
RV32 = ["riscv64-unknown-elf-gcc", "-march=rv32imac", "-mabi=ilp32"]

FUNCTION = """
    .macro function name
    .global \\name
    .type \\name, %function
    \\name:
    .endm
    .text
"""
HANDLER = {"arm-none-eabi-gcc": FUNCTION + """
    .syntax unified
    .thumb
    function control_handler
        push {r4, lr}
        bl f
    function control_handler_return
        pop {r4, pc}
""", "riscv64-unknown-elf-gcc": FUNCTION + """
    function control_handler
        addi sp, sp, -16
        call f
    function control_handler_return
        addi sp, sp, 16
        mret
"""}
HANDLER_INSTRUCTIONS = {"arm-none-eabi-gcc": 3, "riscv64-unknown-elf-gcc": 4}


@pytest.fixture
def longest(tmp_path: Path):
    """Bound of a function f in assembly, without the handler that calls it."""

    def compute(source: str, facts: Facts | None = None, compiler: list[str] = CORTEX_M4) -> int:
        return model(tmp_path, source, facts, compiler).solve().instructions - HANDLER_INSTRUCTIONS[compiler[0]]

    return compute


def model(folder: Path, source: str, facts: Facts | None = None, compiler: list[str] = CORTEX_M4) -> Model:
    (folder / "x.s").write_text(HANDLER[compiler[0]] + source)
    subprocess.run([*compiler, "-g", "-nostdlib", "-Wl,-e,control_handler", str(folder / "x.s"), "-o",
                    str(folder / "x.elf")], check=True)
    return Model(ElfImage(folder / "x.elf"), facts or Facts(), "only", root=folder)


def loop(statement: str, file: Path, **bound: str) -> dict:
    return {"file": str(file), "statement": statement, "reason": "test", **bound}


# --- control flow ---------------------------------------------------------------------------------------------------

def test_longer_branch_counts(longest):
    assert longest("""
    function f
        cmp r0, #0          @ 1
        beq 1f              @ 2
        adds r1, #1         @ 3
        adds r1, #1         @ 4
        b 2f                @ 5
    1:  adds r1, #2
    2:  bx lr               @ 6
    """) == 6


@pytest.mark.parametrize(("branch", "instructions"), [("cbz r0, 1f", 3), ("cbnz r0, 1f", 3), ("bne.w 1f", 3)])
def test_each_kind_of_branch_has_two_ways(longest, branch, instructions):
    assert longest(f"function f\n {branch}\n nop\n 1: bx lr\n") == instructions


def test_instructions_skipped_in_an_it_block_count_as_in_the_plugin(longest):
    assert longest("function f\n cmp r0, #0\n ite eq\n moveq r0, #1\n movne r0, #2\n bx lr\n") == 5


def test_conditional_return_may_be_taken_or_not(longest):
    assert longest("function f\n cmp r0, #0\n it eq\n bxeq lr\n nop\n nop\n bx lr\n") == 6
    assert longest("function f\n push {r4, lr}\n cmp r0, #0\n it ne\n popne {r4, pc}\n pop {r4, pc}\n") == 5


@pytest.mark.parametrize("width", ["tbb", "tbh"])
def test_switch_table(longest, width):
    index, unit = ("r0", ".byte") if width == "tbb" else ("r0, lsl #1", ".hword")
    assert longest(f"""
    function f
        {width} [pc, {index}]   @ 1
    0:  {unit} (1f - 0b) / 2, (2f - 0b) / 2, (3f - 0b) / 2
        .balign 2
    1:  bx lr
    2:  nop                     @ 2
        nop                     @ 3
    3:  nop                     @ 4
        bx lr                   @ 5
    """) == 5


@pytest.mark.parametrize("width", ["tbb", "tbh"])
def test_constants_behind_a_switch_table_are_not_part_of_it(longest, width):
    index, unit = ("r0", ".byte") if width == "tbb" else ("r0, lsl #1", ".hword")
    assert longest(f"""
    function f
        cmp r0, #1              @ 1
        bhi 2f                  @ 2
        {width} [pc, {index}]   @ 3
    0:  {unit} (1f - 0b) / 2, (2f - 0b) / 2
        .balign 4
        .word 0x20000001, 0x00010003
    1:  bx lr
    2:  nop                     @ 4
        bx lr                   @ 5
    """) == 5


def test_literals_are_not_code(longest):
    assert longest("function f\n ldr r0, =0x12345678\n b 1f\n .ltorg\n 1: bx lr\n") == 3


def test_each_call_counts_with_the_way_back(longest):
    source = """
    function f
        push {r4, lr}       @ 1
        bl g                @ 2, 3 to 5
        bl g                @ 6, 7 to 9
        pop {r4, pc}        @ 10
    function g
        nop
        nop
        bx lr
    """
    assert longest(source) == 10


def test_tail_call_returns_to_the_caller(longest):
    assert longest("function f\n nop\n b.w g\n function g\n nop\n bx lr\n") == 4


def test_path_that_never_returns_has_no_duration(longest):
    assert longest("function f\n cbz r0, 1f\n bx lr\n 1: nop\n 2: nop\n b 2b\n") == 2


def test_call_that_never_returns_has_no_duration(longest):
    source = "function f\n push {r4, lr}\n cbz r0, 1f\n pop {r4, pc}\n 1: nop\n bl g\n pop {r4, pc}\n"
    assert longest(source + "function g\n b g\n") == 3
    assert longest(source + "function g\n bx lr\n") == 6


def test_handler_is_named_by_its_symbols(tmp_path):
    source = "function f\n bx lr\n function deferred_handler\n bl f\n function deferred_handler_return\n bx lr\n"
    assert model(tmp_path, source).solve().instructions == 4
    assert Model(ElfImage(tmp_path / "x.elf"), Facts(), "only", "deferred_handler", tmp_path).solve().instructions == 3
    with pytest.raises(UsageError, match="no symbol other"):
        Model(ElfImage(tmp_path / "x.elf"), Facts(), "only", "other", tmp_path)


@pytest.mark.parametrize(("source", "message"), [
    ("function f\n blx r3\n bx lr\n", "f: .*: blx r3: a call through a pointer has no bound"),
    ("function f\n bx r3\n", "f: .*: bx r3: a jump through a pointer has no bound"),
    ("function f\n ldr pc, [r0, #4]\n", "f: .*: a jump through a pointer has no bound"),
    ("function f\n push {lr}\n bl f\n pop {pc}\n", "recursion: f"),
    ("function f\n nop\n .word 0x12345678\n", "f: .*: execution continues in data"),
])
def test_unknown_flow_is_an_error(longest, source, message):
    with pytest.raises(UsageError, match=message):
        longest(source)


def test_flow_on_rv32(longest):
    assert longest("""
    function f
        beqz a0, 1f         # 1
        nop                 # 2
        bltu a0, a1, 1f     # 3
        nop                 # 4
    1:  tail g              # 5
    function g
        nop                 # 6
        ret                 # 7
    """, compiler=RV32) == 7


def test_switch_table_on_rv32(longest):
    assert longest("""
    function f
        lui a4, %hi(table)          # 1
        slli a5, a0, 2              # 2
        addi a4, a4, %lo(table)     # 3
        add a5, a5, a4              # 4
        lw a5, 0(a5)                # 5
        jr a5                       # 6
    1:  ret
    2:  nop                         # 7
        ret                         # 8
    .section .rodata
    table: .word 1b, 2b, 0
    """, compiler=RV32) == 8


# --- loops ----------------------------------------------------------------------------------------------------------

BOTTOM_TESTED = """
    function f
        movs r0, #5     @ 1
    1:  nop
        subs r0, #1
        bne 1b          @ repeat
        bx lr           @ last
"""
TOP_TESTED = """
    function f
        movs r0, #5     @ 1
    1:  cbz r0, 2f      @ test
        subs r0, #1
        b 1b            @ repeat
    2:  bx lr           @ last
"""


def test_loop_without_a_bound_is_an_error_that_names_its_line(longest, tmp_path):
    with pytest.raises(UsageError, match=rf"f: the loop at {tmp_path}/x\.s:\d+ has no bound"):
        longest(BOTTOM_TESTED)


LEFT_BY_RETURN = """
    function f
        movs r0, #5     @ 1
    1:  cmp r0, #0      @ test
        it eq
        bxeq lr         @ last
        subs r0, #1
        b 1b            @ repeat
"""
AROUND_THE_ENTRY = """
    function f
        subs r0, #1
        bne f           @ repeat
        bx lr           @ last
"""


@pytest.mark.parametrize(("source", "bound", "instructions"), [
    (LEFT_BY_RETURN, {"iterations": "5"}, 1 + 5 * 5 + 3),
    (AROUND_THE_ENTRY, {"iterations": "5"}, 5 * 2 + 1),
    (BOTTOM_TESTED, {"iterations": "5"}, 1 + 5 * 3 + 1),
    (BOTTOM_TESTED, {"tests": "5"}, 1 + 5 * 3 + 1),
    (TOP_TESTED, {"iterations": "5"}, 1 + 5 * 3 + 1 + 1),
    (TOP_TESTED, {"tests": "6"}, 1 + 5 * 3 + 1 + 1),
    (TOP_TESTED, {"iterations": "2 * 3 - 1"}, 17 + 1),
])
def test_loop_counts_with_its_bound(longest, tmp_path, source, bound, instructions):
    facts = Facts.model_validate({"loop": [loop("@ repeat", tmp_path / "x.s", **bound)]})
    assert longest(source, facts) == instructions


def test_bound_of_zero_excludes_the_loop(longest, tmp_path):
    source = "function f\n cbz r0, 2f\n 1: subs r0, #1\n bne 1b @ repeat\n 2: bx lr\n"
    for tests, instructions in (("0", 2), ("4", 2 + 4 * 2)):
        facts = Facts.model_validate({"loop": [loop("@ repeat", tmp_path / "x.s", tests=tests)]})
        assert longest(source, facts) == instructions


NESTED = """
    function f
        movs r0, #5     @ 1
    1:  movs r1, #3     @ outer body
    2:  subs r1, #1
        bne 2b          @ inner
        subs r0, #1
        bne 1b          @ outer
        bx lr
"""


def test_nested_loops_multiply(longest, tmp_path):
    facts = Facts.model_validate({"loop": [loop("@ inner", tmp_path / "x.s", iterations="3"),
                                           loop("@ outer", tmp_path / "x.s", iterations="5")]})
    assert longest(NESTED, facts) == 1 + 5 * (1 + 3 * 2 + 2) + 1


def test_bound_of_a_loop_is_not_taken_for_its_inner_loop(longest, tmp_path):
    facts = Facts.model_validate({"loop": [loop("@ outer", tmp_path / "x.s", iterations="5")]})
    with pytest.raises(UsageError, match="has no bound"):
        longest(NESTED, facts)


def test_facts_of_another_configuration_do_not_apply(longest, tmp_path):
    facts = Facts.model_validate({"loop": [
        loop("@ repeat", tmp_path / "x.s", iterations="1") | {"configurations": ["other"]},
        loop("@ repeat", tmp_path / "x.s", iterations="5") | {"configurations": ["only"]}]})
    assert longest(BOTTOM_TESTED, facts) == 17


def test_call_in_a_loop_counts_in_each_iteration(longest, tmp_path):
    source = """
    function f
        push {r4, lr}
        movs r4, #5
    1:  bl g
        subs r4, #1
        bne 1b          @ repeat
        pop {r4, pc}
    function g
        nop
        bx lr
    """
    facts = Facts.model_validate({"loop": [loop("@ repeat", tmp_path / "x.s", iterations="5")]})
    assert longest(source, facts) == 2 + 5 * (3 + 2) + 1


@pytest.mark.parametrize(("size", "iterations"), [(16, 4), (40, 10)])
def test_loops_of_a_copying_function_follow_from_the_constant_size_of_each_call(longest, tmp_path, size, iterations):
    source = f"""
    function f
        push {{r4, lr}}
        movs r2, #{size}
        bl fill
        movs r2, #4
        bl fill
        pop {{r4, pc}}
    function fill
    1:  subs r2, #4
        bne 1b              @ fill
        bx lr
    """
    facts = Facts.model_validate({"loop": [loop("@ fill", tmp_path / "x.s", iterations="size // 4")]})
    assert longest(source, facts) == 6 + (2 * iterations + 1) + (2 + 1)
    facts = Facts.model_validate({"library": [{"function": "fill", "tests": ["size // 4"], "reason": "test"}]})
    assert longest(source, facts) == 6 + (2 * iterations + 1) + (2 + 1)
    with pytest.raises(UsageError, match="fill: .*: its size is no constant"):
        longest(source.replace("movs r2, #4\n", "mov r2, r3\n"), facts)
    facts = Facts.model_validate({"library": [{"function": "fill", "tests": ["1", "2"], "reason": "test"}]})
    with pytest.raises(UsageError, match="fill has 1 loops, not 2"):
        longest(source, facts)


def compiled(folder: Path, body: str, compiler: list[str], optimisation: str) -> Model:
    """Model of a function f in C with a body."""
    (folder / "firmware").mkdir()
    (folder / "firmware" / "limit.h").write_text("#define LIMIT 9\n")
    (folder / "x.c").write_text("struct machine { unsigned LIMIT; };\n__attribute__((used)) void f(volatile int *to,"
                                f" const struct machine *machine) {{\n{body}\n}}\n")
    (folder / "x.s").write_text(HANDLER[compiler[0]])
    subprocess.run([*compiler, optimisation, "-g1", "-nostdlib", "-Wl,-e,control_handler", str(folder / "x.s"),
                    str(folder / "x.c"), "-o", str(folder / "x.elf")], check=True)
    return Model(ElfImage(folder / "x.elf"), Facts(), "only", root=folder)


@pytest.mark.in_turns
@pytest.mark.parametrize("compiler", [CORTEX_M4, RV32], ids=["cortex-m4", "rv32"])
@pytest.mark.parametrize("optimisation", ["-O1", "-O2", "-Os"])
@pytest.mark.parametrize(("statement", "iterations"), [
    ("for (unsigned i = 0; i < 70; i++)", 70), ("for (unsigned i = 0; i < machine->LIMIT; i++)", 9)])
def test_counted_for_needs_no_fact(tmp_path, compiler, optimisation, statement, iterations):
    found = compiled(tmp_path, f"(void)machine; {statement} {{\n*to = 1;\n}}", compiler, optimisation).solve()
    stores = [one.address for one in found.model.image.instructions()
              if one.function == "f" and one.mnemonic in ("str", "sw")]
    assert [found.executed[address] for address in stores] == [iterations]


@pytest.mark.parametrize("compiler", [CORTEX_M4, RV32], ids=["cortex-m4", "rv32"])
@pytest.mark.parametrize("body", [
    "while (*to) {\n*to = 1;\nfor (unsigned i = 0; i < 2; i++) {\n*to = 2;\n}\n}",
    "do {\nfor (unsigned i = 0; i < 2; i++) {\n*to = 2;\n}\n} while (*to);",
    "for (;;) {\nif (*to) {\nreturn;\n}\nfor (unsigned i = 0; i < 2; i++) {\n*to = 2;\n}\n}",
])
def test_unrolled_inner_loop_is_no_bound_of_the_outer_loop(tmp_path, compiler, body):
    with pytest.raises(UsageError, match=r"x\.c:\d+ has no bound"):
        compiled(tmp_path, body, compiler, "-O2")


def test_statements_of_loops_in_c():
    source = """
    #define EACH(i) for (;;)
    void f(int n) {
        for (int i = 0;
             i < n; i++) /* for (a;b;c) */ { // while (x)
            while (n > 0)
                if (n == '}') { n--; } else
                    n = n - 2;
            do {
                n++;
            } while (n < g("{"));
        }
        while (n) for (;;) { n--; }
    }
    """
    assert [(one.first, one.last, one.head) for one in loop_statements(source)] == [
        (4, 12, "for (int i = 0; i < n; i++)"), (6, 8, "while (n > 0)"), (9, 11, "while (n < g( ))"),
        (13, 13, "while (n)"), (13, 13, "for (;;)")]
    assert loop_statements("void f(void) { while (1) {") == []


# --- paths ----------------------------------------------------------------------------------------------------------

TWO_CALLS = """
    function f
        push {r4, lr}       @ 1
        cbz r0, 1f          @ 2
        bl g                @ 3, 4 to 6
    1:  cbz r1, 2f          @ 7
        bl h                @ 8, 9, 10
    2:  cbz r2, 3f          @ 11
        bl g                @ 12, 13 to 15
    3:  pop {r4, pc}        @ 16
    function g
        nop
        nop
        bx lr
    function h
        nop
        bx lr
"""


@pytest.mark.parametrize(("facts", "instructions"), [
    ({}, 16),
    ({"never": [{"functions": ["g"], "configurations": ["only"]}]}, 16 - 8),
    ({"never": [{"functions": ["g"], "configurations": ["other"]}]}, 16),
    ({"never": [{"functions": ["g", "h"], "configurations": ["only"]}]}, 16 - 11),
    ({"exclusive": [{"functions": ["g"], "excludes": ["h"]}]}, 16 - 3),
    ({"exclusive": [{"functions": ["g"], "excludes": ["h"], "configurations": ["other"]}]}, 16),
    ({"at_most": [{"function": "g", "times": "1"}]}, 16 - 4),
    ({"at_most": [{"function": "g", "times": "2"}]}, 16),
])
def test_facts_exclude_paths(longest, facts, instructions):
    complete = {kind: [{"reason": "test", **one} for one in of] for kind, of in facts.items()}
    assert longest(TWO_CALLS, Facts.model_validate(complete)) == instructions


def test_executions_of_a_function_do_not_count_its_inner_loop(longest, tmp_path):
    source = BOTTOM_TESTED.replace("function f", "function g") + """
    function f
        push {r4, lr}
        bl g
        bl g
        pop {r4, pc}
    """
    facts = Facts.model_validate({"loop": [loop("@ repeat", tmp_path / "x.s", iterations="5")],
                                  "at_most": [{"function": "g", "times": "2", "reason": "test"}]})
    assert longest(source, facts) == 4 + 2 * 17
    facts = Facts.model_validate({"loop": [loop("@ repeat", tmp_path / "x.s", iterations="5")],
                                  "at_most": [{"function": "g", "times": "1", "reason": "test"}]})
    with pytest.raises(UsageError, match="no path satisfies the facts"):
        longest(source, facts)


def test_observed_executions_contradict_a_model_that_excludes_them(tmp_path):
    made = model(tmp_path, TWO_CALLS)
    executed = made.solve().executed
    assert made.contradiction(executed) is None
    assert made.contradiction({address: 3 * count for address, count in executed.items()}, 3) is None
    assert made.contradiction({address: 2 * count for address, count in executed.items()}) is not None
    wrong = Facts.model_validate({"exclusive": [{"functions": ["g"], "excludes": ["h"], "reason": "test"}]})
    assert model(tmp_path, TWO_CALLS, wrong).contradiction(executed) == "g exclude h"
    wrong = Facts.model_validate({"never": [{"functions": ["h"], "configurations": ["only"], "reason": "test"}]})
    assert model(tmp_path, TWO_CALLS, wrong).contradiction(executed) == "never h"
    beyond = made.image.symbols()["h"] & ~1
    partly = {address: count for address, count in executed.items() if address != beyond}
    assert "a block of which only a part was executed" in str(made.contradiction(partly))


# --- the file of facts ----------------------------------------------------------------------------------------------

@pytest.mark.parametrize(("text", "message"), [
    ('[[at_most]]\nfunction = "no_such"\ntimes = "1"\nreason = "r"', "no function no_such in the firmware"),
    ('[[never]]\nfunctions = ["no_such"]\nconfigurations = []\nreason = "r"', "no function no_such in the firmware"),
    ('[[loop]]\nfile = "firmware/drive/drive.c"\nstatement = "while (tea)"\ntests = "1"\nreason = "r"',
     r"firmware/drive/drive.c has no loop while \(tea\)"),
    ('[[loop]]\nfile = "firmware/drive/drive.c"\nstatement = "drive"\nreason = "r"',
     "must have either iterations or tests"),
    ('[[loop]]\nfile = "firmware/drive/drive.c"\nstatement = "drive"\ntests = "1"', "reason"),
    ('[[loop]]\nfile = "firmware/drive/drive.c"\nstatement = "drive"\ntests = "1"\nreason = "r"', "has no loop drive"),
    ('[[loops]]\nfile = "firmware/drive/drive.c"', "loops"),
])
def test_mistake_in_the_file_of_facts_is_an_error(tmp_path, text, message):
    (tmp_path / "bounds.toml").write_text(text)
    with pytest.raises(UsageError, match=message):
        read_facts(tmp_path / "bounds.toml")


@pytest.mark.parametrize(("machine", "phases"), [("saturating", 3), ("finite_element", 4)])
def test_names_have_the_values_of_image_and_headers(machine, phases):
    names = Names(ElfImage(image(machine, "cortex-m4")))
    assert names.value("phases") == phases
    assert names.value("2 * (MACHINE_COLUMNS - 1) // 3 % 10 + more", more=5) == 26 % 10 + 5
    for wrong in ("no_such_name", "1.5", "phases.x", "f(1)", "1 +", "-1"):
        with pytest.raises(UsageError, match="must consist of"):
            names.value(wrong)


# --- the firmware ---------------------------------------------------------------------------------------------------

RUNS = [*(("cortex-m4", variant) for variant in long_run.VARIANTS), *(("rv32", variant) for variant in CONTROLLERS)]


@pytest.mark.in_turns
@pytest.mark.parametrize(("build", "variant"), RUNS)
def test_every_run_is_a_path_within_the_facts_and_the_bound(variant, build):
    found = bound(variant, build)
    profile = long_run.profile(long_run.read_input(long_run.committed(variant)), build=build)
    addresses = [one.address for one in found.model.image.instructions()]
    longest = dict(zip(addresses, profile.trace.in_longest.tolist(), strict=True))
    assert sum(longest.values()) == profile.metrics()["max"] <= found.instructions
    assert found.model.contradiction(longest) is None
    every = dict(zip(addresses, profile.trace.inside.tolist(), strict=True))
    assert found.model.contradiction(every, len(profile.interrupts)) is None
    assert profile.deferred_metrics()["max"] <= bound(variant, build, "deferred").instructions


def test_longest_path_has_the_instructions_of_the_bound():
    found = bound("salient", "cortex-m4")
    for parts in (found.by_function(), found.by_line()):
        assert sum(count for _, count, _ in parts) == found.instructions
    modules = by_module(found)
    assert abs(sum(modules.values()) - found.instructions) <= len(modules)
    assert {"phase_map", "predictive_torque"} <= set(modules)
    assert not {"bp_network", "ditc_hysteresis", "pwm_ditc"} & set(modules)


@pytest.mark.in_turns
def test_each_variant_has_facts_of_its_configuration():
    facts = read_facts(FILE)
    known = {of.controller for of in long_run.VARIANTS.values()}
    named = [one.configurations for one in (*facts.loop, *facts.never, *facts.exclusive, *facts.at_most)]
    assert set().union(*(of for of in named if of is not None)) == known


MORE_PHASES = {("five_phases", "traditional"): 970, ("five_phases", "paper"): 1170, ("five_phases", "salient"): 2800,
               ("six_phases", "traditional"): 2430, ("six_phases", "paper"): 2630, ("six_phases", "salient"): 4880}
"""Instructions of the control interrupt (docs/machines/file.md). Loops over six phases are unrolled four times, and
each pass counts as four phases: the bound of six is too high."""


@pytest.mark.in_turns
@pytest.mark.parametrize(("name", "controller"), MORE_PHASES)
def test_five_and_six_phases_have_the_bound_that_the_documents_state(name, controller):
    elf = ElfImage(image(str(ROOT / "tests" / "machines" / f"{name}.toml"), "cortex-m4"))
    most = MORE_PHASES[name, controller]
    assert 0.97 * most < Model(elf, read_facts(), controller).solve().instructions <= most
