"""Build step: `machine_layout.c` and `machine_layout_tables.c`, by which the emulator reads a machine image. The first
is of the emulator's structures, the second of the firmware's.

    python -m salient.generate.machine_layout OUTDIR
"""

from __future__ import annotations

import sys
from pathlib import Path

from salient.generate.files import write_files
from salient.machine.file import FORMS
from salient.machine.image import FLUX_MAP, LAYOUT, PLANT, TABLES, Member, Structure

_HEAD = ["/* Generated from tools/src/salient/machine/image.py. */", "#include <assert.h>", "#include <stddef.h>", "",
         '#include "host/machine_image.h"']


def plant_layout() -> str:
    """C source of machine_layout.c."""
    forms = [f'static_assert(MAGNETICS_{form.upper()} == {number}, "{form}");' for number, form in enumerate(FORMS)]
    return "\n".join([*_HEAD, "", *forms, "", f"const uint32_t machine_layout = {LAYOUT:#x};", "",
                      *_definition(PLANT, "machine_plant_structure"), *_definition(FLUX_MAP, "flux_map_structure")])


def tables_layout() -> str:
    """C source of machine_layout_tables.c."""
    return "\n".join([*_HEAD, '#include "control/machine_tables.h"', "",
                      *_places(TABLES), *_definition(TABLES, "machine_tables_structure")])


def _places(structure: Structure) -> list[str]:
    """Members are in memory where tools that write it expect them."""
    return [*(f"static_assert(offsetof({structure.type}, {member.name}) == {offset}, \"{member.name}\");"
              for member, offset in zip(structure.members, structure.offsets, strict=False)),
            f"static_assert(sizeof({structure.type}) == {structure.offsets[-1]}, \"{structure.type}\");", ""]


def _definition(structure: Structure, name: str) -> list[str]:
    of = structure.type
    return [
        *(_check(of, member) for member in structure.members),
        "",
        f"static const machine_member_t {of}_members[] = {{",
        *(f"    {{offsetof({of}, {member.name}), {member.size}}}," for member in structure.members),
        "};",
        "",
        f"const machine_structure_t {name} = {{{of}_members, {len(structure.members)}, {structure.size}}};",
        "",
    ]


def _check(of: str, member: Member) -> str:
    """The member has the type, number of elements and size of the image."""
    pointer = f"{member.type} (*)" + "".join(f"[{size}]" for size in member.shape)
    found = f"_Generic(&(({of} *)0)->{member.name}, {pointer}: sizeof((({of} *)0)->{member.name}), default: 0)"
    return f'static_assert({found} == {member.size},\n              "{of}.{member.name}");'


def main(arguments: list[str]) -> int:
    if len(arguments) != 1:
        print("usage: python -m salient.generate.machine_layout OUTDIR", file=sys.stderr)
        return 2
    return write_files("salient.generate.machine_layout", Path(arguments[0]), lambda: {
        "machine_layout.c": plant_layout(), "machine_layout_tables.c": tables_layout(),
    })


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
