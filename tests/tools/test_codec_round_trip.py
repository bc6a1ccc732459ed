"""The generated C codec against cantools in Python: random frames of both databases, packed on one side and unpacked on
the other; enumerations, telemetry and hash of drive.dbc."""

import ctypes
import math
import random
import subprocess
from pathlib import Path

import cantools
import pytest
from cantools.database.can.c_source import camel_to_snake_case
from cantools.database.can.message import Message
from cantools.database.can.signal import Signal

from salient.dbc import database_hash, phases_above
from salient.generate.codec import generate_codec, main
from salient.generate.error import CodecError
from salient.generate.ranges import raw_range
from salient.generate.telemetry import is_bit_field, message_c_name, short_name
from salient.machine.parameter_table import read_table

ROOT = Path(__file__).resolve().parents[2]
DATABASES = {
    "drive": (ROOT / "firmware" / "comms" / "drive.dbc", True, "DRIVE"),
    "rig": (ROOT / "emulator" / "rig" / "rig.dbc", False, None),
}
SEED = 20130328
FRAMES = 300


def field_type(signal: Signal) -> type:
    if signal.is_float:
        return ctypes.c_float if signal.length == 32 else ctypes.c_double
    bits = next(width for width in (8, 16, 32, 64) if signal.length <= width)
    return getattr(ctypes, f"c_{'' if signal.is_signed else 'u'}int{bits}")


class Codec:
    """A database in both languages: `database` in Python, `library` compiled from the generated C."""

    def __init__(self, name: str, folder: Path) -> None:
        self.name = name
        self.database = cantools.database.load_file(DATABASES[name][0])
        for file, text in generate_codec(*DATABASES[name]).items():
            (folder / file).write_text(text)
        library = folder / f"lib{name}_codec.so"
        sources = sorted(folder.glob("*.c"))
        warnings = ["-Wall", "-Wextra", "-Werror"]
        subprocess.run(
            ["gcc", "-std=c11", "-O1", "-fPIC", "-shared", *warnings, "-o", library, *sources, "-lm"], check=True
        )
        self.library = ctypes.CDLL(str(library))
        self.structures = {
            message.name: type(
                message.name,
                (ctypes.Structure,),
                {"_fields_": [(camel_to_snake_case(s.name), field_type(s)) for s in message.signals]},
            )
            for message in self.database.messages
        }

    def function(self, message: Message, action: str) -> ctypes._CFuncPtr:
        return getattr(self.library, f"{message_c_name(message, self.name)}_{action}")

    def unpack(self, message: Message, data: bytes) -> ctypes.Structure:
        structure = self.structures[message.name]()
        size = ctypes.c_size_t(len(data))
        assert self.function(message, "unpack")(ctypes.byref(structure), data, size) == 0
        return structure

    def pack(self, message: Message, structure: ctypes.Structure) -> bytes:
        data = ctypes.create_string_buffer(b"\xa5" * 8, 8)
        assert self.function(message, "pack")(data, ctypes.byref(structure), ctypes.c_size_t(8)) == message.length
        return data.raw[: message.length]

    def set_raw(self, message: Message, structure: ctypes.Structure, signal: Signal, raw: int | float) -> None:
        field = camel_to_snake_case(signal.name)
        if signal.is_float:
            setattr(structure, field, raw)
        else:
            self.function(message, f"set_{field}")(ctypes.byref(structure), ctypes.c_int64(raw))


