"""Arms a drive, runs it at 600 r/min for two seconds by default, and stops it: docs/can/protocol.md in Python.
    tools/salient sim --can unix:/tmp/salient.sock                                         in one terminal
    build/venv/bin/python tools/examples/run_600_rpm.py [unix:PATH|INTERFACE [SECONDS]]    in another"""
import binascii
import sys
from pathlib import Path

import can
import cantools

DRIVE = cantools.database.load_file(Path(__file__).resolve().parents[2] / "firmware" / "comms" / "drive.dbc")
HEARD = [{"can_id": identifier, "can_mask": 0x7FF, "extended": False} for identifier in (0x180, 0x181, 0x18E)]

def protected(name: str, counter: int, **signals: object) -> can.Message:
    message = DRIVE.get_message_by_name(name)
    covered = message.encode({"checksum": 0, "counter": counter % 256, **signals})[2:]
    data_id = message.dbc.attributes["E2EDataId"].value.to_bytes(2, "little")
    data = binascii.crc_hqx(covered + data_id, 0xFFFF).to_bytes(2, "little") + covered
    return can.Message(arbitration_id=message.frame_id, is_extended_id=False, data=data)

channel, duration_s = sys.argv[1:] + ["unix:/tmp/salient.sock", "2.0"][len(sys.argv) - 1:]
start_us, sent, request, shown = None, 0, "run", {"state": "run", "speed_rpm": 0.0}
try:
    with can.Bus(channel, "salient" if channel.startswith("unix:") else "socketcan", can_filters=HEARD) as bus:
        while request == "run" or shown["state"] == "run":
            shown |= DRIVE.decode_message((message := bus.recv()).arbitration_id, message.data)
            start_us = shown.get("time_us") if start_us is None else start_us  # of the drive, whatever its pace
            if message.arbitration_id == 0x18E and request == "run" and shown["armed"] == "no":
                answer = {"step": "confirm_run", "response": shown["challenge"] ^ 0xFFFFFFFF}
                arm = answer if shown["attempt"] == "run" else {"step": "request_run", "response": 0}
                bus.send(protected("DRIVE_ARM", int(arm is answer), **arm))
            elif start_us is not None and (time_s := (shown["time_us"] - start_us) % 2**32 / 1e6) >= 0.01 * sent:
                request = "run" if time_s < float(duration_s) else "stop"
                bus.send(protected("DRIVE_COMMAND", sent, request=request, speed_reference_rpm=600))
                sent += 1
                if sent % 20 == 0:
                    print(f"{time_s:.2f} s  {shown['speed_rpm']:.1f} r/min")
    print("state", shown["state"])
except (can.CanError, OSError) as error:
    sys.exit(str(error))
