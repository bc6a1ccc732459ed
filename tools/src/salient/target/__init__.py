"""Firmware on the emulated targets: instruction counts, traces, static checks."""
