"""Frames of logs that are text, line by line: candump, ASC, TRC, BUSMASTER, the print of python-can, and CSV of
SavvyCAN, CANedge's converter and python-can.

The readers of python-can lose what these keep: times below a microsecond since 1970 and negative ones, ASC without data
bytes or with length codes above 8, error frames and version 1.2 of TRC; and they take a line that is cut off for a
shorter frame. A line that should be a frame and is not raises Damage; other events of a format are passed over.
"""

from __future__ import annotations

import base64
import binascii
import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from itertools import chain

import can
from can.util import dlc2len

from salient.bus.log_input import Damage, Line, LogInput

Frames = Iterator[tuple[int, can.Message]]
_NS = 1_000_000_000
_SHOWN = 60
_ERROR_FLAG = 0x20000000
_REMEMBERED = 4096  # identifiers whose length is known, for a last line without an end


def read_text(file: LogInput, suffix: str) -> Frames:
    """Time in ns and frame, of the format that the first line shows, else the suffix's. Damage."""
    lines = (line for line in file.lines() if line.text.strip(" \t\0"))
    first = next(lines, None)
    if first is None:
        return iter(())
    read = next((reader for pattern, reader in _SIGNS if pattern.match(first.text)), _OF_SUFFIX[suffix])
    return read(chain([first], lines), file)


def nanoseconds(text: str, per_s: int = 1) -> int:
    """Decimal text as nanoseconds, without a rounding. per_s: units in a second. Damage: it is no number of some
    centuries."""
    try:
        value = Decimal(text.replace(",", ".")) * _NS / per_s
    except InvalidOperation:
        raise ValueError(f"{text[:_SHOWN]!r} is no time") from None
    if not value.is_finite() or abs(value) > 1 << 63:
        raise ValueError(f"{text[:_SHOWN]!r} is no time")
    return int(value.to_integral_value())


# --- candump ----------------------------------------------------------------------------------------------------------

_CANDUMP = re.compile(
    r"\s*\((?P<time>(?:\d{4}-\d\d-\d\d \d\d:\d\d:)?-?\d{1,20}(?:\.\d{1,9})?)\)\s+\S+\s+"
    r"(?:(?P<identifier>[\dA-F]{3}|[\dA-F]{8})#"
    r"(?:#(?P<flags>[\dA-F])(?P<flexible>(?:[\dA-F]{2}\.?){0,64})"
    r"|(?:R(?P<remote>[0-8]?)|(?P<data>(?:[\dA-F]{2}\.?){0,8}))(?:_(?P<raw_length>[9A-F]))?)(?:\s+[RT])?"
    r"|(?:[RT]X\s+(?P<brs>[-B])\s+(?P<esi>[-E])\s+)?"  # as candump shows frames, not as it logs them
    r"(?P<shown>[\dA-F]{3}|[\dA-F]{8})\s+[\[{](?P<length>\d\d?|[\dA-F])[]}]"
    r"(?:\s+(?P<request>remote request)|(?P<bytes>(?:\s+[\dA-F]{2})*))(?:\s+ERRORFRAME)?(?:\s+'.*')?)\s*",
    re.ASCII | re.IGNORECASE)
_COLOUR = re.compile(r"\x1b\[[\d;]*m")


def _read_candump(lines: Iterator[Line], file: LogInput) -> Frames:
    lengths: dict[int, int] = {}
    for line in lines:
        if line.text.lstrip().startswith("#") or line.text.startswith("\t"):  # a comment, or what an error frame means
            continue
        match = _CANDUMP.fullmatch(_COLOUR.sub("", line.text))
        if match is None:
            if _CANDUMP.fullmatch(f"(0) {line.text}"):
                raise line.damage("a frame without a time; candump writes it with -L or -ta")
            raise line.damage(f"{line.text.strip()[:_SHOWN]!r} is no frame as candump writes it")
        try:
            message = _logged(match) if match["identifier"] else _shown(match)
            time_ns = _candump_time(match["time"])
        except ValueError as error:
            raise line.damage(str(error)) from None
        if not line.is_ended and lengths.get(message.arbitration_id, len(message.data)) != len(message.data):
            raise line.damage("it has no end, and another length than the frames of its identifier before")
        if len(lengths) < _REMEMBERED:
            lengths[message.arbitration_id] = len(message.data)
        yield time_ns, message


