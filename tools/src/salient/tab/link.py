"""The link by which the run of a failed test happens again, to the bit, in a browser tab (page/link.js)."""

from __future__ import annotations

import base64
import struct
import zlib
from collections import Counter

import can

from salient.bench.bench import Bench
from salient.bus.interface import CAN_EFF_FLAG
from salient.bus.signals import frame_key
from salient.config import DEFAULTS
from salient.machine.path import machine_path
from salient.paths import IS_WHEEL, MACHINES, OUT
from salient.tab.build_id import build_id

FILE = OUT / "tab.html"
LENGTH_MAX = 16_000
"""Characters of a link that terminals and browsers still take."""
_FRAME = struct.Struct("<QIB")
"""Time since the frame before in ns, identifier, length; then the data."""
_OPTIONS = ("controller", "control_rate_hz", "encoder_bits", "encoder_edges", "adc_bits", "immediate_pwm", "seed",
            "initial_angle_deg", "bit_rate")
_ONLY_ALONE = ("drive_only", "memory", "node", "protocol")
"""Options that a tab does not have."""


def link_of(bench: Bench) -> str | None:
    """The link to the run of a bench; None where a tab cannot repeat it: another build than the host's, a machine file
    of one's own, several drives or clients, a memory from before, other frames than classic data, too many of them."""
    options = bench.options
    if (IS_WHEEL or options.program is not None or options.build != "host"
            or options.drives != 1 or not bench.address.startswith("unix:")
            or machine_path(options.machine).parent != MACHINES or machine_path(options.machine).suffix != ".toml"
            or options.true_machine is not None
            or any(getattr(options, name) != DEFAULTS[name] for name in _ONLY_ALONE)
            or not all(_is_classic(message) for _, message in bench.sent) or _others_sent(bench)):
        return None
    parts = [f"build={build_id()}", f"machine={machine_path(options.machine).stem}"]
    for name in _OPTIONS:
        value = getattr(options, name)
        if value != DEFAULTS[name]:
            parts.append(f"{name}={'true' if value is True else value}")
    parts += [f"telemetry_period_ms={options.telemetry_period_ms}", f"frames={pack(bench.sent)}",
              f"until={bench.time_ns / 1e9:.9f}"]
    link = f"{FILE}#{'&'.join(parts)}"
    return link if len(link) <= LENGTH_MAX else None


def pack(frames: list[tuple[int, can.Message]]) -> str:
    """Frames with their times, compressed, in the letters of an address."""
    data, before_ns = b"", 0
    for time_ns, message in frames:
        identifier = message.arbitration_id | (CAN_EFF_FLAG if message.is_extended_id else 0)
        data += _FRAME.pack(time_ns - before_ns, identifier, len(message.data)) + bytes(message.data)
        before_ns = time_ns
    return base64.urlsafe_b64encode(zlib.compress(data, 9)).decode().rstrip("=")


def _is_classic(message: can.Message) -> bool:
    return not (message.is_fd or message.is_remote_frame or message.is_error_frame or message.dlc > 8)


def _others_sent(bench: Bench) -> bool:
    """True when the log has frames of a client that the bench is not."""
    of_hosts = {frame_key(message)
                for database in (bench.drive_database, bench.rig_database) for message in database.messages
                if "HOST" in message.senders and message.name != "RIG_RUN_UNTIL"}
    seen = Counter(_key(message) for _, message in bench.log
                   if (message.arbitration_id, message.is_extended_id) in of_hosts)
    return bool(seen - Counter(_key(message) for _, message in bench.sent))


def _key(message: can.Message) -> tuple[int, bool, bytes]:
    return message.arbitration_id, message.is_extended_id, bytes(message.data)
