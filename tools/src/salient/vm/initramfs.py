"""The VM's initramfs: a cpio archive in the "newc" format.

Format: Linux, Documentation/driver-api/early-userspace/buffer-format.rst.
"""

from __future__ import annotations

import stat


class Cpio:
    """An archive under construction. All entries belong to root and carry no time: equal contents give equal bytes."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._entries = 0

    def add_folder(self, name: str) -> None:
        """`name` is relative to the root of the VM, without a leading slash."""
        self._add(name, stat.S_IFDIR | 0o755, b"")

    def add_file(self, name: str, content: bytes, *, executable: bool = False) -> None:
        """`name` as in `add_folder`; its folder must have been added before."""
        self._add(name, stat.S_IFREG | (0o755 if executable else 0o644), content)

    def finished(self) -> bytes:
        """The whole archive; nothing may be added afterwards."""
        self._add("TRAILER!!!", 0, b"")
        return bytes(self._data)

    def _add(self, name: str, mode: int, content: bytes) -> None:
        self._entries += 1
        encoded = name.encode() + b"\0"
        # inode, mode, uid, gid, links, mtime, size, device major and minor, rdev major and minor, name size, checksum
        fields = (self._entries, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(encoded), 0)
        self._data += b"070701" + b"".join(b"%08X" % field for field in fields) + encoded
        self._pad()
        self._data += content
        self._pad()

    def _pad(self) -> None:
        self._data += bytes(-len(self._data) % 4)
