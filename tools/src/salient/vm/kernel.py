"""Debian's kernel, its modules for CAN and 9p, and a busybox for the VM: downloaded once and kept in the build folder.

Nothing is installed: the packages are fetched with `apt-get download`, which needs no root, and only the files
that the VM loads are kept (67 MB of the kernel's 400 MB).
"""

from __future__ import annotations

import lzma
import re
import shutil
import struct
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from salient.guard import removes

KERNEL_PACKAGE = "linux-image-amd64"  # the smaller cloud kernel has neither CAN nor 9p
BUSYBOX_PACKAGE = "busybox-static"
MODULES = ("virtio_pci", "virtio_console", "9pnet_virtio", "9p", "vcan", "can-raw", "can-bcm", "can-isotp")


class VmError(Exception):
    """The VM cannot be prepared or run. The message is one line for the user."""


@dataclass(frozen=True)
class VmFiles:
    """Files that QEMU boots from. `modules` are in the order in which they must be loaded."""

    kernel: Path
    modules: tuple[Path, ...]
    busybox: Path


def find(folder: Path) -> VmFiles | None:
    """The files kept in `folder`, or None when they have not been prepared yet."""
    if not folder.is_dir():
        return None
    return VmFiles(folder / "kernel", tuple(sorted((folder / "modules").glob("*.ko"))), folder / "busybox")


def prepare(folder: Path) -> VmFiles:
    """Download and unpack into `folder`. Raises VmError with what went wrong."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="unpack-", dir=folder.parent) as name:
        scratch = Path(name)
        removes(scratch)
        print(
            f"salient vm: downloading {KERNEL_PACKAGE} and {BUSYBOX_PACKAGE} (about 70 MB, once, into {folder}): "
            "this host has no usable vcan0, a VM with Debian's kernel has",
            file=sys.stderr,
        )
        _download(scratch)
        print("salient vm: unpacking the kernel", file=sys.stderr)
        for package in scratch.glob("*.deb"):
            _run(["dpkg-deb", "-x", str(package), str(scratch / "root")])
        ready = scratch / "ready"
        _keep(scratch / "root", ready)
        try:
            ready.rename(folder)
        except OSError:  # another run was faster
            if not folder.is_dir():
                raise
    files = find(folder)
    assert files
    return files


def _download(folder: Path) -> None:
    """`apt-get download` into `folder`; with newly downloaded package lists where the host's are missing or too old."""
    try:
        _apt_get_download(folder, [])
    except VmError:
        print("salient vm: fetching apt's package lists, the host's are missing or old", file=sys.stderr)
        (folder / "lists" / "partial").mkdir(parents=True)
        private = [
            "-o", f"Dir::State::lists={folder / 'lists'}",
            "-o", f"Dir::Cache={folder}",
            "-o", "Dir::Cache::pkgcache=",
            "-o", "Dir::Cache::srcpkgcache=",
        ]  # fmt: skip
        _run(["apt-get", *private, "-o", "APT::Sandbox::User=", "update"])
        _apt_get_download(folder, private)


def _apt_get_download(folder: Path, options: list[str]) -> None:
    try:
        depends = subprocess.run(
            ["apt-cache", *options, "depends", "--important", KERNEL_PACKAGE],
            capture_output=True,
            text=True,
            check=False,
        ).stdout
    except FileNotFoundError:
        depends = ""
    kernel = re.search(r"Depends: (linux-image-\S+)", depends)
    if not kernel:
        raise VmError(f"apt knows no package {KERNEL_PACKAGE}: the VM needs a Debian host")
    _run(
        ["apt-get", *options, "-o", "APT::Sandbox::User=", "download", kernel[1], BUSYBOX_PACKAGE],
        working_folder=folder,
    )


def _keep(root: Path, ready: Path) -> None:
    """Move the kernel, busybox and the modules, numbered in load order, from the unpacked packages to `ready`."""
    (ready / "modules").mkdir(parents=True)
    kernels = list((root / "boot").glob("vmlinuz-*"))
    if len(kernels) != 1:
        raise VmError(f"package {KERNEL_PACKAGE} holds {len(kernels)} kernels, expected 1")
    (ready / "kernel").write_bytes(_uncompressed(kernels[0].read_bytes()))
    shutil.move(root / "bin" / "busybox", ready / "busybox")
    found = {_module_name(path.stem): path for path in (root / "lib" / "modules").rglob("*.ko")}
    for number, module in enumerate(_load_order(found)):
        shutil.move(module, ready / "modules" / f"{number:02}-{module.name}")


def _uncompressed(image: bytes) -> bytes:
    """The ELF file within a bzImage, which QEMU boots as well: to unpack it in the VM takes 3 of 7 s.

    Layout: Linux, Documentation/x86/boot.rst (setup_sects, payload_offset, payload_length). An image whose payload is
    not xz is returned as it is.
    """
    protected_mode_code = (image[0x1F1] + 1) * 512
    offset, length = struct.unpack_from("<II", image, 0x248)
    payload = image[protected_mode_code + offset :][:length]
    if not payload.startswith(b"\xfd7zXZ\0"):
        return image
    return lzma.LZMADecompressor().decompress(payload)  # the size that follows the xz stream is left over


def _module_name(name: str) -> str:
    """The kernel takes - and _ in the names of modules for the same."""
    return name.strip().replace("-", "_")


def _load_order(found: dict[str, Path]) -> list[Path]:
    """MODULES and all that they depend on, each after what it needs."""
    order: list[Path] = []

    def add(name: str) -> None:
        path = found.get(_module_name(name))
        if path is None:
            raise VmError(f"package {KERNEL_PACKAGE} has no module {name}")
        if path in order:
            return
        depends = re.search(rb"\0depends=([^\0]*)\0", path.read_bytes())
        for other in filter(None, depends[1].decode().split(",") if depends else ()):
            add(other)
        order.append(path)

    for name in MODULES:
        add(name)
    return order


def _run(command: list[str], working_folder: Path | None = None) -> None:
    """Run, with its output, which is progress, on stderr."""
    try:
        subprocess.run(command, cwd=working_folder, stdout=sys.stderr, check=True)
    except FileNotFoundError:
        raise VmError(f"{command[0]} is missing: the VM needs a Debian host") from None
    except subprocess.CalledProcessError as error:
        raise VmError(f"{command[0]} failed with exit code {error.returncode}") from None
