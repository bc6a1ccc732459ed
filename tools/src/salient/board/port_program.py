"""The program that checks the port on the model of the part (tests/target/stm32g4/port): its build, and its verdict.

The port's own sources, start and linker scripts, linked with a program instead of the drive. It checks itself; the
edges of the gates, which the model writes to a file, are compared with the definition in hal/hal_pwm.h here.
"""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path

from salient.board.header import PORT
from salient.board.pins import header, read_pins
from salient.errors import UsageError
from salient.generate.code_check import write_reference
from salient.paths import BUILD, ROOT

SOURCES = ROOT / "tests" / "target" / "stm32g4" / "port"
MODEL = BUILD / "host" / "bin" / "salient_stm32g4"
_LIMIT_US = 600_000
_TIMEOUT_S = 120
_STEPS = (1, 5, 7, 11, 13, 617, 1009, 1201)
"""Steps of the switches lower a to d, upper a to d: step[] of tests/target/stm32g4/port/interrupt.c."""


def _run(line: list[str]) -> None:
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise UsageError(f"the program that checks the port does not build: {done.stderr.strip()[-2000:]}")


def _compiler(folder: Path, clock_mhz: int) -> list[str]:
    compiler = shutil.which("arm-none-eabi-gcc")
    if compiler is None:
        raise UsageError("arm-none-eabi-gcc is missing: install the Debian package gcc-arm-none-eabi")
    return [compiler, "-mcpu=cortex-m4", "-mthumb", "-std=c11", "-O2", "-Wall", "-Werror", "-Wno-unused",
            "-DHAL_PHASES_MAX=4", f"-DBOARD_CLOCK_MHZ={clock_mhz}", "-DBOARD_CAN_BIT_RATE=1000000",
            "-DBOARD_CONTROLLER=0", "-DBOARD_NODE=0", "-DBOARD_TELEMETRY_PERIOD_MS=0", "-DBOARD_ENCODER_INDEX=0",
            *(f"-I{path}" for path in (folder, ROOT / "hal", SOURCES, ROOT / "firmware"))]


def objects(folder: Path, clock_mhz: int) -> dict[str, Path]:
    """Compiles all into a folder: objects by the name of their source."""
    pins = folder / "stm32g4" / "pins.h"
    pins.parent.mkdir(parents=True, exist_ok=True)
    pins.write_text(header(read_pins()), encoding="utf-8")
    made = {}
    for source in (*sorted(PORT.glob("*.c")), ROOT / "hal" / "qemu" / "memory.c", *sorted(SOURCES.glob("*.c"))):
        made[source.name] = folder / f"{source.stem}.o"
        _run([*_compiler(folder, clock_mhz), "-c", str(source), "-o", str(made[source.name])])
    return made


def build(folder: Path, clock_mhz: int, changed: Mapping[str, str] | None = None,
          compiled: Mapping[str, Path] | None = None) -> Path:
    """The image, in a folder. changed: texts of sources of hal/stm32g4 with a mistake; compiled: objects() without one.
    UsageError: it does not build."""
    folder.mkdir(parents=True, exist_ok=True)
    made = dict(compiled or objects(folder, clock_mhz))
    for name, text in (changed or {}).items():
        place = folder / name
        place.write_text(text, encoding="utf-8")
        made[name] = folder / f"mistake_{place.stem}.o"
        include = next(iter(compiled.values())).parent if compiled else folder
        _run([*_compiler(include, clock_mhz), "-c", str(place), "-o", str(made[name])])
    memory = folder / "memory.ld"  # the upper end of the RAM survives a reset
    text = (PORT / "memory.ld").read_text(encoding="utf-8")
    memory.write_text(text.replace("LENGTH = 128K", "LENGTH = 92K"), encoding="utf-8")
    image = folder / "port.elf"
    _run([*_compiler(folder, clock_mhz), *map(str, made.values()), "-nostartfiles", f"-Wl,-T,{memory}",
          f"-Wl,-T,{ROOT / 'hal' / 'qemu' / 'sections.ld'}", "-o", str(image)])
    write_reference(image)
    return image


def gates() -> list[str]:
    """Pins of the gates: lower a to d, upper a to d."""
    pins = {pin.signal: pin.pin for pin in read_pins()}
    return [pins[f"{side}_{phase}"] for side in ("LOWER", "UPPER") for phase in "ABCD"]


def verdict(image: Path, clock_mhz: int, model: Path = MODEL) -> str:
    """The first complaint; empty without one."""
    trace = image.with_suffix(".edges")
    try:
        done = subprocess.run([str(model), str(image), "--alone", "--limit-us", str(_LIMIT_US), "--trace", str(trace),
                               *gates()], capture_output=True, text=True, check=False, timeout=_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return "the program does not end"
    if done.returncode != 0:
        return (done.stderr.strip().splitlines() or [f"check {done.stdout.strip()}"])[-1]
    return wrong_edges(trace.read_text(encoding="ascii"), clock_mhz)


def _switched(switch: int, value: int, period: int) -> tuple[tuple[int, int], ...]:
    """Times of a period at which a switch is on: begin and end in ticks."""
    value = min(value, period)
    if value == 0:
        return ()
    if value == period:
        return ((0, 2 * period),)
    return ((0, value), (2 * period - value, 2 * period)) if switch < 4 else ((period - value, period + value),)


def expected_edges(switch: int, period: int) -> list[int]:
    """Ticks of the edges of the sweep from the start of its first period, the first one rising. Without the last value:
    hal_pwm_open_all ends it."""
    values = [number * _STEPS[switch] % (period + 2) for number in range(period + 4)]
    times: list[list[int]] = []
    for number, value in enumerate(values):
        for span in _switched(switch, value, period):
            begin, end = (tick + 2 * period * number for tick in span)
            if times and times[-1][1] == begin:
                times[-1][1] = end
            else:
                times.append([begin, end])
    return [tick for span in times for tick in span]


def wrong_edges(trace: str, clock_mhz: int) -> str:
    """Compares the edges of the sweep, which come first, with the contract: the first difference; empty without one."""
    period = clock_mhz * 1_000_000 // 40_000 // 2
    edges: dict[str, list[tuple[int, int]]] = {pin: [] for pin in gates()}
    for line in trace.splitlines():
        cycle, pin, level = line.split()
        edges[pin].append((int(cycle), int(level)))
    start: int | None = None
    for switch, pin in enumerate(gates()):
        levels = [level for _, level in edges[pin]]
        if levels[:1] != [0]:
            return f"gate {pin}: high at the start"
        expected = expected_edges(switch, period)
        found = [cycle for cycle, _ in edges[pin][1:]]
        if len(found) < len(expected):
            return f"gate {pin}: {len(found)} edges, must be {len(expected)} or more"
        start = found[0] - expected[0] if start is None else start
        for tick, at in zip(expected[:-1], found, strict=False):  # the last one may be none: the next value
            if at - start != tick:
                return f"gate {pin}: an edge {at - start - tick} ticks from its place, {tick} ticks after the start"
    return ""
