"""A QEMU virtual machine (VM) with Debian's kernel, for tests on real SocketCAN where the host has no vcan0.

virtme-ng does the same for interactive kernel development, but not what these tests need:
- No root and no installation: the kernel is unpacked from its Debian package under build/; virtme-ng expects kernel and
  modules in /boot and /lib/modules with the index files of depmod.
- Standard output, standard error and exit code of the command arrive separately, over virtio ports, and a VM that ends
  without an exit code is an error.
- The host's files are read-only except the folders that the caller names.
- One dependency less to pin: the standard library, QEMU and a static busybox are enough.
"""
