"""Mistakes of the port that the model finds before the first control period, planted as altered writes of registers:
bits that every write of the image to a register clears and sets."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from salient.bench.programs import command_line
from salient.config import BOARD_BUILD, BenchConfig

VIOLATION = 70
MISTAKES = {
    "TIM1 without clock": ("RCC_APB2ENR,800,0", "TIM1_CR1 (0x40012C00), value 0x"),
    "TIM8 without clock": ("RCC_APB2ENR,2000,0", "its clock is off, RCC_APB2ENR bit 13"),
    "TIM2 without clock": ("RCC_APB1ENR1,1,0", "its clock is off, RCC_APB1ENR1 bit 0"),
    "FDCAN1 without clock": ("RCC_APB1ENR1,2000000,0", "its clock is off, RCC_APB1ENR1 bit 25"),
    "ADC1 and ADC2 without clock": ("RCC_AHB2ENR,2000,0", "its clock is off, RCC_AHB2ENR bit 13"),
    "ADC3 to ADC5 without clock": ("RCC_AHB2ENR,4000,0", "its clock is off, RCC_AHB2ENR bit 14"),
    "port C without clock": ("RCC_AHB2ENR,4,0", "its clock is off, RCC_AHB2ENR bit 2"),
    "DMA1 without clock": ("RCC_AHB1ENR,1,0", "its clock is off, RCC_AHB1ENR bit 0"),
    "VCO above its range": ("RCC_PLLCFGR,7f00,7f00", "VCO"),
    "PLL without its output": ("RCC_PLLCFGR,1000000,0", "PLLREN is 0"),
    "whole frequency at once": ("RCC_CFGR,f0,0", "half the frequency comes first"),
    "regulator off": ("ADC1_CR,10000000,0", "the voltage regulator (ADVREGEN) has not run for 20 us"),
    "clock of the converters too fast": ("ADC12_COMMON_CCR,3f0000,10000", "the converter's clock is 100000000 Hz"),
    "bit rate by the prescaler": ("FDCAN1_NBTP,1ff0000,10000", "the bus has 1000000 bit/s"),
    "bit rate by segment 1": ("FDCAN1_NBTP,ff00,100", "the bus has 1000000 bit/s"),
    "CAN pin of another function": ("GPIOA_AFRH,f0000,80000", "no pin has its function RX, or TX"),
    "crystal without access": ("PWR_CR1,100,0", "PWR_CR1.DBP is 0"),
    "watchdog without key": ("IWDG_KR,8000,0", "no key"),
}


def _run(tmp_path: Path, *mistakes: str) -> subprocess.CompletedProcess[str]:
    config = BenchConfig(build=BOARD_BUILD, can=f"unix:{tmp_path}/bus", pace="free", stop_at_s=0.001)
    line = command_line(config)
    end = line.index("--wiring") + 2
    planted = [word for mistake in mistakes for word in ("--mistake", mistake)]
    return subprocess.run([*line[:end], *planted, *line[end:]], capture_output=True, text=True, check=False,
                          timeout=300)


def test_image_without_a_mistake_breaks_no_rule(tmp_path: Path) -> None:
    result = _run(tmp_path)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistake_ends_the_run_with_a_line_that_names_it(tmp_path: Path, mistake: str) -> None:
    altered, text = MISTAKES[mistake]
    result = _run(tmp_path, altered)
    assert result.returncode == VIOLATION, result.stderr
    assert text in result.stderr.splitlines()[-1]
