"""Prints the folder of the CMake package, which a wheel contains: cmake -Dsalient_DIR="$(python -m salient.cmake)".

In a clone `cmake --install build/host --prefix DIR` makes it, in DIR/lib/cmake/salient.
"""

from __future__ import annotations

import sys

from salient.paths import IS_WHEEL, ROOT


def main() -> int:
    """Prints the folder; exit code 2 when there is none."""
    if not IS_WHEEL:
        print("salient: only a wheel contains the CMake package; cmake --install build/host --prefix DIR installs it",
              file=sys.stderr)
        return 2
    print(ROOT / "install" / "lib" / "cmake" / "salient")
    return 0


if __name__ == "__main__":
    sys.exit(main())
