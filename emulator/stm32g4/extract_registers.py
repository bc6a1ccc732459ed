"""Writes registers.inc: name, address, reset value, readable and writable bits of the registers of the model.

CRATE: the source folder stm32g474 of the crate stm32g4 0.16 (cargo vendor; licence MIT or Apache-2.0). Rows that the
crate has wrong are corrected here by the reference manual RM0440, each with its reason.

    python3 extract_registers.py CRATE > registers.inc
"""

import re
import sys
from pathlib import Path

INSTANCES = ["TIM1", "TIM8", "TIM2", "TIM3", "TIM4", "TIM5", "TIM6", "TIM7", "RCC", "PWR", "FLASH", "GPIOA", "GPIOB",
             "GPIOC", "GPIOD", "ADC1", "ADC2", "ADC3", "ADC4", "ADC5", "ADC12_COMMON", "ADC345_COMMON", "DAC1", "DAC2",
             "DAC3", "DAC4", "COMP", "DMA1", "DMA2", "DMAMUX", "FDCAN1", "IWDG", "LPTIMER1", "RNG", "EXTI", "SYSCFG"]
# (register name) -> corrections of reset value, readable, writable bits; the crate is wrong, or leaves bits out.
CORRECTIONS = {
    "IWDG_RLR": {"reset": 0xFFF},
    "IWDG_WINR": {"reset": 0xFFF},
    "TIM1_AF1": {"reset": 1},
    "TIM1_AF2": {"reset": 1},
    "TIM8_AF1": {"reset": 1},
    "TIM8_AF2": {"reset": 1},
    "TIM3_ARR": {"reset": 0xFFFF},
    "TIM4_ARR": {"reset": 0xFFFF},
    "RCC_CR": {"reset": 0x500},         # RM0440 7.4.1: HSI16 is on and ready after reset
    "FLASH_ACR": {"reset": 0x40600},    # RM0440 5.7.1
    "FLASH_CR": {"writable": 0xDF078BFF},
}
# Registers of the crate that this part does not have, or that the model does not have.
ABSENT = re.compile(r"TIM[2345]_(RCR|BDTR|CCR[56]|CCMR3|DTR2)|TIM\d_(DCR|DMAR)|DAC\d_S[HT].*|DMAMUX_RG.*|DMA\d_CH9.*")
DAC = ["CR", "SWTRGR", "DHR12R1", "DHR12L1", "DHR8R1", "DHR12R2", "DHR12L2", "DHR8R2", "DHR12RD", "DHR12LD", "DHR8RD",
       "DOR1", "DOR2", "SR", "CCR", "MCR"]


def manual_name(name: str, at: int) -> str:
    """Name of the manual: the crate counts arrays from 0."""
    if name.startswith("DAC") and (at & 0x3FF) < 0x40:
        return f"{name[:4]}_{DAC[(at & 0x3FF) // 4]}"
    found = re.fullmatch(r"(TIM\d_CCR|ADC\d_OFR|ADC\d_JDR)(\d)", name)
    if found and not (found[1].endswith("CCR") and int(found[2]) > 4):
        return f"{found[1]}{int(found[2]) + 1}"
    found = re.fullmatch(r"COMP_CCSR(\d)", name)
    return f"COMP_C{int(found[1]) + 1}CSR" if found else name

ONES = 0xFFFFFFFF


def bits_of(text: str, kind: str) -> int:
    """Bits of the fields in `impl R` or `impl W`."""
    mask = 0
    for block in re.findall(rf"^impl {kind} \{{$(.*?)^\}}$", text, re.MULTILINE | re.DOTALL):
        for first, last in re.findall(r"^    ///Bits? (\d+)(?::(\d+))?", block, re.MULTILINE):
            low, high = int(first), int(last or first)
            mask |= ((1 << (high - low + 1)) - 1) << low
    return mask


