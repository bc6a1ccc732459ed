"""Generated files: the parts that the generators share."""

import sys
from collections.abc import Callable, Mapping
from pathlib import Path


def write_files(
    program: str, folder: Path, generate: Callable[[], Mapping[str, str | bytes]], *invalid_input: type[Exception]
) -> int:
    """Writes what `generate` returns, file name -> content, into `folder`, which is made. Exit code 0, or 2 after one
    line on stderr: an exception of `invalid_input`, or a file or folder that cannot be used."""
    try:
        files = generate()
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    except invalid_input as error:
        print(f"{program}: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"{program}: {error.filename}: {error.strerror}", file=sys.stderr)
        return 2
    return 0


def cell(text: str) -> str:
    """A text on one line of a generated Markdown page, as in a cell of a table."""
    return " ".join(text.split()).replace("<", "&lt;")
