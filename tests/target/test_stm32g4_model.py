"""Register-level model of the STM32G474RE: small bare-metal programs, each with one subject, by the reference manual.

The programs of stm32g4/ know neither the port nor the model: they check themselves and end with the line of the first
check that fails."""

from __future__ import annotations

import os
import subprocess
from functools import cache
from pathlib import Path

import pytest

from salient.paths import BUILD, ROOT

SOURCES = ROOT / "tests" / "target" / "stm32g4"
MODEL = Path(os.environ.get("SALIENT_STM32G4", BUILD / "host" / "bin" / "salient_stm32g4"))
"""Another one, with a mistake: salient.experiments.board_mistakes."""
COMPILER = ["arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-O1", "-ffreestanding", "-nostdlib", "-Wall", "-Wextra",
            "-Werror", "-T", str(SOURCES / "part.ld"), str(SOURCES / "part.c")]
VIOLATION = 70


@cache
def _image(folder: Path, name: str, definitions: tuple[str, ...]) -> Path:
    image = folder / f"{name}{len(definitions)}{'_'.join(definitions)}.elf".replace("=", "_").replace("/", "_")
    subprocess.run([*COMPILER, *(f"-D{item}" for item in definitions), str(SOURCES / f"{name}.c"), "-lgcc", "-o",
                    str(image)], check=True)
    return image


def run(folder: Path, name: str, *options: str, definitions: tuple[str, ...] = ()) -> subprocess.CompletedProcess[str]:
    """Runs a program alone on the model."""
    return subprocess.run([str(MODEL), str(_image(folder, name, definitions)), "--alone", *options],
                          capture_output=True, text=True, check=False, timeout=120)


def passes(result: subprocess.CompletedProcess[str]) -> bool:
    """True when every check of the program held; else the message names the line."""
    assert result.returncode == 0, (f"exit code {result.returncode}, a line of the program or {VIOLATION}: "
                                    f"{result.stderr}")
    return True


def test_exceptions_come_in_the_order_of_their_priorities(tmp_path: Path) -> None:
    assert passes(run(tmp_path, "nvic"))


@pytest.mark.parametrize(("name", "options"), [
    ("adc", ("--analogue", "PA0=1234", "--analogue", "PA1=3000")),
    ("breaks", ("--wire", "PB0=PB12")),
    ("encoder", ("--wire", "PB0=PA0", "--wire", "PB1=PA1", "--wire", "PB2=PA5")),
    ("fdcan", ()),
    ("flash", ()),
    ("torn", ()),
    ("exti", ()),
    ("comparators", ()),
])
def test_peripheral_behaves_as_the_manual_says(tmp_path: Path, name: str, options: tuple[str, ...]) -> None:
    assert passes(run(tmp_path, name, *options))


PERIOD = 300


def _level(mode: int, centred: bool, compare: int, tick: int) -> int:
    """Output at a tick of the period, by the definition of the modes in the manual."""
    down = centred and tick >= PERIOD
    count = 2 * PERIOD - tick if down else tick
    active = count <= compare if down else count < compare
    return {4: 0, 5: 1, 6: int(active), 7: int(not active)}[mode]


@pytest.mark.parametrize("alignment", [0, 1, 2, 3])
@pytest.mark.parametrize("mode", [4, 5, 6, 7])
def test_edges_of_every_compare_value_follow_the_mode(tmp_path: Path, mode: int, alignment: int) -> None:
    trace = tmp_path / "edges.txt"
    assert passes(run(tmp_path, "pwm", "--trace", str(trace), "PC0",
                      definitions=(f"MODE={mode}", f"ALIGNMENT={alignment}", f"PERIOD={PERIOD}")))
    edges = [(int(cycle), int(level)) for cycle, _, level in map(str.split, trace.read_text().splitlines())]
    length = 2 * PERIOD if alignment else PERIOD + 1
    periods = PERIOD + 2  # compare 0 in the first one and after the first write, then 1 to PERIOD
    compares = [0, *range(PERIOD + 1)][:periods]
    expected = [_level(mode, alignment > 0, compare, tick) for compare in compares for tick in range(length)]
    changes = [i for i in range(1, len(expected)) if expected[i] != expected[i - 1]]
    found = [cycle for cycle, _ in edges[1:]]
    if not changes:
        assert [level for _, level in edges][-1:] == [expected[0]]
        return
    start = found[0] - changes[0] if edges[0][1] == expected[0] else edges[0][0]
    shown = [cycle - start for cycle in found if 0 < cycle - start < len(expected)]
    assert shown == changes