def _candump_time(text: str) -> int:
    day, _, time = text.rpartition(" ")
    if not day:
        return nanoseconds(text)
    hour, minute, second = time.split(":")
    date = datetime.strptime(f"{day} {hour}:{minute}", "%Y-%m-%d %H:%M").replace(tzinfo=UTC)
    return int(date.timestamp()) * _NS + nanoseconds(second)


def _identified(text: str) -> tuple[int, bool, bool]:
    """Identifier, whether it is extended, and whether the frame is an error frame."""
    identifier, wide = int(text, 16), len(text) > 3
    is_error = wide and bool(identifier & _ERROR_FLAG)
    return identifier & 0x1FFFFFFF, wide and not is_error, is_error


def _logged(match: re.Match[str]) -> can.Message:
    identifier, is_extended, is_error = _identified(match["identifier"])
    flags = int(match["flags"] or "0", 16)
    data = bytes.fromhex((match["data"] or match["flexible"] or "").replace(".", ""))
    length = int(match["raw_length"] or match["remote"] or "0", 16) or len(data)
    return can.Message(
        timestamp=0.0, arbitration_id=identifier, is_error_frame=is_error, is_extended_id=is_extended,
        is_remote_frame=match["remote"] is not None, is_fd=match["flags"] is not None,
        bitrate_switch=bool(flags & 1), error_state_indicator=bool(flags & 2), dlc=length, data=data)


def _shown(match: re.Match[str]) -> can.Message:
    identifier, is_extended, is_error = _identified(match["shown"])
    data = bytes.fromhex(match["bytes"] or "")
    is_fd = len(match["length"]) == 2
    length = int(match["length"], 10 if is_fd else 16)
    if match["request"] is None and len(data) != (length if is_fd else min(length, 8)):
        raise ValueError(f"it has {len(data)} data bytes and states {length}")
    return can.Message(
        timestamp=0.0, arbitration_id=identifier, is_error_frame=is_error, is_extended_id=is_extended,
        is_remote_frame=match["request"] is not None, is_fd=is_fd, bitrate_switch=is_fd and match["brs"] == "B",
        error_state_indicator=is_fd and match["esi"] == "E", dlc=length, data=data)


# --- ASC --------------------------------------------------------------------------------------------------------------

_ASC_STAMP = re.compile(r"[+-]?\d+[.,]\d+")
_ASC_BASE = re.compile(r"base\s+(hex|dec)\b(?:.*\btimestamps\s+(absolute|relative))?", re.IGNORECASE)
_ASC_OTHER = re.compile(r"date\b|base\b|//|(no\s+)?internal\s+events|(begin|end)\s+trigger", re.IGNORECASE)
_ASC_FRAME = re.compile(r"\s(?:[TR]x|TxRq)\s+[dr]\s|\bCANFD\b|\b[dr]\s+\d\s+(?:[\dA-F]{2}\s+){2}", re.IGNORECASE)
_DIRECTIONS = ("rx", "tx", "txrq")
_ASC_OTHER_PROTOCOLS = ("j1939tp",)
"""Events of a channel with a direction and data that are no frames: what was put together of several."""
_FLEXIBLE_LENGTHS = (12, 16, 20, 24, 32, 48, 64)


