"""A virtual machine with a kernel that has CAN."""