@pytest.mark.parametrize(("code", "ticks"), [(0, 0), (1, 1), (0x7F, 127), (0x80, 128), (0xBF, 254), (0xC0, 256),
                                             (0xDF, 504), (0xE0, 512), (0xFF, 1008)])
def test_dead_time_delays_the_edges_that_switch_on(tmp_path: Path, code: int, ticks: int) -> None:
    trace = tmp_path / "edges.txt"
    assert passes(run(tmp_path, "dead_time", "--trace", str(trace), "PC0", "PC13", definitions=(f"DTG={code}",)))
    edges = [(int(cycle), pin, int(level)) for cycle, pin, level in map(str.split, trace.read_text().splitlines())]
    falls = {pin: [cycle for cycle, at, level in edges if at == pin and not level] for pin in ("PC0", "PC13")}
    rises = {pin: [cycle for cycle, at, level in edges if at == pin and level] for pin in ("PC0", "PC13")}
    for on, off in (("PC0", "PC13"), ("PC13", "PC0")):
        fall = next(cycle for cycle in falls[off] if cycle > edges[0][0] + 2000)
        assert [cycle - fall for cycle in rises[on] if cycle >= fall][:1] == [ticks], (on, edges)


@pytest.mark.parametrize(("case", "text"), list(enumerate([
    "TIM1_CR1 (0x40012C00), value 0x1: its clock is off, RCC_APB2ENR bit 11",
    "TIM1_CR1 (0x40012C00), value 0x400: reserved bits 0x400",
    "TIM1_CR1 (0x40012C00), value 0x1: 2 bytes, must be a word",
    "write of 0x40013800 (no register), value 0x1: not modelled",
    "write of LPTIM1_CNT (0x40007C1C), value 0x1: read-only",
    "HCLK 85000000 Hz with 0 wait states",
    "VCO 400000000 Hz 96 to 344 MHz",
    "the voltage regulator (ADVREGEN) has not run for 20 us",
    "fault of the processor: undefined instruction",
    "fault of the processor: write of 0x00000001 to 0x90000000, where nothing is",
    "fault of the processor: floating-point instruction",
    "bits 0x5 are locked by TIMx_BDTR.LOCK",
    "write of FLASH_CR, value 0xC0000001: it is locked",
    "write of RCC_BDCR, value 0x1: PWR_CR1.DBP is 0",
    "priority 0x41 of exception 16: only the upper four bits exist",
    "write of COMP_C2CSR, value 0x80000001: it is locked",
    "write of FLASH_KEYR, value 0x45670123: not the next key",
    "read of 0x08040000: the data cache has not been emptied since the last operation",
    "write of FLASH_ACR, value 0x41600: a cache is emptied while it is enabled",
    "write of RNG_CR, value 0x4: its 48 MHz clock does not run",
    "read of RNG_DR: RNG_SR.DRDY is 0",
    "HCLK from 16000000 to 100000000 Hz: above 80 MHz half the frequency comes first",
    "PC0 has no alternate function 0",
    "the falling edge of a timer's pulse",
    "an operation in bank 2 with FLASH_ACR.DCEN",
    "write of RCC_BDCR, value 0x1: PWR_CR1.DBP has not been read back",
    "return from exception 44, whose request has ended by the last access to a peripheral",
    "RCC_PLLCFGR.PLLREN with 170000000 Hz: at most 150 MHz in normal mode of range 1",
    "RCC_PLLCFGR.PLLREN with 170000000 Hz: at most 150 MHz in normal mode of range 1",
])))
def test_breach_of_a_rule_ends_the_run_with_one_line(tmp_path: Path, case: int, text: str) -> None:
    result = run(tmp_path, "strict", definitions=(f"CASE={case}",))
    assert result.returncode == VIOLATION
    assert len(result.stderr.splitlines()) == 1
    assert text in result.stderr
    assert any(f"; pc 0x{place}" in result.stderr for place in ("0800", "FFFFFFF"))  # of the program, or a return