class _Asc:
    """Meaning of the lines of an ASC file, from those before."""

    def __init__(self) -> None:
        self.radix, self.is_relative, self.is_open = 16, False, False
        self._time_ns = 0

    def take(self, line: Line, file: LogInput) -> tuple[int, can.Message] | None:
        """A frame; None for a line without one. ValueError: it should be one."""
        words = line.text.split()
        if not words or not _ASC_STAMP.fullmatch(words[0]):
            self._take_other(line)
            return None
        stamp_ns = nanoseconds(words[0])
        self._time_ns = stamp_ns + (self._time_ns if self.is_relative else 0)
        message = self._frame(line, words[1:], file)
        return None if message is None else (self._time_ns, message)

    def _take_other(self, line: Line) -> None:
        text = line.text.strip()
        if match := _ASC_BASE.match(text):
            self.radix = 10 if match[1].lower() == "dec" else 16
            self.is_relative = (match[2] or "").lower() == "relative"
        elif match := re.match(r"(begin|end)\s+triggerblock", text, re.IGNORECASE):
            self.is_open = match[1].lower() == "begin"
        elif not _ASC_OTHER.match(text) and (_ASC_FRAME.search(text) or re.search(r"[\0-\x08\x0e-\x1f]", text)
                                             or re.match(r"[+-]?\d+[.,]?\d*\S*\s+\d+\s", text)):
            raise ValueError(f"{text[:_SHOWN]!r} is no event of ASC")

    def _frame(self, line: Line, words: list[str], file: LogInput) -> can.Message | None:
        if len(words) >= 2 and words[0].upper() == "CANFD":
            return self._flexible(words[1:])
        if len(words) < 2 or not words[0].isdigit():
            if _ASC_FRAME.search(line.text):
                raise ValueError(f"{line.text.strip()[:_SHOWN]!r} is no event of ASC")
            return None  # of the controller, of another bus, or a system variable
        if words[1].lower().startswith("errorframe"):
            return can.Message(is_error_frame=True, is_extended_id=False)
        if words[1].lower() in _ASC_OTHER_PROTOCOLS:
            return None
        if not re.fullmatch(r"[\dA-F]+X?", words[1], re.IGNORECASE) or len(words) < 4:
            if len(words) > 3 and words[2].lower() in _DIRECTIONS and words[3].lower() in ("d", "r"):
                file.leave_out(f"line {line.number}: a frame with a name, {words[1][:_SHOWN]!r}, for its identifier")
            elif _ASC_FRAME.search(line.text) or len(words) == 2 or not line.is_ended:
                raise ValueError(f"{line.text.strip()[:_SHOWN]!r} is no event of ASC")
            return None
        return self._classic(line, words[1:])

    def _identifier(self, text: str) -> tuple[int, bool]:
        return int(text.lower().rstrip("x"), self.radix), text[-1] in "xX"

    def _data(self, words: list[str], length: int, is_ended: bool = True) -> bytes:
        data = [int(word, self.radix) for word in words[:length] if len(word) <= 3]
        if len(data) != length or max(data, default=0) > 255:
            raise ValueError(f"{length} data bytes are not there")
        if not is_ended and len(words) <= length and length and (self.radix == 10 or len(words[length - 1]) < 2):
            raise ValueError("its end is missing")
        return bytes(data)

    def _classic(self, line: Line, words: list[str]) -> can.Message:
        identifier, is_extended = self._identifier(words[0])
        kind = words[2].lower()
        if words[1].lower() not in _DIRECTIONS or kind not in ("d", "r"):
            raise ValueError(f"{line.text.strip()[:_SHOWN]!r} is no event of ASC")
        is_remote, dlc = kind == "r", 0
        if len(words) > 3 and (not is_remote or re.fullmatch(r"[\dA-F]{1,2}", words[3], re.IGNORECASE)):
            dlc = int(words[3], self.radix)
        elif not is_remote:
            raise ValueError("its length is missing")
        is_fd = not is_remote and dlc in _FLEXIBLE_LENGTHS and all(  # of older writers, which have no word for it
            re.fullmatch(r"[\dA-F]{1,3}", word, re.IGNORECASE) for word in (words[4 : 4 + dlc] + [""] * dlc)[:dlc])
        data = b"" if is_remote else self._data(words[4:], dlc if is_fd else min(dlc, 8), line.is_ended)
        return can.Message(arbitration_id=identifier, is_extended_id=is_extended, is_rx=words[1].lower() == "rx",
                           is_remote_frame=is_remote, is_fd=is_fd, dlc=dlc, data=data, channel=None)

    def _flexible(self, words: list[str]) -> can.Message:
        """CANFD channel direction identifier [name] BRS ESI code length data... duration length flags ..."""
        if words[1].lower() not in _DIRECTIONS:
            raise ValueError(f"direction {words[1][:_SHOWN]!r}")
        if words[2].lower().startswith("errorframe"):
            return can.Message(is_error_frame=True, is_extended_id=False)
        identifier, is_extended = self._identifier(words[2])
        at = 3 if words[3] in ("0", "1") else 4
        brs, esi, code = words[at] == "1", words[at + 1] == "1", int(words[at + 2], self.radix)
        length = int(words[at + 3])
        if words[at] not in ("0", "1") or words[at + 1] not in ("0", "1") or not 0 <= length <= 64 or code > 15:
            raise ValueError("its flags or its length are not of ASC")
        data = self._data(words[at + 4 :], length)
        flags = words[at + 4 + length :][2:3]
        is_fd = not flags or bool(int(flags[0], 16) & 0x1000) or length > 8  # some writers leave the flags at 0
        is_remote = not is_fd and bool(int(flags[0], 16) & 0x10)
        if is_fd and length > dlc2len(code):
            raise ValueError(f"its code {code} does not mean {length} data bytes")
        return can.Message(arbitration_id=identifier, is_extended_id=is_extended, is_rx=words[1].lower() == "rx",
                           is_fd=is_fd, bitrate_switch=is_fd and brs, error_state_indicator=is_fd and esi,
                           is_remote_frame=is_remote, dlc=length if is_fd else code, data=data)


