"""Build step: options_table.h and options_table.c, the host executable's options as salient.config has them.

    python -m salient.generate.options OUTDIR
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from salient import config
from salient.config import DEFAULTS, OPTIONS, Option
from salient.generate.files import write_files

_HEAD = "/* Generated from tools/src/salient/config.py. */"
_INDENT = 26  # column of the usage text's second part


def arguments() -> dict[str, Option]:
    """The options of the executable by the name of their field."""
    return {name: option for name, option in OPTIONS.items() if option.argument}


def header() -> str:
    """C header: the values of all options, their numbers, and the limits of the integers."""
    members = [line for name, option in arguments().items() for line in _members(name, option)]
    limits = [line for name, option in arguments().items() if option.kind == config.INTEGER
              for line in (f"#define OPTIONS_{name.upper()}_MIN {_integer(min(_range(option)))}",
                           f"#define OPTIONS_{name.upper()}_MAX {_integer(max(_range(option)))}")]
    words = [f"#define OPTIONS_{name.upper()}_{word.upper()} {index}" for name, option in arguments().items()
             if option.kind == config.WORD for index, word in enumerate(option.choices)]
    return "\n".join([
        _HEAD, "#ifndef OPTIONS_TABLE_H", "#define OPTIONS_TABLE_H", "",
        "#include <stdbool.h>", "#include <stdint.h>", "", '#include "rig/pacing.h"', "",
        "typedef struct {", *members, "} options_t;", "",
        "enum {", *(f"    OPTION_{name.upper()}," for name in arguments()), "    OPTION_COUNT", "};", "",
        *limits, *words, "", "#endif", "",
    ])  # fmt: skip


def source() -> str:
    """C source: the table, the defaults and the usage text."""
    return "\n".join([
        _HEAD, '#include "host/options.h"', "", "#include <stddef.h>", "",
        "const option_t options_table[OPTION_COUNT] = {",
        *(f"    [OPTION_{name.upper()}] = {{{', '.join(_row(name, of))}}}," for name, of in arguments().items()),
        "};", "",
        "const options_t options_defaults = {",
        *(f"    {text}," for name, option in arguments().items() if (text := _default(name, option))),
        "};", "",
        "const char options_usage[] =", *(f"    {_string(line)}" for line in _usage()), "    ;", "",
    ])  # fmt: skip


def _range(option: Option) -> tuple[Any, ...]:
    return option.choices or (option.minimum, option.maximum)


def _is_wide(option: Option) -> bool:
    return bool(max(_range(option)) >= 2**32)


def _members(name: str, option: Option) -> list[str]:
    declarations = {
        config.FLAG: [f"bool {name};"],
        config.INTEGER: [f"uint{64 if _is_wide(option) else 32}_t {name};"] if option.kind == config.INTEGER else [],
        config.NUMBER: [f"double {name};"],
        config.WORD: [f"const char *{name};", f"uint32_t {name}_index; /* among the words allowed */"],
        config.PACE: [f"const char *{name};", "pacing_t pacing; /* its meaning */"],
    }.get(option.kind, [f"const char *{name};{'' if DEFAULTS[name] else ' /* NULL: none */'}"])
    return [f"    {declaration}" for declaration in declarations]


def _row(name: str, option: Option) -> list[str]:
    kind = f"OPTION_KIND_{option.kind.upper()}"
    companion: list[str] = []
    if option.kind == config.INTEGER:
        kind += "64" if _is_wide(option) else "32"
        companion = [f".minimum = {_integer(min(_range(option)))}", f".maximum = {_integer(max(_range(option)))}"]
        if option.choices:
            companion += [f".choices = (const uint32_t[]){{{', '.join(map(str, option.choices))}}}",
                          f".choice_count = {len(option.choices)}"]
    elif option.kind == config.NUMBER:
        companion = [f".low = {option.minimum!r}", f".high = {option.maximum!r}"]
    elif option.kind == config.WORD:
        companion = [f".words = (const char *const[]){{{', '.join(map(_string, option.choices))}, NULL}}",
                     f".parsed_offset = offsetof(options_t, {name}_index)"]
    elif option.kind == config.PACE:
        companion = [".parsed_offset = offsetof(options_t, pacing)"]
    return [f".name = {_string(config.flag_of(name)[2:])}", f".kind = {kind}", f".offset = offsetof(options_t, {name})",
            f".allowed = {_string(option.allowed)}", *companion]


def _default(name: str, option: Option) -> str:
    value = DEFAULTS[name]
    if not value or option.kind == config.BUS:  # the bus has to be given
        return ""
    if option.kind == config.WORD:
        return f".{name} = {_string(value)}, .{name}_index = {option.choices.index(value)}"
    if option.kind == config.PACE:
        return f".{name} = {_string(value)}"  # pacing follows from it when the options are read
    return f".{name} = {_integer(value) if option.kind == config.INTEGER else repr(value)}"


def _usage() -> list[str]:
    lines = ["usage: %s --can BUS --machine-image FILE [option...]\n"]
    for name, option in arguments().items():
        head = f"  {config.flag_of(name)} {option.metavar}".rstrip()
        gap = " " * max(2, _INDENT - len(head))
        lines.append(f"{head}{gap}{config.description(name)}\n".replace("%", "%%"))
    return lines


def _integer(value: int) -> str:
    return f"UINT64_C({value})" if value >= 2**32 else f"{value}u"


def _string(text: str) -> str:
    return json.dumps(text)


def main() -> int:
    """Writes both files."""
    if len(sys.argv) != 2:
        print("usage: python -m salient.generate.options OUTDIR", file=sys.stderr)
        return 2
    return write_files("salient.generate.options", Path(sys.argv[1]),
                       lambda: {"options_table.h": header(), "options_table.c": source()})


if __name__ == "__main__":
    sys.exit(main())
