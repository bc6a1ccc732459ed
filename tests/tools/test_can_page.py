"""The CAN pages, docs/can, computed from its own text: checksums by the parameters that it states, bytes
by the layouts that it states, names and numbers as in drive.dbc; and its frames, as the drive takes them."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import can
import pytest

from salient.bus.signals import drive_database
from salient.config import NODE_MAX
from salient.dbc import attributes
from salient.paths import ROOT

PAGE = "".join((ROOT / "docs" / "can" / name).read_text(encoding="utf-8") for name in ("protocol.md", "parameters.md"))
HEX_BYTES = re.compile(r"`((?:[0-9A-F]{2} )+[0-9A-F]{2})`")
PLACE = re.compile(r"(?:bytes? (\d)(?: (?:to|and) (\d))?)?(?:, )?(?:bits? (\d+)(?: (?:to|and) (\d+))?)? `(\w+)`")
FRAME = re.compile(r"`([A-Z_]+)` ((?:\w+ (?:0x[0-9A-F]+|[\w.-]+)(?:, )?)+)")


class Wrong(AssertionError):
    """The page contradicts itself."""


@dataclass
class Layout:
    """A message as the page describes it; places: first bit and number of bits of each signal."""

    identifier: int
    length: int
    data_id: int | None = None
    places: dict[str, tuple[int, int]] = field(default_factory=dict)
    numbers: dict[str, dict[str, int]] = field(default_factory=dict)


def tables(page: str) -> list[list[list[str]]]:
    """The cells of each table, the line of dashes left out."""
    found: list[list[list[str]]] = [[]]
    for line in page.splitlines():
        if line.startswith("|"):
            cells = [cell.strip() for cell in line.strip("|").split(" | ")]
            if not set(line) <= set("|- "):
                found[-1].append(cells)
        elif found[-1]:
            found.append([])
    return [table for table in found if table]


def number(text: str) -> int:
    return int(text.strip("`"), 0)


def number_or_name(text: str) -> float | str:
    if text.startswith("0x"):
        return number(text)
    return float(text) if re.fullmatch(r"-?[\d.]+", text) else text


def layouts(page: str) -> dict[str, Layout]:
    """Layouts that the tables with a column `identifier` and `bytes` describe."""
    found = {}
    for head, *rows in tables(page):
        if head[1:2] != ["identifier"] or "bytes" not in head:
            continue
        for row in rows:
            data_id = number(row[2]) if "data ID" in head else None
            layout = Layout(number(row[1]), int(row[head.index("bytes")]), data_id)
            if data_id is not None:
                layout.places |= {"checksum": (0, 16), "counter": (16, 8)}
            byte = 0
            for place in PLACE.finditer(row[-1]):
                first, last, low, high, name = place.groups()
                byte = int(first) if first else byte
                if low is None:
                    layout.places[name] = (8 * byte, 8 * (int(last or byte) - byte + 1))
                else:
                    layout.places[name] = (8 * byte + int(low), int(high or low) - int(low) + 1)
                listed = re.match(r": ((?:\d \w+(?:, )?)+)", row[-1][place.end():])
                if listed:
                    pairs = [text.split() for text in listed[1].rstrip(", ").split(", ")]
                    layout.numbers[name] = {text: int(value) for value, text in pairs}
            found[row[0].strip("`")] = layout
    found["DRIVE_TORQUE_COMMAND"].numbers |= found["DRIVE_COMMAND"].numbers  # "likewise"
    return found


def crc16(page: str, data: bytes) -> int:
    """The CRC with the parameters of the page, bit by bit."""
    [(_, *rows)] = [table for table in tables(page) if table[0][0].startswith("CRC-16")]
    of = {row[0]: row[1] for row in rows}
    if (of["input reflected"], of["output reflected"]) != ("no", "no"):
        raise Wrong("reflection")
    polynomial, crc = number(of["polynomial"]), number(of["initial value"])
    for byte in data:
        for bit in range(7, -1, -1):
            carry = crc >> 15 ^ byte >> bit & 1
            crc = (crc << 1 & 0xFFFF) ^ (polynomial if carry else 0)
    return crc ^ number(of["final XOR"])


def check(page: str) -> int:
    """Computes every frame of the page; their number. Wrong: one of its bytes is not what its text says."""
    known, database = layouts(page), drive_database()
    [test_value] = re.findall(r"CRC of the text `123456789` \| `(0x[0-9A-F]+)`", page)
    if crc16(page, b"123456789") != number(test_value):
        raise Wrong(f"CRC of the test value {test_value}")
    frames = 0
    for head, *rows in tables(page):
        if "data" not in head:
            continue
        for row in rows:
            frames += 1
            [described] = FRAME.findall(" ".join(row))
            name, node = described[0], int((re.findall(r"of node (\d)", " ".join(row)) or "0")[0])
            layout, data = known[name], bytes.fromhex(HEX_BYTES.findall(row[head.index("data")])[0])
            if (number(row[head.index("identifier")]), len(data)) != (layout.identifier + 16 * node, layout.length):
                raise Wrong(f"identifier or length: {row}")
            said = dict(pair.split() for pair in described[1].rstrip(", ").split(", ") if len(pair.split()) == 2)
            message = database.get_message_by_name(name)
            values = {text: number_or_name(value) for text, value in said.items()}
            rest = {signal.name: 0 for signal in message.signals if signal.name not in values}
            expected = message.encode({**rest, **values}, strict=False)
            header = 0 if layout.data_id is None else 2
            if data[header:] != expected[header:]:
                raise Wrong(f"{row}: {expected.hex(' ')}")
            if layout.data_id is None:
                continue
            covered = data[2:] + (layout.data_id + 16 * node).to_bytes(2, "little")
            if int.from_bytes(data[:2], "little") != crc16(page, covered):
                raise Wrong(f"checksum: {row}")
            if "checksum" in head and (HEX_BYTES.findall(row[2]) != [covered.hex(" ").upper()]
                                       or number(row[3]) != crc16(page, covered)):
                raise Wrong(f"working: {row}")
    return frames


def frames_of(page: str, name: str) -> list[tuple[int, bytes]]:
    """(identifier, data) of the worked frames of a message, node 0."""
    [worked] = [table for table in tables(page) if "checksum" in table[0]]
    return [(number(row[1]), bytes.fromhex(row[-1].strip("`"))) for row in worked[1:]
            if f"`{name}`" in row[0] and "of node" not in row[0]]


def test_every_frame_is_what_the_text_says() -> None:
    assert check(PAGE) == 27


def test_every_protected_message_is_worked_out_and_stated_as_in_the_database() -> None:
    protected = {m.name: m for m in drive_database().messages if "E2EDataId" in attributes(m)}
    stated = {name: layout for name, layout in layouts(PAGE).items() if layout.data_id is not None}
    assert set(stated) == set(protected) and len(stated) == 8
    for name, message in protected.items():
        assert stated[name].data_id == int(attributes(message)["E2EDataId"])
        assert frames_of(PAGE, name)
    for name, layout in layouts(PAGE).items():
        message = drive_database().get_message_by_name(name)
        assert (layout.identifier, layout.length) == (message.frame_id, message.length)
        assert layout.places
        for signal, place in layout.places.items():
            of_database = message.get_signal_by_name(signal)
            assert place == (of_database.start, of_database.length), (name, signal)
        for signal, numbers in layout.numbers.items():
            choices = message.get_signal_by_name(signal).choices or {}
            assert {str(text): value for value, text in choices.items() if value <= max(numbers.values())} == numbers
        if layout.data_id is not None:
            assert set(layout.places) == {signal.name for signal in message.signals}
    assert f"node n, 0 to {NODE_MAX}, every identifier and every data ID is higher by 16 n" in PAGE


def test_limits_are_those_of_the_firmware() -> None:
    sources = "".join(path.read_text() for path in (ROOT / "firmware" / "comms").glob("*.h"))
    for name, value in (("ARMING_RESPONSE_MIN_US", "200u"), ("ARMING_RESPONSE_MAX_US", "500000u"),
                        ("ARMING_INTERVAL_US", "10000u"), ("COMMANDS_ARMED_UNUSED_US", "500000u"),
                        ("COMMANDS_SENDER_LOST_US", "30000u"), ("COMMANDS_ERRORS_MAX", "4u"),
                        ("E2E_COUNTER_STEP_MAX", "3"), ("E2E_RESYNCHRONISE_FRAMES", "3")):
        assert f"#define {name} {value}\n" in sources, name
    text = " ".join(PAGE.split())
    for said in ("0.2 to 500 ms after the challenge", "less than 10 ms after one", "requested within 500 ms",
                 "silent for 30 ms", "Four invalid frames", "1, 2 or 3 above the last", "third of three frames"):
        assert said in text


def test_another_byte_anywhere_is_found() -> None:
    """Each byte of each frame, identifier, data ID and parameter of the CRC, one at a time."""
    places = [match.start(1) + offset for match in HEX_BYTES.finditer(PAGE) for offset in range(0, len(match[1]), 3)]
    rows = re.compile(r"^\| (?:`(?:DRIVE_(?:COMMAND|TORQUE|POSITION|IDENTIFY|ARM)|PARAMETER)\w*`|host|polynomial"
                      r"|initial|final|CRC of).*", re.MULTILINE)
    places += [row.start() + match.end(1) - 2 for row in rows.finditer(PAGE)
               for match in re.finditer(r"`(0x[0-9A-F]{3,8})`", row[0])
               if "COUNTERS" not in row[0]]
    assert len(places) > 250
    used = {match[1] for table in tables(PAGE) if "data" in table[0] for row in table[1:]
            for match in re.finditer(r"`([A-Z_]+)`", " ".join(row))}
    for place in places:
        line = PAGE[PAGE.rindex("\n", 0, place) + 1:place]
        if line.startswith("| `") and line.split("`")[1] not in used:
            continue
        wrong = f"{int(PAGE[place:place + 2], 16) ^ 0x10:02X}"
        with pytest.raises((Wrong, ValueError)):
            check(PAGE[:place] + wrong + PAGE[place + 2:])


def test_the_drive_finds_every_checksum_right_and_every_other_one_wrong(bench) -> None:
    """By its own counters; a set, and a response to no challenge, are refused for other reasons."""
    bench.run_for(0.2)
    names = [name for name, layout in layouts(PAGE).items() if layout.data_id is not None]
    frames = [frame for name in names for frame in frames_of(PAGE, name)]
    assert len(frames) == 11
    for flip, expected in ((0, 0), (1, len(frames))):
        for identifier, data in frames:
            sent = data[:-1] + bytes([data[-1] ^ flip])
            bench.send(can.Message(arbitration_id=identifier, is_extended_id=False, data=sent))
            bench.run_for(0.06)  # silence, after which any counter is accepted
        bench.run_for(0.2)
        counters = {name: bench.telemetry[f"DRIVE_COMMAND_COUNTERS.{name}"].last for name in
                    ("wrong_length", "wrong_checksum", "wrong_counter", "out_of_range")}
        assert counters == {"wrong_length": 0, "wrong_checksum": expected, "wrong_counter": 0, "out_of_range": 0}
    assert bench.telemetry["DRIVE_BUS_COUNTERS.command_accepted"].last == 7
