"""The checks of the build reject firmware that breaks a rule: no floating point, no C library, no 64-bit division by
the compiler's library, limited flash."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

FLOATING_POINT = "int scaled(int x);\nint scaled(int x) { return (int)((float)x * 0.5f); }\n"
PRINTS = 'int printf(const char *, ...);\nvoid report(int x);\nvoid report(int x) { printf("%d", x); }\n'
INTEGERS = "int scaled(int x);\nint scaled(int x) { return (int)((long long)x * x >> 20) / (x + 3); }\n"
DIVIDES_64_BITS = "int scaled(int x);\nint scaled(int x) { return (int)(((long long)x << 20) / (x + 3)); }\n"


def compiles_as_firmware(tmp_path: Path, source: str) -> bool:
    file = tmp_path / "rule.c"
    file.write_text(source)
    result = subprocess.run(
        ["gcc", "-std=c11", "-O2", "-mgeneral-regs-only", "-c", str(file), "-o", str(tmp_path / "rule.o")],
        capture_output=True,
        check=False,
    )
    return result.returncode == 0


def test_host_build_rejects_floating_point(tmp_path):
    assert compiles_as_firmware(tmp_path, INTEGERS)
    assert not compiles_as_firmware(tmp_path, FLOATING_POINT)


def test_host_build_of_the_firmware_has_that_option():
    assert "target_compile_options(salient_firmware PRIVATE -mgeneral-regs-only)" in (
        ROOT / "firmware/CMakeLists.txt"
    ).read_text()


TARGETS = {
    "arm-none-eabi": ["-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=soft"],
    "riscv64-unknown-elf": ["-march=rv32imac", "-mabi=ilp32"],
}


def symbol_check(tmp_path: Path, compiler: str, source: str) -> subprocess.CompletedProcess:
    assert shutil.which(f"{compiler}-gcc"), f"package gcc-{compiler} is missing"
    file, item, archive = tmp_path / "rule.c", tmp_path / "rule.o", tmp_path / "librule.a"
    file.write_text(source)
    target = [*TARGETS[compiler], "-O2", "-c"]
    subprocess.run([f"{compiler}-gcc", *target, str(file), "-o", str(item)], check=True)
    subprocess.run([f"{compiler}-ar", "rcs", str(archive), str(item)], check=True)
    return subprocess.run(
        ["cmake", f"-DNM={compiler}-nm", f"-DARCHIVES={archive}", "-P", str(ROOT / "cmake/check_symbols.cmake")],
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.in_turns
@pytest.mark.parametrize(
    ("compiler", "source", "symbol"),
    [
        ("arm-none-eabi", FLOATING_POINT, "__aeabi_fmul"),
        ("arm-none-eabi", PRINTS, "printf"),
        ("arm-none-eabi", DIVIDES_64_BITS, "__aeabi_ldivmod"),
        ("riscv64-unknown-elf", FLOATING_POINT, "__mulsf3"),
        ("riscv64-unknown-elf", PRINTS, "printf"),
        ("riscv64-unknown-elf", DIVIDES_64_BITS, "__divdi3"),
    ],
)
def test_target_build_names_the_forbidden_symbol(tmp_path, compiler, source, symbol):
    result = symbol_check(tmp_path, compiler, source)
    assert result.returncode != 0
    assert symbol in result.stderr


@pytest.mark.parametrize("compiler", TARGETS)
def test_target_build_accepts_integers(tmp_path, compiler):
    assert symbol_check(tmp_path, compiler, INTEGERS).returncode == 0


def size_check(tmp_path: Path, bytes_of_table: int, initial: int) -> subprocess.CompletedProcess:
    """Checks a table in flash and a variable with an initial value against a limit of 1000 bytes."""
    file, item = tmp_path / "size.c", tmp_path / "size.o"
    table, variable = f"const char table[{bytes_of_table}] = {{1}};\n", f"char variable[{initial}] = {{1}};\n"
    file.write_text(table + variable + "char zero[5000];\n")
    subprocess.run(["arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-c", str(file), "-o", str(item)], check=True)
    return subprocess.run(
        ["cmake", "-DSIZE=arm-none-eabi-size", f"-DFILES={item}", "-DLIMIT=1000", "-P",
         str(ROOT / "cmake/check_size.cmake")],
        capture_output=True,
        text=True,
        check=False,
    )


def test_cortex_m4_build_fails_at_one_byte_above_the_flash_limit(tmp_path):
    fits = size_check(tmp_path, 900, 100)
    assert fits.returncode == 0
    assert "1000 of 1000 bytes" in fits.stdout
    assert size_check(tmp_path, 901, 100).returncode != 0
    too_much = size_check(tmp_path, 900, 101)
    assert too_much.returncode != 0
    assert "1001 bytes of flash, must be at most 1000" in too_much.stderr
