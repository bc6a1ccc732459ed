"""Estimate of the share of a control period that an interrupt takes, from its instructions."""

from __future__ import annotations

PROCESSOR_HZ = 170_000_000
"""Of the parts that this firmware is for, the STM32G4 and its like."""
CYCLES_PER_INSTRUCTION = (1.1, 1.5)
"""An estimate: a Cortex-M4 that does not wait for its flash. Instructions are exact."""
RATES_HZ = (20_000, 40_000, 50_000, 100_000)
FITS, OPEN, FITS_NOT = "yes", "open", "no"


def shares_of_period(instructions: int) -> dict[int, tuple[float, float]]:
    """What an interrupt of so many instructions takes of the period at each of RATES_HZ, lowest and highest."""
    low, high = CYCLES_PER_INSTRUCTION
    return {rate: (instructions * low * rate / PROCESSOR_HZ, instructions * high * rate / PROCESSOR_HZ)
            for rate in RATES_HZ}


def fits(instructions: int) -> dict[int, str]:
    """Whether it ends before the next begins, at each of RATES_HZ: FITS and FITS_NOT whatever the estimate's end, else
    OPEN."""
    return {rate: FITS if high < 1 else OPEN if low < 1 else FITS_NOT
            for rate, (low, high) in shares_of_period(instructions).items()}


def estimable(target: str) -> bool:
    """Whether CYCLES_PER_INSTRUCTION are this processor's."""
    return target.startswith("cortex-m4")
