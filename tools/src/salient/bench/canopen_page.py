"""Writes the frames of a start-up into docs/can/canopen.md: a master with the package canopen, in virtual time.

    build/venv/bin/python -m salient.bench.canopen_page
"""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path

from salient.bench.bench import Bench
from salient.bench.canopen_network import network_on
from salient.machine.cache import bench_config
from salient.machine.eds import write_eds
from salient.paths import ROOT

PAGE = ROOT / "docs" / "can" / "canopen.md"
_BLOCK = re.compile(r"(```text\n).*?(```\n)", re.DOTALL)
_MEANINGS = {0x000: "NMT", 0x081: "EMCY", 0x701: "heartbeat, boot-up", 0x601: "SDO request", 0x581: "SDO response"}


def start_up() -> list[str]:
    """The frames as candump writes them, each with its service."""
    import canopen

    with tempfile.TemporaryDirectory(prefix="salient-") as folder:
        eds = Path(folder) / "drive.eds"
        write_eds(eds, "saturating")
        with Bench(bench_config({"protocol": "canopen"}), f"unix:{folder}/can.sock") as bench, \
                network_on(bench) as network:
            node = canopen.RemoteNode(1, str(eds))
            network.add_node(node)
            network.run_for(0.01)
            node.nmt.state = "OPERATIONAL"
            node.sdo["Target velocity"].raw = 600
            for word in (0x06, 0x07, 0x0F):
                node.sdo["Controlword"].raw = word
            network.run_for(0.02)
            frames = [(time_ns, frame) for time_ns, frame in bench.log if not frame.is_extended_id]
    return [f"({time_ns / 1e9:.6f}) can0 {frame.arbitration_id:03X} [{frame.dlc}] {frame.data.hex(' ').upper():<23}  "
            f"{_MEANINGS.get(frame.arbitration_id) or f'TPDO{(frame.arbitration_id - 0x181) // 0x100 + 1}'}"
            for time_ns, frame in frames]


def page(text: str) -> str:
    """The page with the frames of a start-up in its block."""
    frames = "\n".join(start_up()) + "\n"
    return _BLOCK.sub(lambda block: f"{block[1]}{frames}{block[2]}", text)


def main() -> int:
    """Writes the page; returns the exit code."""
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
