"""Estimate of the share of a control period that an interrupt takes, from its instructions."""

from __future__ import annotations

PROCESSOR_HZ = 170_000_000
"""Core clock of the intended microcontrollers, STM32G4 and similar."""
CYCLES_PER_INSTRUCTION = (1.1, 1.5)
"""Estimate for a Cortex-M4 without flash wait states. Instruction counts are exact."""
RATES_HZ = (20_000, 40_000, 50_000, 100_000)
FITS, OPEN, FITS_NOT = "yes", "open", "no"


def shares_of_period(instructions: int) -> dict[int, tuple[float, float]]:
    """Fraction of the control period that an interrupt takes at each of RATES_HZ: lower and upper estimate."""
    low, high = CYCLES_PER_INSTRUCTION
    return {rate: (instructions * low * rate / PROCESSOR_HZ, instructions * high * rate / PROCESSOR_HZ)
            for rate in RATES_HZ}


def fits(instructions: int) -> dict[int, str]:
    """Whether an interrupt fits in the control period at each of RATES_HZ: FITS or FITS_NOT when both estimates agree,
    else OPEN."""
    return {rate: FITS if high < 1 else OPEN if low < 1 else FITS_NOT
            for rate, (low, high) in shares_of_period(instructions).items()}


def estimable(target: str) -> bool:
    """True when CYCLES_PER_INSTRUCTION apply to this target."""
    return target.startswith("cortex-m4")
