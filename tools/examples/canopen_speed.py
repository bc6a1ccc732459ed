"""Runs a drive as a CANopen device at 600 r/min for two seconds of the wall clock, and stops it.

    tools/salient machine saturating --eds /tmp/drive.eds
    tools/salient sim --can unix:/tmp/salient.sock --protocol canopen                          in one terminal
    build/venv/bin/python tools/examples/canopen_speed.py /tmp/drive.eds [unix:PATH|INTERFACE [RPM]]   in another
"""

import sys
import time

import can
import canopen

HEARTBEAT_MS, LOST_MS, MASTER = 100, 500, 0x7F
STATES = {"switched off": 0x40, "enabled": 0x27}
MASK = {"switched off": 0x4F, "enabled": 0x6F}


def wait_for(node: canopen.RemoteNode, state: str) -> None:
    for _ in range(200):
        if node.sdo["Statusword"].raw & MASK[state] == STATES[state]:
            return
        time.sleep(0.05)
    word, code = node.sdo["Statusword"].raw, node.sdo["Error code"].raw
    raise SystemExit(f"not {state}: statusword {word:#06x}, error code {code:#06x}")


def main(eds: str, channel: str = "unix:/tmp/salient.sock", speed_rpm: str = "600") -> None:
    network = canopen.Network()
    network.connect(interface="salient" if channel.startswith("unix:") else "socketcan", channel=channel)
    try:
        node = network.add_node(1, eds)
        node.sdo.RESPONSE_TIMEOUT = 5.0
        # The drive stops when this heartbeat is missing, and this side can tell that the drive lives.
        node.sdo["Consumer heartbeat time"][1].raw = MASTER << 16 | LOST_MS
        node.sdo["Producer heartbeat time"].raw = HEARTBEAT_MS
        heartbeat = network.send_periodic(0x700 + MASTER, b"\x05", HEARTBEAT_MS / 1000)
        node.nmt.state = "OPERATIONAL"
        node.sdo["Modes of operation"].raw = 3  # profile velocity
        node.sdo["Profile acceleration"].raw = 3000
        node.sdo["Target velocity"].raw = int(speed_rpm)
        for command in (0x06, 0x07, 0x0F):  # shutdown, switch on, enable operation
            node.sdo["Controlword"].raw = command
        wait_for(node, "enabled")
        for _ in range(20):
            time.sleep(0.1)
            print(f"{node.sdo['Velocity actual value'].raw} r/min, torque {node.sdo['Torque actual value'].raw / 10} %")
        node.sdo["Controlword"].raw = 0x02  # quick stop
        wait_for(node, "switched off")
        print("stopped")
        heartbeat.stop()
    finally:
        network.disconnect()


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except (can.CanError, canopen.SdoCommunicationError, OSError) as error:
        sys.exit(str(error))
