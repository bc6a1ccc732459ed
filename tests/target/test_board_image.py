"""The image for the NUCLEO-G474RE: its files, its vectors, its content, and the errors of the command."""

from __future__ import annotations

import os
import re
import struct
import zlib
from pathlib import Path

import pytest

from salient.__main__ import main
from salient.board.command import FLASH_BEGIN, RAM_BEGIN, RAM_BYTES
from salient.board.pins import header, read_pins
from salient.elf import ElfImage
from salient.errors import UsageError
from salient.paths import ROOT
from salient.target.static_checks import forbidden

CONTROL_VECTOR, CAN_VECTOR = 16 + 62, 16 + 21
VECTORS = 16 + 102


def salient(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr("sys.argv", ["salient", *map(str, arguments)])
    return main()


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> dict[str, Path]:
    """By clock: the folder that board build has written."""
    folders = {clock: tmp_path_factory.mktemp(f"board_{clock}") for clock in ("170", "100")}
    with pytest.MonkeyPatch.context() as monkeypatch:
        for clock, folder in folders.items():
            assert salient(monkeypatch, "board", "build", "--clock", clock, "--out", folder) == 0
    return folders


def elf(folder: Path) -> ElfImage:
    return ElfImage(folder / "saturating.elf")


def hex_content(text: str) -> dict[int, int]:
    """Bytes by address."""
    content, base = {}, 0
    for line in text.split():
        record = bytes.fromhex(line[1:])
        assert sum(record) % 256 == 0
        if record[3] == 4:
            base = int.from_bytes(record[4:6], "big") << 16
        elif record[3] == 0:
            at = base + int.from_bytes(record[1:3], "big")
            content |= {at + i: value for i, value in enumerate(record[4:-1])}
    return content


def test_bin_and_hex_are_the_content_of_the_elf(built):
    for folder in built.values():
        binary = (folder / "saturating.bin").read_bytes()
        image = elf(folder)
        begin, end = image.symbols()["code_start"], image.symbols()["code_end"]
        assert begin == FLASH_BEGIN
        assert binary[: end - begin] == image.read(begin, end - begin)
        assert hex_content((folder / "saturating.hex").read_text()) == {
            FLASH_BEGIN + i: value for i, value in enumerate(binary)}


def test_vectors(built):
    for folder in built.values():
        image = elf(folder)
        symbols = image.symbols()
        vectors = struct.unpack(f"<{VECTORS}I", image.read(FLASH_BEGIN, 4 * VECTORS))
        assert vectors[0] == RAM_BEGIN + RAM_BYTES
        handlers = {1: "program_start", 2: "nmi_handler", 3: "fault_handler", 14: "deferred_handler",
                    CAN_VECTOR: "can_handler", CONTROL_VECTOR: "control_handler"}
        assert {number: vectors[number] for number in handlers} == {
            number: symbols[name] | 1 for number, name in handlers.items()}
        assert set(vectors[16:]) - {vectors[CAN_VECTOR], vectors[CONTROL_VECTOR]} == {0}


def test_no_floating_point_and_no_heap(built):
    for folder in built.values():
        image = elf(folder)
        assert len(image.instructions()) > 5000
        assert forbidden(image) == []


def test_reference_of_the_code_check(built):
    image = elf(built["170"])
    symbols = image.symbols()
    code = image.read(symbols["code_start"], symbols["code_end"] - symbols["code_start"])
    assert struct.unpack("<II", image.read(symbols["code_check"], 8)) == (len(code) // 4, zlib.crc32(code))


def test_variables_leave_room_for_the_stack(built):
    for folder in built.values():
        end, begin = elf(folder).stack()
        assert begin - end > 64 * 1024


def test_clocks_make_different_images(built):
    assert (built["170"] / "saturating.bin").read_bytes() != (built["100"] / "saturating.bin").read_bytes()


def test_line_names_files_and_sizes(monkeypatch, capsys, built, tmp_path):
    assert salient(monkeypatch, "board", "build", "--out", tmp_path) == 0
    line = capsys.readouterr().out
    found = re.fullmatch(rf"{tmp_path}/saturating\.elf, \.bin, \.hex: flash (\d+) of 262144 bytes, "
                         r"RAM (\d+) of 131072 bytes with a stack of at least (\d+) bytes\n", line)
    assert found is not None, line
    assert int(found[1]) == (tmp_path / "saturating.bin").stat().st_size
    assert 20_000 < int(found[2]) < 60_000
    assert (tmp_path / "saturating.bin").read_bytes() == (built["170"] / "saturating.bin").read_bytes()


@pytest.mark.parametrize(("arguments", "texts"), [
    (["--machine", "none"], ["machine 'none'"]),
    (["--machine", ROOT / "tests/machines/five_phases.toml"], ["five_phases.toml: 5 phases", "outputs for 4"]),
    (["--clock", "171"], ["--clock 171: must be 170 or 100"]),
    (["--bit-rate", "800000"], ["--bit-rate 800000", "170 MHz makes no such rate"]),
    (["--encoder", "ssi"], ["--encoder ssi: must be absolute or index"]),
    (["--controller", "pid"], ["--controller pid"]),
    (["--out", "/proc/none"], ["--out /proc/none"]),
])
def test_a_wrong_option_is_one_line(monkeypatch, capsys, arguments, texts):
    assert salient(monkeypatch, "board", "build", *arguments) == 2
    line = capsys.readouterr().err
    assert re.fullmatch(r"salient: [^\n]+\n", line)
    assert all(text in line for text in texts), line


def program(folder: Path, name: str, end: str) -> None:
    path = folder / name
    path.write_text(f'#!/bin/sh\nprintf "%s\\n" "$@" > {folder}/{name}.arguments\n{end}\n')
    path.chmod(0o755)


def tools_alone(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    """PATH with nothing but the folder and the binutils."""
    for name in ("arm-none-eabi-objdump", "sh"):
        found = next(Path(place) / name for place in os.environ["PATH"].split(":") if (Path(place) / name).exists())
        (folder / name).symlink_to(found)
    monkeypatch.setenv("PATH", str(folder))


@pytest.mark.parametrize(("name", "suffix", "expected"), [
    ("openocd", "elf", "program %s verify reset exit"),
    ("openocd", "bin", "program %s 0x08000000 verify reset exit"),
    ("st-flash", "hex", "ihex\nwrite\n%s"), ("st-flash", "bin", "write\n%s\n0x08000000"),
])
def test_flash_calls_the_program_that_is_there(monkeypatch, capsys, built, tmp_path, name, suffix, expected):
    tools_alone(monkeypatch, tmp_path)
    program(tmp_path, name, "exit 0")
    file = built["170"] / f"saturating.{suffix}"
    assert salient(monkeypatch, "board", "flash", file) == 0
    assert expected % file in (tmp_path / f"{name}.arguments").read_text()
    assert capsys.readouterr().out == f"{file}: written and verified\n"


def test_flash_says_what_is_missing(monkeypatch, capsys, built, tmp_path):
    tools_alone(monkeypatch, tmp_path)
    assert salient(monkeypatch, "board", "flash", built["170"] / "saturating.hex") == 2
    assert capsys.readouterr().err == ("salient: neither openocd nor st-flash is there: install the Debian package "
                                       "openocd or stlink-tools\n")


def test_flash_reports_the_error_of_the_program(monkeypatch, capsys, built, tmp_path):
    tools_alone(monkeypatch, tmp_path)
    program(tmp_path, "openocd", "echo Info; echo 'Error: open failed'; echo end; exit 1")
    assert salient(monkeypatch, "board", "flash", built["170"] / "saturating.hex") == 1
    assert capsys.readouterr().err == "salient: openocd: Error: open failed\n"


@pytest.mark.parametrize(("name", "content"), [
    ("x.bin", b""), ("x.bin", bytes(64)), ("x.hex", b":00000001FF\n"), ("x.hex", b"not hex"), ("x.elf", b"\x7fELF"),
    ("x.txt", b"text"),
])
def test_flash_refuses_what_is_no_image(monkeypatch, capsys, tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    assert salient(monkeypatch, "board", "flash", tmp_path / name) == 2
    assert re.fullmatch(rf"salient: {tmp_path}/{name}: (no image|must be)[^\n]*\n", capsys.readouterr().err)


def test_flash_names_a_missing_file(monkeypatch, capsys, tmp_path):
    assert salient(monkeypatch, "board", "flash", tmp_path / "none.hex") == 2
    assert capsys.readouterr().err == f"salient: {tmp_path}/none.hex: no such file\n"


@pytest.mark.parametrize("suffix", [".bin", ".hex", ".elf"])
def test_flash_waits_for_no_pipe_and_reads_no_device(monkeypatch, capsys, tmp_path, suffix):
    os.mkfifo(tmp_path / f"pipe{suffix}")
    (tmp_path / f"zero{suffix}").symlink_to("/dev/zero")
    for name in ("pipe", "zero"):
        assert salient(monkeypatch, "board", "flash", tmp_path / f"{name}{suffix}") == 2
        assert capsys.readouterr().err == f"salient: {tmp_path}/{name}{suffix}: not a file\n"


@pytest.mark.parametrize("name", ["a b.bin", "a}b.bin", "a{b.bin", "a;[exit]$x.bin", 'a"#b.bin', "a\\b.bin",
                                  "a\nb.bin"])
def test_a_name_of_a_file_is_one_word_of_openocd(monkeypatch, capsys, tmp_path, name):
    """By the rules of Tcl, whose language OpenOCD has: a sign after a backslash is itself."""
    tools_alone(monkeypatch, tmp_path)
    program(tmp_path, "openocd", "exit 0")
    (tmp_path / name).write_bytes(struct.pack("<II", 0x20010000, 0x08000101))
    assert salient(monkeypatch, "board", "flash", tmp_path / name) == 0
    word = (tmp_path / "openocd.arguments").read_text().split("\nprogram ")[1].split(" 0x08000000")[0]
    assert re.fullmatch(r'(\\.|[^\\{}\[\]"$;\s#])+', word)
    assert re.sub(r"\\(.)", lambda found: {"n": "\n"}.get(found[1], found[1]), word) == str(tmp_path / name)


def test_pins_are_used_once_and_in_the_header():
    pins = read_pins()
    assert len(pins) == 32
    assert sum(pin.group == "gates" for pin in pins) == 8
    text = header(pins)
    assert "PIN(GPIOC_BASE, 0, 2, 2, 2)" in text  # TIM1_CH1 at PC0: alternate function 2, pulled down
    assert "#define BOARD_CHANNEL_CURRENT_C 12\n" in text
    assert all(pin.pull == "down" for pin in pins if pin.group == "gates"), "off during a reset"


@pytest.mark.parametrize(("old", "new", "text"), [
    ('pin = "PC1"', 'pin = "PC0"', "pin PC0 is used twice"),
    ('signal = "UPPER_A"', 'signal = "LOWER_A"', "signal LOWER_A is used twice"),
    ('pin = "PC1"', 'pin = "PC17"', "UPPER_A: pin 'PC17'"),
    ('mode = "alternate"', 'mode = "output"', "LOWER_A: mode 'output': must be one of input, alternate, analogue"),
    ('mode = "alternate"', 'mode = "input"', "LOWER_A: mode input does not fit"),
    ('pull = "down"\n', "", "LOWER_A: unknown or missing key pull"),
    ("[[pin]]", "[[pin", "not TOML"),
])
def test_an_error_in_the_table_of_pins_is_named(tmp_path, old, new, text):
    path = tmp_path / "pins.toml"
    path.write_text((ROOT / "hal/stm32g4/pins.toml").read_text().replace(old, new, 1))
    with pytest.raises(UsageError, match=re.escape(text)):
        read_pins(path)