def register(file: Path) -> tuple[int, int, int]:
    """Reset value, readable and writable bits."""
    text = file.read_text()
    found = re.search(r"RESET_VALUE: u(?:32|16) = (0x[0-9a-f_]+|\d+)", text)
    reset = int(found[1].replace("_", ""), 0) if found else 0
    readable = bits_of(text, "R") if "Readable for" in text else 0
    writable = bits_of(text, "W") if "Writable for" in text else 0
    return reset, readable, writable


def block(folder: Path, base: int, prefix: str) -> list[tuple[str, int, int, int, int]]:
    """Registers of a peripheral or of a cluster in it."""
    rows = []
    text = Path(f"{folder}.rs").read_text()
    aliases = {kind: folder / f"{module}.rs"
               for kind, module in re.findall(r"^pub type (\w+) = crate::Reg<(\w+)::", text, re.MULTILINE)}
    for other, kind in re.findall(r"^pub use crate::stm32g474::(\w+)::([A-Z]\w*);", text, re.MULTILINE):
        aliases[kind] = folder.parent / other / f"{kind.lower()}.rs"
    for offset, name, kind in re.findall(
            r"///(0x[0-9a-f]+)(?:\.\.0x[0-9a-f]+)? - [^\n]*\n(?:    ///[^\n]*\n)*(?:    #[^\n]*\n)*"
            r"    pub const fn (\w+)\(&self\) -> &(\w+)", text):
        at = base + int(offset, 16)
        if kind in aliases:
            rows.append((f"{prefix}_{name.upper()}", at, *register(aliases[kind])))
        elif (folder / f"{kind.lower()}.rs").exists():
            rows += block(folder / kind.lower(), at, f"{prefix}_{name.upper()}")
    # Arrays without names of their own.
    for start, end, name, kind in re.findall(
            r"///(0x[0-9a-f]+)\.\.(0x[0-9a-f]+) - [^\n]*\n(?:    ///[^\n]*\n)*(?:    #[^\n]*\n)*"
            r"    pub const fn (\w+)\(&self, n: usize\) -> &(\w+)", text):
        if kind in aliases:
            for n, at in enumerate(range(int(start, 16), int(end, 16), 4)):
                rows.append((f"{prefix}_{name.upper()}{n}", base + at, *register(aliases[kind])))
    return rows


def main(crate: Path) -> None:
    text = (crate / "mod.rs").read_text()
    rows: dict[int, tuple[str, int, int, int, int]] = {}
    for instance in INSTANCES:
        module, address = re.search(rf"pub type {instance} = crate::Periph<(\w+)::RegisterBlock, (0x[0-9a-f_]+)>",
                                    text).groups()
        for name, at, reset, readable, writable in block(crate / module, int(address.replace("_", ""), 16),
                                                         instance.replace("LPTIMER", "LPTIM")):
            # The compare mode registers have two views: the union of both.
            name = re.sub(r"_(INPUT|OUTPUT)$", "", name)
            if at in rows:
                _, _, _, old_readable, old_writable = rows[at]
                readable, writable = readable | old_readable, writable | old_writable
                if len(rows[at][0]) < len(name):
                    name = rows[at][0]
            rows[at] = (name, at, reset, readable, writable)
    print("/* Made by extract_registers.py from the crate stm32g4 0.16: name, address, reset value, readable bits,"
          " writable bits. */")
    for name, at, reset, readable, writable in sorted(rows.values(), key=lambda row: row[1]):
        name = manual_name(name, at)
        if ABSENT.fullmatch(name):
            continue
        corrected = {"reset": reset, "readable": readable, "writable": writable, **CORRECTIONS.get(name, {})}
        print(f'{{"{name}", 0x{at:08X}, 0x{corrected["reset"]:X}, 0x{corrected["readable"]:X}, '
              f'0x{corrected["writable"]:X}}},')


if __name__ == "__main__":
    main(Path(sys.argv[1]))