@pytest.fixture(scope="module", params=list(DATABASES))
def codec(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Codec:
    return Codec(request.param, tmp_path_factory.mktemp(request.param))


def random_raw(signal: Signal, rng: random.Random) -> int | float:
    """A raw value of the signal's range, with its ends overrepresented."""
    if signal.is_float:
        return ctypes.c_float(rng.uniform(-1e4, 1e4)).value
    low, high = raw_range(signal)
    return rng.choice((low, high, rng.randint(low, high), rng.randint(low, high)))


def random_frames(codec: Codec) -> list[tuple[Message, dict[str, int | float]]]:
    """FRAMES frames of every message: raw values of the signals present (a multiplexed frame has a subset)."""
    rng = random.Random(SEED)
    frames = []
    for message in codec.database.messages:
        selector = next((s for s in message.signals if s.is_multiplexer), None)
        choices = sorted({i for s in message.signals for i in s.multiplexer_ids or ()})
        for _ in range(FRAMES):
            chosen = rng.choice(choices) if selector else None
            present = [s for s in message.signals if not s.multiplexer_ids or chosen in s.multiplexer_ids]
            frames.append((message, {s.name: chosen if s is selector else random_raw(s, rng) for s in present}))
    return frames


@pytest.mark.in_turns
def test_c_unpacks_frames_packed_by_python(codec: Codec) -> None:
    for message, values in random_frames(codec):
        structure = codec.unpack(message, message.encode(values, scaling=False))
        for name, raw in values.items():
            assert getattr(structure, camel_to_snake_case(name)) == raw, f"{message.name}.{name}, seed {SEED}"


@pytest.mark.in_turns
def test_python_unpacks_frames_packed_by_c(codec: Codec) -> None:
    for message, values in random_frames(codec):
        structure = codec.structures[message.name]()
        for name, raw in values.items():
            codec.set_raw(message, structure, message.get_signal_by_name(name), raw)
        data = codec.pack(message, structure)
        decoded = message.decode(data, scaling=False, decode_choices=False)
        assert decoded == values, f"{message.name}, seed {SEED}"
        assert data == message.encode(values, scaling=False), f"{message.name}, seed {SEED}"


def test_setters_saturate(codec: Codec) -> None:
    rng = random.Random(SEED)
    for message in codec.database.messages:
        structure = codec.structures[message.name]()
        for signal in message.signals:
            if signal.is_float:
                continue
            low, high = raw_range(signal)
            wide = [rng.randint(-(2**63), 2**63 - 1) for _ in range(20)]
            for raw in (-(2**63), low - 1, low, high, high + 1, 2**63 - 1, *wide):
                codec.set_raw(message, structure, signal, raw)
                value = getattr(structure, camel_to_snake_case(signal.name))
                assert value == min(max(raw, low), high), f"{message.name}.{signal.name} from {raw}"


def test_setters_of_physical_values_round_and_saturate(tmp_path: Path) -> None:
    codec = Codec("rig", tmp_path)
    rng = random.Random(SEED)
    for message in codec.database.messages:
        structure = codec.structures[message.name]()
        for signal in message.signals:
            if signal.is_float:
                continue
            low, high = raw_range(signal)
            field = camel_to_snake_case(signal.name)
            setter = codec.function(message, f"set_physical_{field}")
            samples = [(rng.randint(low, high) + rng.uniform(-0.49, 0.49)) * signal.scale for _ in range(50)]
            for value in samples:
                setter(ctypes.byref(structure), ctypes.c_double(value))
                # 2**-8: a double has 53 bits, the widest signal 48, so that part of an LSB is lost in the scale.
                assert abs(getattr(structure, field) - min(max(value / signal.scale, low), high)) <= 0.5 + 2**-8
            for value, end in ((math.inf, high), (-math.inf, low), (1e300, high), (-1e300, low), (math.nan, low)):
                setter(ctypes.byref(structure), ctypes.c_double(value))
                assert getattr(structure, field) == end, f"{message.name}.{signal.name} from {value}"


def test_identifiers_and_lengths_are_those_of_the_database(codec: Codec, tmp_path: Path) -> None:
    checks = []
    for message in codec.database.messages:
        name = message_c_name(message, codec.name).upper()
        checks += [
            f'static_assert({name}_FRAME_ID == {message.frame_id}u, "");',
            f'static_assert({name}_LENGTH == {message.length}u, "");',
            f'static_assert({name}_IS_EXTENDED == {int(message.is_extended_frame)}, "");',
        ]
    checks.append(f'static_assert({codec.name.upper()}_DBC_HASH == {database_hash(codec.database)}u, "");')
    for file, text in generate_codec(*DATABASES[codec.name]).items():
        (tmp_path / file).write_text(text)
    compile_c(tmp_path, [f"{codec.name}_codec.h"], checks, [tmp_path])


def test_generated_code_depends_on_the_database_alone(codec: Codec, tmp_path: Path) -> None:
    dbc, *options = DATABASES[codec.name]
    copy = tmp_path / dbc.name
    copy.write_bytes(dbc.read_bytes())
    assert generate_codec(copy, *options) == generate_codec(dbc, *options)


def test_names_do_not_repeat_the_prefix(codec: Codec) -> None:
    twice = f"{codec.name}_{codec.name}_"
    assert not any(twice in text.lower() for text in generate_codec(*DATABASES[codec.name]).values())


def compile_c(folder: Path, headers: list[str], statements: list[str], include: list[Path]) -> None:
    """Compiles headers and statements, for checks by the compiler."""
    source = folder / "check.c"
    lines = ["#include <assert.h>", *(f'#include "{header}"' for header in headers), *statements]
    source.write_text("\n".join(lines) + "\n")
    folders = [flag for path in include for flag in ("-I", str(path))]
    run = subprocess.run(["gcc", "-std=c11", "-fsyntax-only", *folders, source], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize(
    ("signal", "type_name", "prefix"),
    [
        ("fault", "fault_t", "FAULT"),
        ("state", "drive_state_t", "DRIVE_STATE"),
        ("controller", "drive_controller_t", "DRIVE_CONTROLLER"),
        ("request", "command_request_t", "COMMAND"),
        ("operation", "parameter_operation_t", "PARAMETER_OPERATION"),
        ("status", "parameter_status_t", "PARAMETER_STATUS"),
    ],
)
def test_value_tables_of_the_dbc_are_the_enumerations_of_the_firmware(
    tmp_path: Path, signal: str, type_name: str, prefix: str
) -> None:
    database = cantools.database.load_file(DATABASES["drive"][0])
    found = [s.choices for m in database.messages for s in m.signals if s.name == signal]
    texts = {number: str(text) for number, text in found[0].items()}
    assert all({number: str(text) for number, text in choices.items()} == texts for choices in found)
    checks = [f'static_assert({prefix}_{text.upper()} == {number}, "");' for number, text in texts.items()]
    checks.append(f'static_assert({prefix}_COUNT == {len(texts)}, "a number without a text");')
    checks.append(f"extern {type_name} value;")
    for file, text in generate_codec(*DATABASES["drive"]).items():
        (tmp_path / file).write_text(text)
    compile_c(tmp_path, ["drive_enumerations.h"], checks, [tmp_path])


def test_value_tables_of_one_enumeration_must_be_equal(tmp_path: Path) -> None:
    dbc = tmp_path / "drive.dbc"
    text = DATABASES["drive"][0].read_text(encoding="cp1252")
    dbc.write_text(text.replace('VAL_ 1793 state 0 "initialise"', 'VAL_ 1793 state 0 "start"'), encoding="cp1252")
    with pytest.raises(CodecError, match="drive.dbc: signal state: its value table differs"):
        generate_codec(dbc, True, "DRIVE")


def test_cyclic_messages_have_little_endian_integers_of_at_most_32_bits(tmp_path: Path) -> None:
    dbc = tmp_path / "drive.dbc"
    text = DATABASES["drive"][0].read_text(encoding="cp1252")
    for name, layout, changed in (("cycle", "56|8@1+", "63|8@0+"), ("dbc_hash", "32|32@1+", "24|33@1+")):
        assert f" SG_ {name} : {layout}" in text
        dbc.write_text(text.replace(f" SG_ {name} : {layout}", f" SG_ {name} : {changed}"), encoding="cp1252")
        with pytest.raises(CodecError, match=f"drive.dbc: signal {name}: cyclic messages have little-endian integers"):
            generate_codec(dbc, True, "DRIVE")


# --- the cyclic messages of the drive ---------------------------------------------------------------------------------


class Telemetry(Codec):
    """`structure`: drive_telemetry_t in Python, from the DBC."""

    def __init__(self, folder: Path) -> None:
        super().__init__("drive", folder)
        groups = list(self.database.dbc.attribute_definitions["TelemetryGroup"].choices)
        self.messages = [m for m in self.database.messages if m.cycle_time and "DRIVE" in m.senders]
        self.messages.sort(key=lambda m: (self.attribute(m, "TelemetryGroup"), m.frame_id))
        assert len(groups) > max(self.attribute(m, "TelemetryGroup") for m in self.messages)
        fields = []
        for message in self.messages:
            members = [
                (camel_to_snake_case(s.name), ctypes.c_int32 if s.is_signed else ctypes.c_uint32)
                for s in message.signals
            ]
            inner = type(message.name, (ctypes.Structure,), {"_fields_": members})
            fields.append((short_name(message, "drive"), ctypes.c_uint64 if is_bit_field(message) else inner))
        self.structure = type("drive_telemetry_t", (ctypes.Structure,), {"_fields_": fields})

    @staticmethod
    def attribute(message: Message, name: str) -> int:
        attribute = message.dbc.attributes.get(name)
        return 0 if attribute is None else int(attribute.value)

    def pack_telemetry(self, message: Message, telemetry: ctypes.Structure) -> bytes:
        data = ctypes.create_string_buffer(b"\xa5" * 8, 8)
        index = [other.name for other in self.messages].index(message.name)
        self.library.drive_telemetry_pack(ctypes.c_uint(index), ctypes.byref(telemetry), data)
        return data.raw[: message.length]


@pytest.fixture(scope="module")
def telemetry(tmp_path_factory: pytest.TempPathFactory) -> Telemetry:
    return Telemetry(tmp_path_factory.mktemp("telemetry"))


@pytest.mark.in_turns
def test_telemetry_is_packed_with_saturation(telemetry: Telemetry) -> None:
    rng = random.Random(SEED)
    for message in telemetry.messages:
        for _ in range(FRAMES):
            values = telemetry.structure()
            expected = {}
            if is_bit_field(message):
                bits = rng.getrandbits(64)
                setattr(values, short_name(message, "drive"), bits)
                expected = {s.name: bits >> s.start & 1 for s in message.signals}
            else:
                member = getattr(values, short_name(message, "drive"))
                for signal in message.signals:
                    low, high = raw_range(signal)
                    ends = (-(2**31), 2**31 - 1) if signal.is_signed else (0, 2**32 - 1)
                    raw = rng.choice((*ends, rng.randint(*ends), rng.randint(low, high)))
                    setattr(member, camel_to_snake_case(signal.name), raw)
                    expected[signal.name] = min(max(raw, low), high)
            data = telemetry.pack_telemetry(message, values)
            assert data == message.encode(expected, scaling=False), f"{message.name}, seed {SEED}"


def test_schedule_is_that_of_the_dbc(telemetry: Telemetry) -> None:
    class Row(ctypes.Structure):
        _fields_ = [
            ("identifier", ctypes.c_uint32), ("length", ctypes.c_uint8),
            ("group", ctypes.c_uint8), ("rate", ctypes.c_uint8), ("if_active", ctypes.c_bool),
            ("phases_above", ctypes.c_uint8),
            ("period", ctypes.c_uint16), ("delay", ctypes.c_uint16),
        ]  # fmt: skip

    table = (Row * len(telemetry.messages)).in_dll(telemetry.library, "drive_telemetry_messages")
    for row, message in zip(table, telemetry.messages, strict=True):
        assert (row.identifier, row.length) == (message.frame_id, message.length)
        assert row.group == telemetry.attribute(message, "TelemetryGroup")
        assert row.rate == telemetry.attribute(message, "TelemetryRate")
        assert row.phases_above == phases_above(message)
        assert row.if_active == (message.send_type == "cyclicIfActive")
        assert (row.period, row.delay) == (message.cycle_time, telemetry.attribute(message, "GenMsgStartDelayTime"))
    periods = {m.name: (telemetry.attribute(m, "TelemetryRate"), m.cycle_time) for m in telemetry.messages}
    parameters = {row.name: row.default for row in read_table()}
    fast, slow = (1, parameters["telemetry_period_ms"]), (2, parameters["telemetry_slow_period_ms"])
    assert [name for name, period in periods.items() if period == fast] == [
        "DRIVE_STATUS", "DRIVE_MOTION", "DRIVE_TORQUE", "DRIVE_CURRENTS", "DRIVE_PHASES_E_F", "DRIVE_POSITION",
    ]  # fmt: skip
    assert {name for name, period in periods.items() if period == slow} == {"DRIVE_BP_PID", "DRIVE_ADAPTATION"}
    assert {rate for rate, _ in periods.values()} == {0, 1, 2}


def test_every_fault_has_its_bit_in_the_fault_mask(telemetry: Telemetry) -> None:
    faults = telemetry.database.get_message_by_name("DRIVE_STATUS").get_signal_by_name("fault").choices
    mask = telemetry.database.get_message_by_name("DRIVE_FAULT_MASK")
    assert {s.start: s.name for s in mask.signals} == {n: str(name) for n, name in faults.items() if n}


def test_every_message_and_signal_of_drive_dbc_has_a_comment(telemetry: Telemetry) -> None:
    for message in telemetry.database.messages:
        assert message.comment, message.name
        for signal in message.signals:
            assert signal.comment, f"{message.name}.{signal.name}"
            unit = signal.name.rpartition("_")[2]
            assert signal.unit or unit not in ("rpm", "Nm", "A", "V", "us", "deg", "s", "hz"), signal.name
            assert signal.choices or signal.length > 1, f"{message.name}.{signal.name}: names of its values"


@pytest.mark.parametrize(
    ("old", "new", "equal"),
    [
        ('CM_ BO_ 385 "Speed and rotor position.";', 'CM_ BO_ 385 "Motion.";', True),
        ('BA_ "GenMsgCycleTime" BO_ 388 10;', 'BA_ "GenMsgCycleTime" BO_ 388 20;', True),
        ('SG_ duty : 48|16@1- (0.000030517578125,0)', 'SG_ duty : 48|16@1- (0.00006103515625,0)', False),
        ('SG_ state : 0|8@1+', 'SG_ state : 40|8@1+', False),
        ('"clock";\nVAL_ 1793 controller', '"overrun";\nVAL_ 1793 controller', False),
        ('SG_ duty :', 'SG_ output :', False),
    ],
)  # fmt: skip
def test_hash_changes_with_the_meaning_of_a_frame(old: str, new: str, equal: bool) -> None:
    text = DATABASES["drive"][0].read_text(encoding="cp1252")
    assert old in text
    hashes = [
        database_hash(cantools.database.load_string(t, database_format="dbc", strict=False))
        for t in (text, text.replace(old, new))
    ]
    assert (hashes[0] == hashes[1]) is equal


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (None, "No such file"),
        ('VERSION ""\n', "describes no CAN messages"),
        ('VERSION ""\nBO_ 1 X: 8 A\n SG_ a : 0|8@1+', "Invalid syntax"),
        (
            'VERSION ""\nBU_: A\nBO_ 1 X: 1 A\n SG_ a : 0|8@1+ (1,0) [0|0] "" A\n SG_ b : 4|4@1+ (1,0) [0|0] "" A\n',
            "overlap",
        ),
        ('VERSION ""\nBU_: A\nBO_ 1 X: 1 A\n SG_ a : 0|8@1+ (1,0) [300|400] "" A\n', "signal a: no value of its range"),
    ],
)
def test_invalid_database_is_one_line_and_exit_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str | None, complaint: str
) -> None:
    dbc = tmp_path / "bad.dbc"
    if text is not None:
        dbc.write_text(text)
    assert main([str(dbc), str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert str(dbc) in error
    assert complaint in error
    assert not (tmp_path / "out").exists()
