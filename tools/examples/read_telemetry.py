"""Prints 20 decoded frames of a running drive, for which it waits up to ten seconds.

    tools/salient sim --can unix:/tmp/salient.sock                                         in one terminal
    build/venv/bin/python tools/examples/read_telemetry.py [unix:PATH|INTERFACE]           in another

Uses python-can, cantools and the drive's DBC, as for any other node on a CAN bus.
"""

import itertools
import sys
import time
from pathlib import Path

import can
import cantools

DRIVE_DBC = Path(__file__).resolve().parents[2] / "firmware" / "comms" / "drive.dbc"
FRAMES = 20


def opened(channel: str, attempts: int = 100) -> can.BusABC:
    """The bus, once there is one."""
    interface = "salient" if channel.startswith("unix:") else "socketcan"
    for left in reversed(range(attempts)):
        try:
            return can.Bus(interface=interface, channel=channel)
        except (can.CanError, OSError):
            if not left:
                raise
            time.sleep(0.1)
    raise AssertionError


def main(channel: str = "unix:/tmp/salient.sock") -> None:
    drive = cantools.database.load_file(DRIVE_DBC)
    with opened(channel) as bus:
        # 11-bit identifiers belong to the drive, 29-bit identifiers to the test bench.
        telemetry = (message for message in bus if not message.is_extended_id)
        for message in itertools.islice(telemetry, FRAMES):
            name = drive.get_message_by_frame_id(message.arbitration_id).name
            print(f"{message.timestamp:.6f} {name} {drive.decode_message(message.arbitration_id, message.data)}")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except (can.CanError, OSError) as error:
        sys.exit(str(error))
