"""Commands and generators do not load what only MF4 files need, and MF4 files still work."""

from __future__ import annotations

import subprocess
import sys

import pytest

IMPORT = """
import sys
{before}
import can
loaded = sorted({{"asammdf", "pandas"}} & set(sys.modules))
import asammdf
print(*loaded, can.MF4Reader is not None, asammdf.MDF.__name__)
"""


def output_of(before: str) -> str:
    done = subprocess.run([sys.executable, "-c", IMPORT.format(before=before)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_python_can_is_imported_without_asammdf_which_can_be_imported_later():
    assert output_of("from salient.light_can import without_mf4; without_mf4(); without_mf4()") == "True MDF"


def test_python_can_as_it_is_loads_both():
    """Shows that the check above can fail, and why salient.light_can is there."""
    assert output_of("") == "asammdf pandas True MDF"


@pytest.mark.in_turns
@pytest.mark.parametrize("generator", ["codec", "bench_variables", "fault_kinds", "fmu"])
def test_generators_do_not_load_it(generator):
    assert output_of(f"import salient.generate.{generator}") == "True MDF"


def test_commands_do_not_load_it():
    argv = "sys.argv = ['salient', 'machine', 'saturating']"
    assert output_of(f"{argv}; import salient.__main__; assert salient.__main__.main() == 0").endswith("\nTrue MDF")
