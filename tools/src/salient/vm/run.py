"""Run a command where SocketCAN has a vcan0: on this host if its kernel has one, else in a QEMU VM.

    python -m salient.vm.run [--timeout-s N] [--write DIR] [--force-vm] [--no-install] -- COMMAND [ARGUMENT ...]

The VM runs Debian's kernel in QEMU without KVM (KVM hangs on some virtual machines), some 20 times slower than the
host. It sees the host's files at their own paths, read-only except the repository's build folder and each --write DIR.
/tmp, /var/tmp, /run and /dev/shm are its own and empty; there is no network but the loopback. The command gets the
host's environment and working folder and an empty standard input; its output and exit code are passed on.

Exit codes: the command's own; 1 when the VM failed or took longer than --timeout-s; 2 for a usage error.
"""

from __future__ import annotations

import argparse
import os
import platform
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

from salient.errors import UsageError
from salient.guard import guarded
from salient.paths import BUILD, ROOT
from salient.vm import kernel
from salient.vm.initramfs import Cpio
from salient.vm.kernel import VmError, VmFiles

VM_FOLDER = BUILD / "vm"
KERNEL_FOLDER = VM_FOLDER / "debian"
INTERFACE = "vcan0"
QEMU = "qemu-system-x86_64"
QEMU_PACKAGE = "qemu-system-x86"
HIDDEN_FOLDERS = ("/tmp", "/var/tmp", "/run", "/var/run", "/dev", "/proc", "/sys")
"""The VM has its own; of the host's only the shared folders inside them are seen."""
CANFD_MTU = 72


def host_has_vcan() -> bool:
    """True when a socket on this host can use vcan0 with flexible data rate; root creates a missing vcan0."""
    if not hasattr(socket, "AF_CAN"):
        return False
    try:
        with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as can:
            if not _is_up() and not (os.geteuid() == 0 and _make_interface() and _is_up()):
                return False
            can.bind((INTERFACE,))
    except OSError:
        return False
    return True


def missing_packages() -> list[str]:
    """The Debian packages that must be installed before `python -m salient.vm.run` works here; empty when none.

    Where root can make vcan0 on this host, it is made: only then is it known that no VM is needed.
    """
    if host_has_vcan() or shutil.which(QEMU):
        return []
    return [QEMU_PACKAGE]


def run_in_vm(
    command: list[str], *, write: Sequence[Path] = (), timeout_s: float = 600.0, install: bool = True
) -> int:
    """Boot the VM, run `command` there and return its exit code.

    `write`: folders of the host, besides the build folder, that the command may write to.
    `install`: whether Debian's kernel may be downloaded where it is missing.
    Raises VmError when the VM cannot be started, ends by itself or takes longer than `timeout_s`, UsageError when
    it does not see the working folder.
    """
    if platform.machine() != "x86_64":
        raise VmError(f"the VM runs the programs of this host and needs x86_64, not {platform.machine()}")
    if not shutil.which(QEMU):
        raise VmError(f"{QEMU} is missing: install the Debian package {QEMU_PACKAGE}")
    files = kernel.find(KERNEL_FOLDER)
    if files is None:
        if not install:
            raise VmError(f"{KERNEL_FOLDER} is missing: call without --no-install to download Debian's kernel")
        files = kernel.prepare(KERNEL_FOLDER)
    shares = [(ROOT, "ro"), (BUILD.resolve(), "rw"), *((folder.resolve(), "rw") for folder in write)]
    working_folder = Path.cwd()
    if not _is_visible(working_folder, [path for path, _ in shares]):
        raise UsageError(f"{working_folder} is not visible in the VM: call from the repository or another folder")
    with tempfile.TemporaryDirectory(prefix="salient-") as name:
        scratch = Path(name)
        (scratch / "initramfs").write_bytes(_initramfs(files, shares, command, working_folder))
        exit_code = _run_qemu(files.kernel, shares, scratch, timeout_s)
        if exit_code is None:
            shutil.copy(scratch / "console.log", VM_FOLDER / "console.log")
            raise VmError(f"the VM ended without an exit code: see {VM_FOLDER / 'console.log'}")
    return exit_code


def _is_up() -> bool:
    interface = Path("/sys/class/net") / INTERFACE
    try:
        flags = int((interface / "flags").read_text(), 16)
        return bool(flags & 1) and int((interface / "mtu").read_text()) >= CANFD_MTU  # 1: IFF_UP
    except OSError:
        return False


def _make_interface() -> bool:
    """Make and start vcan0 on the host. Returns whether the last step worked."""
    steps = (
        ["modprobe", "-q", "vcan"],
        ["ip", "link", "add", "dev", INTERFACE, "type", "vcan"],
        ["ip", "link", "set", INTERFACE, "mtu", str(CANFD_MTU), "up"],
    )
    worked = False
    for step in steps:
        try:
            worked = subprocess.run(step, capture_output=True, check=False).returncode == 0
        except FileNotFoundError:
            worked = False
    if worked:
        print(f"salient vm: made {INTERFACE} on this host", file=sys.stderr)
    return worked


def _is_visible(path: Path, shared: list[Path]) -> bool:
    if any(path.is_relative_to(folder) for folder in shared):
        return True
    return not any(path.is_relative_to(hidden) for hidden in HIDDEN_FOLDERS)


