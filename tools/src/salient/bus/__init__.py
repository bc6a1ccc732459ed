"""CAN: interface to the local bus, signals, end-to-end protection, logs, virtual time, monitor."""