def _read_asc(lines: Iterator[Line], file: LogInput) -> Frames:
    asc = _Asc()
    last = None
    for last in lines:
        if last.number == 1 and not (_ASC_OTHER.match(last.text.strip()) or _ASC_STAMP.match(last.text.strip())):
            raise last.damage("it does not begin with a date")
        try:
            timed = asc.take(last, file)
        except (ValueError, IndexError) as error:
            reason = f"{last.text.strip()[:_SHOWN]!r} ends early" if isinstance(error, IndexError) else str(error)
            raise last.damage(reason) from None
        if timed is not None:
            yield timed
    if asc.is_open and last is not None:
        raise Damage(f"truncated: after line {last.number} 'End TriggerBlock' is missing")


# --- TRC of PCAN ------------------------------------------------------------------------------------------------------

_TRC_COLUMNS = {"1.0": "NOILD", "1.1": "NOTILD", "1.2": "NOBTILD", "1.3": "NOBTIRLD"}
_TRC_FLEXIBLE = {"FD": (False, False), "FB": (True, False), "FE": (True, True), "BI": (False, True)}
_TRC_EPOCH_DAYS = 25569  # from the origin of its days, 1899-12-30, to 1970


class _Trc:
    """Columns and start of a TRC file: `;$FILEVERSION`, `;$STARTTIME`, `;$COLUMNS`."""

    def __init__(self) -> None:
        self.version, self.columns, self.start_ns = "1.0", list(_TRC_COLUMNS["1.0"]), 0

    def take_header(self, text: str) -> None:
        name, _, value = text.partition("=")
        name, value = name.strip().upper(), value.strip()
        if name == ";$FILEVERSION":
            self.version = value
            if value in _TRC_COLUMNS:
                self.columns = list(_TRC_COLUMNS[value])
            elif not value.startswith("2."):
                raise ValueError(f"version {value[:_SHOWN]!r} is not known of TRC")
        elif name == ";$STARTTIME":
            days = Decimal(value.replace(",", ".")) - _TRC_EPOCH_DAYS
            self.start_ns = round(nanoseconds(str(days * 86400)), -3)  # as its digits are
        elif name == ";$COLUMNS":
            self.columns = value.split(",")
            if not {"O", "T", "I"} <= set(self.columns) or not {"l", "L"} & set(self.columns):
                raise ValueError("columns of time, type, identifier or length are missing")

    def frame(self, text: str) -> tuple[int, can.Message] | None:
        """A frame; None for another event."""
        words = text.split()
        fields = dict(zip(self.columns, words, strict=False))
        kind = fields.get("T", "Rx")
        if kind in ("EV", "Event"):  # a remark of the user, without the other columns
            return None
        length = int(fields.get("l") or fields["L"])
        rest = words[self.columns.index("D"):] if "D" in self.columns else words[len(self.columns):]
        time_ns = self.start_ns + nanoseconds(fields["O"], 1000)
        if self.version.startswith("1."):
            return self._first(kind, fields["I"], length, rest, time_ns)
        if kind not in ("DT", "RR", "ER", *_TRC_FLEXIBLE):
            if kind not in ("ST", "EC"):
                raise ValueError(f"type {kind[:_SHOWN]!r} is not of TRC")
            return None
        if kind == "ER":
            return time_ns, can.Message(is_error_frame=True, is_extended_id=False)
        brs, esi = _TRC_FLEXIBLE.get(kind, (False, False))
        is_fd = kind in _TRC_FLEXIBLE
        size = (dlc2len(length) if is_fd else min(length, 8)) if "l" not in fields else length
        return time_ns, can.Message(
            arbitration_id=int(fields["I"], 16), is_extended_id=len(fields["I"]) > 4, is_remote_frame=kind == "RR",
            is_rx=fields.get("d", "Rx") == "Rx", is_fd=is_fd, bitrate_switch=brs, error_state_indicator=esi,
            dlc=size if is_fd else length, data=b"" if kind == "RR" else _hex_bytes(rest, size))

    @staticmethod
    def _first(kind: str, identifier: str, length: int, rest: list[str], time_ns: int
               ) -> tuple[int, can.Message] | None:
        """A frame of version 1."""
        if kind.lower() == "error":
            return time_ns, can.Message(is_error_frame=True, is_extended_id=False)
        if kind.lower() == "warng" or identifier == "FFFFFFFF":
            return None  # the state of the bus
        if kind not in ("Rx", "Tx"):
            raise ValueError(f"type {kind[:_SHOWN]!r} is not of TRC")
        is_remote = rest[:1] == ["RTR"]
        return time_ns, can.Message(
            arbitration_id=int(identifier, 16), is_extended_id=len(identifier) > 4, is_remote_frame=is_remote,
            is_rx=kind == "Rx", dlc=length, data=b"" if is_remote else _hex_bytes(rest, min(length, 8)))


