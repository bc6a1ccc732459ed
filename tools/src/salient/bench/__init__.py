"""The test bench: emulator process, session, drive and rig, pytest fixtures."""
