"""Runs a drive at 600 r/min, for two seconds by default, then switches it off.

    tools/salient sim --can unix:/tmp/salient.sock                                     in one terminal
    build/venv/bin/python tools/examples/run_600_rpm.py [unix:PATH [SECONDS]]          in another

Raw frames: commands to run every 10 ms of the drive's time, which is the time stamp of the frames; the drive takes them
as off until it is armed by a request and the response to its challenge. When no valid command arrives for 50 ms in the
state run the torque ramps to zero, and after 500 ms the drive trips with command_timeout.
"""

import sys

import can

from salient.bench.arming import arm_frame, response_to
from salient.bench.drive import command_frame
from salient.bus.interface import wait_until_ready
from salient.bus.signals import drive_database

SPEED_RPM = 600.0
COMMAND_PERIOD_S = 0.01


def main(channel: str = "unix:/tmp/salient.sock", duration_s: str = "2.0") -> None:
    status, motion, arming = (drive_database().get_message_by_name(name)
                              for name in ("DRIVE_STATUS", "DRIVE_MOTION", "DRIVE_ARMING"))
    wait_until_ready(channel)
    with can.Bus(interface="salient", channel=channel) as bus:
        start_s, counter, speed_rpm = None, 0, 0.0
        for message in bus:
            if message.arbitration_id == motion.frame_id and not message.is_extended_id:
                speed_rpm = motion.decode(message.data)["speed_rpm"]
            if message.arbitration_id == arming.frame_id and not message.is_extended_id:
                report = arming.decode(message.data)
                if report["attempt"] == "run":
                    bus.send(arm_frame(1, "confirm_run", response_to(report["challenge"])))
            start_s = message.timestamp if start_s is None else start_s
            elapsed_s = message.timestamp - start_s
            if elapsed_s >= float(duration_s):
                break
            if elapsed_s >= counter * COMMAND_PERIOD_S:
                bus.send(command_frame(counter % 256, "run", SPEED_RPM))
                if counter == 0:
                    bus.send(arm_frame(0, "request_run"))
                counter += 1
                if counter % 20 == 0:
                    print(f"{elapsed_s:.2f} s  {speed_rpm:.1f} r/min")
        bus.send(command_frame(counter % 256, "off", 0.0))
        # A client that disconnects with unread frames can lose what it sent last: wait for the effect.
        for message in bus:
            if message.arbitration_id == status.frame_id and not message.is_extended_id:
                state = status.decode(message.data)["state"]
                if state != "run":
                    print(f"state {state}")
                    break


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except can.CanError as error:
        sys.exit(str(error))
