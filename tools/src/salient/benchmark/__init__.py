"""Speed of emulator and firmware."""
