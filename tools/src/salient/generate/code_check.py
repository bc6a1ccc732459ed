"""Build step after the linking of an image: the reference of the firmware's check of its code (hal/hal_memory.h).

    python -m salient.generate.code_check IMAGE.elf

writes the number of words from code_start to code_end, and their CRC-32, to code_check in the image. An image without
that symbol has no such check and is left as it is.
"""

import argparse
import struct
import sys
import zlib
from pathlib import Path

from salient.elf import ElfImage
from salient.errors import UsageError


def write_reference(path: Path) -> None:
    """Writes the reference; UsageError."""
    image = ElfImage(path)
    symbols = image.symbols()
    if "code_check" not in symbols:
        return
    begin, end = symbols["code_start"], symbols["code_end"]
    code = image.read(begin, end - begin)
    offset = image.file_offset(symbols["code_check"])
    with path.open("r+b") as file:
        file.seek(offset)
        file.write(struct.pack("<II", len(code) // 4, zlib.crc32(code)))


def main(arguments: list[str] | None = None) -> int:
    """Exit code 0, or 2 after one line on stderr when the file cannot be used."""
    parser = argparse.ArgumentParser(prog="salient.generate.code_check", description="reference of the code check")
    parser.add_argument("image", type=Path, metavar="IMAGE.elf")
    options = parser.parse_args(arguments)
    try:
        write_reference(options.image)
    except UsageError as error:
        print(f"salient.generate.code_check: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"salient.generate.code_check: {options.image}: {error.strerror}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
