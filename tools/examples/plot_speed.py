"""Arms a drive, runs it at 600 r/min for a second, stops it, and plots its speed to speed.png.
    tools/salient sim --can unix:/tmp/salient.sock                                         in one terminal
    build/venv/bin/python tools/examples/plot_speed.py [unix:PATH|INTERFACE]               in another"""
import binascii
import sys
from pathlib import Path

import can
import cantools
import matplotlib.pyplot as plt

DRIVE = cantools.database.load_file(Path(__file__).resolve().parents[2] / "firmware" / "comms" / "drive.dbc")
HEARD = [{"can_id": identifier, "can_mask": 0x7FF, "extended": False} for identifier in (0x181, 0x18E)]

def protected(name: str, counter: int, **signals: object) -> can.Message:
    message = DRIVE.get_message_by_name(name)
    covered = message.encode({"checksum": 0, "counter": counter % 256, **signals})[2:]
    data_id = message.dbc.attributes["E2EDataId"].value.to_bytes(2, "little")
    data = binascii.crc_hqx(covered + data_id, 0xFFFF).to_bytes(2, "little") + covered
    return can.Message(arbitration_id=message.frame_id, is_extended_id=False, data=data)

channel = sys.argv[1] if len(sys.argv) > 1 else "unix:/tmp/salient.sock"
times_s, speeds_rpm, sent = [], [], 0
with can.Bus(channel, "salient" if channel.startswith("unix:") else "socketcan", can_filters=HEARD) as bus:
    while sent < 150:  # commands, one each 10 ms
        frame = bus.recv()
        values = DRIVE.decode_message(frame.arbitration_id, frame.data)
        if "speed_rpm" in values:  # DRIVE_MOTION
            times_s.append(frame.timestamp)
            speeds_rpm.append(values["speed_rpm"])
            if times_s[-1] - times_s[0] >= 0.01 * sent:
                request = "run" if sent < 100 else "stop"
                bus.send(protected("DRIVE_COMMAND", sent, request=request, speed_reference_rpm=600))
                sent += 1
        elif values["armed"] == "no" and sent < 100:  # DRIVE_ARMING
            answer = {"step": "confirm_run", "response": values["challenge"] ^ 0xFFFFFFFF}
            arm = answer if values["attempt"] == "run" else {"step": "request_run", "response": 0}
            bus.send(protected("DRIVE_ARM", int(arm is answer), **arm))
plt.plot(times_s, speeds_rpm)
plt.xlabel("time, s")
plt.ylabel("speed, r/min")
plt.savefig("speed.png")