def _initramfs(files: VmFiles, shares: list[tuple[Path, str]], command: list[str], working_folder: Path) -> bytes:
    archive = Cpio()
    for folder in ("bin", "dev", "host", "job", "modules"):
        archive.add_folder(folder)
    archive.add_file("init", Path(__file__).with_name("init.sh").read_bytes(), executable=True)
    archive.add_file("bin/busybox", files.busybox.read_bytes(), executable=True)
    for module in files.modules:
        archive.add_file(f"modules/{module.name}", module.read_bytes())
    lines = [f"{_tag(number)} {mode} {path}\n" for number, (path, mode) in enumerate(shares)]
    archive.add_file("job/shares", "".join(lines).encode())
    archive.add_file("job/command.sh", _script(command, working_folder).encode(errors="surrogateescape"))
    return archive.finished()


def _script(command: list[str], working_folder: Path) -> str:
    """The command with the host's environment, for /bin/sh. The host's TMPDIR is not in the VM."""
    variables = {key: value for key, value in os.environ.items() if re.fullmatch(r"[A-Za-z_]\w*", key, re.ASCII)}
    variables["TMPDIR"] = "/tmp"
    exports = [f"export {key}={shlex.quote(value)}" for key, value in variables.items()]
    return "\n".join([*exports, f"cd {shlex.quote(str(working_folder))} || exit", f"exec {shlex.join(command)}", ""])


def _tag(number: int) -> str:
    return f"share{number}"


def _run_qemu(kernel: Path, shares: list[tuple[Path, str]], scratch: Path, timeout_s: float) -> int | None:
    """The command's exit code, or None when QEMU ended before it was known."""
    arguments = [
        QEMU, "-nodefaults", "-no-user-config", "-no-reboot", "-display", "none",
        # Measured: importing numpy, python-can and cantools takes 7 s; with two processors and mitigations, 13 s.
        "-machine", "pc", "-accel", "tcg", "-cpu", "max", "-smp", "1", "-m", "2G",
        "-kernel", str(kernel), "-initrd", str(scratch / "initramfs"),
        "-append", "console=ttyS0 quiet panic=-1 mitigations=off",
        "-chardev", f"file,id=console,path={_escaped(scratch / 'console.log')}", "-serial", "chardev:console",
        "-device", "virtio-serial",
    ]  # fmt: skip
    for number, (path, mode) in enumerate([(Path("/"), "ro"), *shares]):
        tag = _tag(number - 1) if number else "root"
        read_only = "on" if mode == "ro" else "off"
        arguments += [
            "-fsdev", f"local,id={tag},path={_escaped(path)},security_model=none,multidevs=remap,readonly={read_only}",
            "-device", f"virtio-9p-pci,fsdev={tag},mount_tag={tag}",
        ]  # fmt: skip
    code_file = scratch / "exit_code"
    pumps: list[threading.Thread] = []
    pipes = [os.pipe(), os.pipe()]
    for name, target in (
        ("out", f"/dev/fd/{pipes[0][1]}"),
        ("err", f"/dev/fd/{pipes[1][1]}"),
        ("code", str(code_file)),
    ):
        arguments += ["-chardev", f"file,id={name},path={_escaped(target)}",
                      "-device", f"virtserialport,chardev={name}"]

    qemu = subprocess.Popen(arguments, stdin=subprocess.DEVNULL, pass_fds=[write for _, write in pipes])
    try:
        for (read, write), sink in zip(pipes, (sys.stdout.buffer, sys.stderr.buffer), strict=True):
            os.close(write)
            pumps.append(threading.Thread(target=_pump, args=(read, sink)))
            pumps[-1].start()
        if qemu.wait(timeout_s):
            raise VmError(f"{QEMU} failed with exit code {qemu.returncode}")
    except subprocess.TimeoutExpired:
        raise VmError(f"the command did not end within --timeout-s {timeout_s:g}: VM killed") from None
    finally:
        qemu.kill()
        qemu.wait()
        for pump in pumps:
            pump.join()
    code = code_file.read_text().strip() if code_file.exists() else ""
    return int(code) if code else None


def _pump(read: int, sink: BinaryIO) -> None:
    with os.fdopen(read, "rb", buffering=0) as source:
        while data := source.read(65536):
            try:
                sink.write(data)
                sink.flush()
            except BrokenPipeError:
                pass  # no reader any more; the command may still finish


def _escaped(value: Path | str) -> str:
    """A comma in the value of a QEMU option is written twice."""
    return str(value).replace(",", ",,")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m salient.vm.run", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--timeout-s", type=float, default=600.0, help="time limit of the VM (default 600)")
    parser.add_argument("--write", type=Path, action="append", default=[], metavar="DIR", help="writable there too")
    parser.add_argument("--force-vm", action="store_true", help="use the VM even where the host has a vcan0")
    parser.add_argument("--no-install", action="store_true", help="stop instead of downloading Debian's kernel")
    parser.add_argument("command", nargs="+", metavar="COMMAND", help="after --")
    options = parser.parse_args()
    for folder in options.write:
        if not folder.is_dir():
            parser.error(f"--write {folder}: not a folder")
    if not options.timeout_s > 0:
        parser.error(f"--timeout-s {options.timeout_s:g}: must be above 0")
    if not options.force_vm and host_has_vcan():
        try:
            os.execvp(options.command[0], options.command)
        except OSError as error:
            print(f"salient vm: {options.command[0]}: {error.strerror}", file=sys.stderr)
            return 127
    try:
        return run_in_vm(
            options.command, write=options.write, timeout_s=options.timeout_s, install=not options.no_install
        )
    except (VmError, UsageError) as error:
        print(f"salient vm: {error}", file=sys.stderr)
        return 2 if isinstance(error, UsageError) else 1
    except KeyboardInterrupt:
        return 128 + signal.SIGINT


if __name__ == "__main__":
    with guarded():
        sys.exit(main())
