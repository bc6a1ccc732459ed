"""Writes pins.inc: the pins of the part's timers, FDCAN1, converters and comparators with their alternate functions.

CHIP: the file of the part in the crate stm32-metapac 21.0.0, which stm32g474re/metadata.rs includes (cargo vendor;
licence MIT or Apache-2.0).

    python3 extract_pins.py metadata_0363.rs > pins.inc
"""

import re
import sys
from pathlib import Path

PERIPHERALS = ("TIM1", "TIM2", "TIM3", "TIM4", "TIM5", "TIM8", "FDCAN1", "ADC1", "ADC2", "ADC3", "ADC4", "ADC5",
               "COMP1", "COMP2", "COMP3", "COMP4", "COMP5", "COMP6", "COMP7")


def main(chip: Path) -> None:
    text = chip.read_text()
    print("/* Made by extract_pins.py from the crate stm32-metapac 21.0.0: port and bit, peripheral, signal, alternate"
          " function (-1: analogue). */")
    for name in PERIPHERALS:
        start = text.index(f'\n        name: "{name}",')
        pins = text.index("pins: &[", start)
        for pin, bit, signal, function in re.findall(
                r'pin: "P([A-D])(\d+)",\s*signal: "(\w+)",\s*af: (None|Some\(\d+\))',
                text[pins:text.index("\n        ],", pins)]):
            number = -1 if function == "None" else int(function[5:-1])
            print(f'{{{(ord(pin) - ord("A")) * 16 + int(bit)}, "{name}", "{signal}", {number}}},')


if __name__ == "__main__":
    main(Path(sys.argv[1]))