def _hex_bytes(words: list[str], length: int) -> bytes:
    """Data bytes of two digits each; ValueError when there are fewer."""
    data = bytes.fromhex("".join(words[:length]))
    if len(data) != length or any(len(word) != 2 for word in words[:length]):
        raise ValueError(f"{length} data bytes are not there")
    return data


def _read_trc(lines: Iterator[Line], file: LogInput) -> Frames:
    trc = _Trc()
    for line in lines:
        text = line.text.strip()
        try:
            if not text.startswith(";"):
                timed = trc.frame(text)
            else:
                timed = None
                trc.take_header(text)
        except (ValueError, KeyError, InvalidOperation):
            raise line.damage(f"{text[:_SHOWN]!r} is no line of TRC {trc.version[:8]}") from None
        if timed is not None:
            yield timed


# --- BUSMASTER --------------------------------------------------------------------------------------------------------

_BUSMASTER = re.compile(r"(\d+):(\d+):(\d+):(\d+)\s+([TR]x)\s+\d+\s+"
                        r"(?:0x)?([\dA-F]+)\s+(s|x|sr|xr)\s+(\d+)(?:\s+(.*))?",
                        re.IGNORECASE | re.ASCII)


def _read_busmaster(lines: Iterator[Line], file: LogInput) -> Frames:
    radix, is_relative, last_ns, day_ns = 16, False, 0, 0
    for line in lines:
        text = line.text.strip()
        if text.startswith("***"):
            radix = {"***HEX***": 16, "***DEC***": 10}.get(text, radix)
            is_relative = is_relative or text == "***RELATIVE MODE***"
            continue
        match = _BUSMASTER.fullmatch(text)
        words = (match[9] or "").split() if match else []
        try:
            if match is None:
                raise ValueError(f"{text[:_SHOWN]!r} is no frame of BUSMASTER")
            hour, minute, second, fraction = (int(match[index]) for index in range(1, 5))
            time_ns = ((hour * 60 + minute) * 60 + second) * _NS + fraction * _NS // 10 ** len(match[4])
            length, is_remote = int(match[8]), match[7].lower().endswith("r")
            data = bytes(int(word, radix) for word in words[: min(length, 8)])
            if (not is_remote and len(data) != min(length, 8)) or (
                    not line.is_ended and words and (radix == 10 or len(words[-1]) < 2)):
                raise ValueError(f"{length} data bytes are not there")
            identifier = int(match[6], radix)
        except ValueError as error:
            raise line.damage(str(error)) from None
        if is_relative:
            time_ns += last_ns
        elif time_ns + day_ns < last_ns - 43_200 * _NS:  # past midnight
            day_ns += 86_400 * _NS
        last_ns = time_ns if is_relative else time_ns + day_ns
        yield last_ns, can.Message(
            arbitration_id=identifier, is_extended_id=match[7].lower().startswith("x"), is_rx=match[5].lower() == "rx",
            is_remote_frame=is_remote, dlc=length, data=b"" if is_remote else data)


