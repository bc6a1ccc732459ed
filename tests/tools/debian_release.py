"""Runs the README's two commands, or others, in a fresh clone within a chroot of another Debian release.

    build/venv/bin/python tests/tools/debian_release.py trixie ["tools/salient demo" ...] [--out DIR]

debootstrap makes the chroot, with Git and Python alone; Salient's own commands install what else they need. It stays
for the next run, and takes 6 GB; the clone is a new one, of the commit that is checked out. Needs root. Exit code: of
the first command that fails.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from fresh_clones import commit_of, environment, make_clone

from salient.paths import BUILD, ROOT

COMMANDS = ("tools/salient demo", "tools/salient test")
PACKAGES = "ca-certificates,git,python3"
OF_HOST = ("/etc/resolv.conf", "/etc/pip.conf", "/etc/ssl/certs/ca-certificates.crt")
"""Files by which programs reach the registries."""
CLONE = "root/salient"
ENTER = """
set -eu
mount --rbind /dev "$1/dev"
mount -t proc proc "$1/proc"
mount -t sysfs sys "$1/sys"
exec chroot "$1" sh -c "cd /$2 && $3"
"""
"""In a mount namespace of its own, which ends with the command."""


def prepare(release: str, root: Path) -> None:
    """Makes the chroot unless it exists, with the files of the host that it needs."""
    if not (root / "etc" / "debian_version").exists():
        subprocess.run(["debootstrap", "--variant=minbase", f"--include={PACKAGES}", release, root], check=True)
    for name in filter(os.path.exists, OF_HOST):
        shutil.copy(name, f"{root}{name}")


def run(root: Path, command: str) -> int:
    """Exit code of a command in the clone. Its processes end with it."""
    line = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "sh", "-c", ENTER, "sh", root, CLONE, command]
    variables = {**environment(), "HOME": "/root", "LANG": "C.UTF-8"}
    return subprocess.run(line, env=variables, stdin=subprocess.DEVNULL, check=False).returncode


def main(arguments: Sequence[str] | None = None) -> int:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("release", help="name of the Debian release, as trixie")
    parser.add_argument("commands", nargs="*", default=COMMANDS, metavar="COMMAND", help="default: %(default)s")
    parser.add_argument("--out", type=Path, default=BUILD / "debian", metavar="DIR",
                        help="folder of the chroots (default %(default)s)")
    options = parser.parse_args(arguments)
    if os.geteuid() != 0:
        parser.error("a chroot needs root")
    if missing := [name for name in ("debootstrap", "unshare") if shutil.which(name) is None]:
        parser.error(f"{', '.join(missing)} missing: apt-get install debootstrap util-linux")
    root = options.out.absolute() / options.release
    prepare(options.release, root)
    make_clone(ROOT, commit_of(ROOT), root / CLONE)
    for command in options.commands:
        print(f"{options.release}: {command}", flush=True)
        code = run(root, command)
        if code != 0:
            return code
    return 0


if __name__ == "__main__":
    sys.exit(main())
