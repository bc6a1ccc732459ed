"""Images and objects of the firmware contain nothing forbidden, and the checks detect what is forbidden."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from salient.bench.programs import image
from salient.config import TARGET_BUILDS
from salient.elf import ElfImage
from salient.target.baseline import firmware_alone
from salient.target.static_checks import deepest_stack, forbidden, indirect_calls, size, undefined_symbols

LINKED = ["arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-O1", "-nostartfiles", "-ffreestanding", "-Wl,-e,begin"]


@pytest.mark.in_turns
@pytest.mark.parametrize("build", TARGET_BUILDS)
def test_images_have_no_floating_point_no_heap_and_no_indirect_calls(build):
    whole = ElfImage(image("saturating", build))
    assert len(whole.instructions()) > 5000
    assert forbidden(whole) == []
    assert indirect_calls(whole) == []


@pytest.mark.parametrize("build", ["cortex-m4", "cortex-m4-Os"])
def test_firmware_calls_only_the_hal_memcpy_and_memset(build):
    assert undefined_symbols(ElfImage(firmware_alone(build))) == set()


def linked(tmp_path: Path, source: str, *options: str) -> ElfImage:
    (tmp_path / "x.c").write_text(source)
    result = tmp_path / "x.elf"
    subprocess.run([*LINKED, *options, str(tmp_path / "x.c"), "-o", str(result)], check=True)
    return ElfImage(result)


def test_hardware_floating_point_is_detected(tmp_path):
    made = linked(tmp_path, "float begin(float a, float b) { return a * b; }", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard")
    assert any("vmul.f32" in line for line in forbidden(made))


def test_software_floating_point_and_heap_are_detected(tmp_path):
    source = "#include <stdlib.h>\nvoid *_sbrk(int n) { return 0; }\n"
    made = linked(tmp_path, source + "void *begin(double a) { return malloc((unsigned)(a * 3)); }", "-mfloat-abi=soft")
    assert {"__aeabi_dmul", "__aeabi_d2uiz", "malloc"} <= set(forbidden(made))


def test_call_of_any_other_c_library_function_is_detected(tmp_path):
    (tmp_path / "x.c").write_text("#include <string.h>\nunsigned begin(const char *a) { return strlen(a) + 1; }")
    subprocess.run(["arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-c", str(tmp_path / "x.c"), "-o",
                    str(tmp_path / "x.o")], check=True)
    assert undefined_symbols(ElfImage(tmp_path / "x.o")) == {"strlen"}


def test_indirect_call_is_detected(tmp_path):
    made = linked(tmp_path, "int begin(int (*f)(int)) { return f(1) + 1; }")
    assert [line.split(":")[0] for line in indirect_calls(made)] == ["begin"]


@pytest.mark.parametrize("source", [
    "__attribute__((noinline)) int begin(int n) { volatile int x = n; return n ? begin(x - 1) + 1 : 0; }",
    "int b(int); __attribute__((noipa)) int begin(int n) { return b(n - 1) + 1; }\n"
    "__attribute__((noipa)) int b(int n) { return n ? begin(n) + 2 : 0; }",
])
def test_recursion_is_rejected(tmp_path, source):
    with pytest.raises(ValueError, match="begin"):
        deepest_stack(linked(tmp_path, source), "begin")


def test_stack_depth_is_that_of_the_deepest_call_path(tmp_path):
    source = """
    __attribute__((noipa)) void use(char *p) { *p = 1; }
    __attribute__((noipa)) void shallow(void) { char a[16]; use(a); }
    __attribute__((noipa)) void deep(void) { char a[400]; use(a); }
    __attribute__((noipa)) int begin(void) { shallow(); deep(); return 1; }
    """
    bytes_, way = deepest_stack(linked(tmp_path, source), "begin")
    assert way[:2] == ["begin", "deep"]
    assert 400 + 8 <= bytes_ <= 400 + 48


def test_size_counts_initial_values_in_flash_and_in_ram(tmp_path):
    empty = size(linked(tmp_path, "int begin(void) { return 1; }"))
    more = size(linked(tmp_path, "int big[250] = {1}; int zero[100]; const int table[50] = {1};\n"
                                 "int begin(int i) { return big[i] + zero[i] + table[i]; }"))
    assert 1000 + 200 <= more.flash - empty.flash <= 1000 + 200 + 40
    assert more.ram - empty.ram == 1400