# --- python-can's print ----------------------------------------------------------------------------------------------

_PRINTED = re.compile(
    r"Timestamp:\s+(?P<time>-?\d+\.\d+)\s+ID:\s+(?P<identifier>[\dA-F]+)\s+(?P<kind>[SX])\s+(?P<way>[RT]x)"
    r" (?P<error>[E ]) (?P<remote>[R ]) (?P<fd>[F ]) (?P<brs>BS|  ) (?P<esi>EI|  )\s+DL:\s+(?P<length>\d+)"
    r"(?:\s+(?P<data>[\dA-F]{2}(?: [\dA-F]{2})*)(?=\s|$))?(?:\s+'[^']*')?(?:\s+Channel: .*)?",
    re.ASCII | re.IGNORECASE)


def _read_printed(lines: Iterator[Line], file: LogInput) -> Frames:
    """Frames as `can_logger` prints them without a file, or writes them to one that ends with .txt."""
    for line in lines:
        text = line.text.strip()
        match = _PRINTED.fullmatch(text)
        if match is None:
            raise line.damage(f"{text[:_SHOWN]!r} is no frame as python-can prints it")
        is_remote, is_error, length = match["remote"] == "R", match["error"] == "E", int(match["length"])
        data = bytes.fromhex(match["data"] or "")
        if not is_remote and not is_error and len(data) != min(length, 64 if match["fd"] == "F" else 8):
            raise line.damage(f"it has {len(data)} data bytes and states {length}")
        yield nanoseconds(match["time"]), can.Message(
            arbitration_id=int(match["identifier"], 16), is_extended_id=match["kind"] == "X", is_error_frame=is_error,
            is_remote_frame=is_remote, is_fd=match["fd"] == "F", bitrate_switch=match["brs"] == "BS",
            error_state_indicator=match["esi"] == "EI", is_rx=match["way"] == "Rx", dlc=length, data=data)


# --- CSV --------------------------------------------------------------------------------------------------------------


def _read_csv(lines: Iterator[Line], file: LogInput) -> Frames:
    """Frames by SavvyCAN, with times in us; by CANedge's converter; and by python-can, with data in base 64."""
    header = next(lines)
    separator = ";" if header.text.count(";") > header.text.count(",") else ","
    names = [name.strip().lower() for name in header.text.split(separator)]
    read = next((reader for columns, reader in (
        (_SAVVY_COLUMNS, _savvy), (_CANEDGE_COLUMNS, _canedge), (_PYTHON_CAN_COLUMNS, _python_can))
        if columns <= set(names)), None)
    if read is None:
        raise header.damage("its columns are neither SavvyCAN's nor CANedge's nor python-can's")
    if read is _savvy:  # the head ends with D8, the rows of a flexible data rate do not
        names = [*names[: names.index("d1")], *(f"d{number}" for number in range(1, 65))]
    for line in lines:
        fields = [field.strip() for field in line.text.split(separator)]
        try:
            timed = read(dict(zip(names, fields, strict=False)), line.is_ended)
        except (ValueError, KeyError, binascii.Error):
            raise line.damage(f"{line.text.strip()[:_SHOWN]!r} is no frame of this CSV file") from None
        yield timed


_SAVVY_COLUMNS = {"time stamp", "id", "extended", "len", "d1"}
_CANEDGE_COLUMNS = {"timestampepoch", "id", "ide", "datalength", "databytes"}
_PYTHON_CAN_COLUMNS = {"timestamp", "arbitration_id", "extended", "remote", "error", "dlc", "data"}


def _savvy(row: dict[str, str], is_ended: bool) -> tuple[int, can.Message]:
    length = int(row["len"])
    if not 0 <= length <= 64:
        raise ValueError("length")
    data = _hex_bytes([row.get(f"d{number}") or "" for number in range(1, length + 1)], length)
    is_fd = length > 8
    return nanoseconds(row["time stamp"], 1_000_000), can.Message(
        arbitration_id=int(row["id"], 16), is_extended_id=_flag(row["extended"]), is_fd=is_fd,
        is_rx=row.get("dir", "Rx").lower() == "rx", dlc=length, data=data)


def _canedge(row: dict[str, str], is_ended: bool) -> tuple[int, can.Message]:
    length = int(row["datalength"])
    data = bytes.fromhex(row["databytes"])
    is_fd = _flag(row.get("edl") or "0") or length > 8
    is_remote = _flag(row.get("rtr") or "0")
    if not is_remote and len(data) != length:
        raise ValueError("length")
    return nanoseconds(row["timestampepoch"]), can.Message(
        arbitration_id=int(row["id"], 16), is_extended_id=_flag(row["ide"]), is_fd=is_fd, is_remote_frame=is_remote,
        bitrate_switch=is_fd and _flag(row.get("brs") or "0"), error_state_indicator=is_fd and _flag(
            row.get("esi") or "0"),
        is_rx=row.get("dir", "0") == "0", dlc=length, data=b"" if is_remote else data)


def _python_can(row: dict[str, str], is_ended: bool) -> tuple[int, can.Message]:
    data = base64.b64decode(row["data"], validate=True)
    is_remote, is_error = _flag(row["remote"]), _flag(row["error"])
    length = int(row["dlc"])
    if not is_remote and not is_error and len(data) != length:
        raise ValueError("length")
    return nanoseconds(row["timestamp"]), can.Message(
        arbitration_id=int(row["arbitration_id"], 16), is_extended_id=_flag(row["extended"]), is_remote_frame=is_remote,
        is_error_frame=is_error, is_fd=length > 8, dlc=length, data=data)


def _flag(text: str) -> bool:
    return {"1": True, "0": False, "true": True, "false": False}[text.lower()]


_Reader = Callable[[Iterator[Line], LogInput], Frames]
_SIGNS: tuple[tuple[re.Pattern[str], _Reader], ...] = (
    (re.compile(r"\*\*\*"), _read_busmaster),
    (re.compile(r"\s*;"), _read_trc),
    (re.compile(r"\s*\("), _read_candump),
    (re.compile(r"\s*(date|base)\s", re.IGNORECASE), _read_asc),
    (re.compile(r"\s*time ?stamp(epoch)?\s*[,;]", re.IGNORECASE), _read_csv),
    (re.compile(r"\s*Timestamp:\s"), _read_printed),
)
_OF_SUFFIX: dict[str, _Reader] = {".asc": _read_asc, ".log": _read_candump, ".txt": _read_candump, ".trc": _read_trc,
                                  ".csv": _read_csv}
