"""The generated C codec against cantools in Python: random frames of both databases, packed on one side and unpacked on
the other; and the texts of drive.dbc against the enumerations of the firmware."""

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

from salient.generate.codec import generate_codec, main, raw_range

ROOT = Path(__file__).resolve().parents[2]
DATABASES = {
    "drive": (ROOT / "firmware" / "comms" / "drive.dbc", True),
    "rig": (ROOT / "emulator" / "rig" / "rig.dbc", False),
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
        dbc, integer = DATABASES[name]
        self.name = name
        self.database = cantools.database.load_file(dbc)
        for file, text in generate_codec(dbc, integer).items():
            (folder / file).write_text(text)
        library = folder / f"lib{name}_codec.so"
        source = folder / f"{name}_codec.c"
        warnings = ["-Wall", "-Wextra", "-Werror"]
        subprocess.run(
            ["gcc", "-std=c11", "-O1", "-fPIC", "-shared", *warnings, "-o", library, source, "-lm"], check=True
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
        return getattr(self.library, f"{self.name}_{camel_to_snake_case(message.name)}_{action}")

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
    """A raw value of the signal's range, its ends more often than chance."""
    if signal.is_float:
        return ctypes.c_float(rng.uniform(-1e4, 1e4)).value
    low, high = raw_range(signal)
    return rng.choice((low, high, rng.randint(low, high), rng.randint(low, high)))


def random_frames(codec: Codec) -> list[tuple[Message, dict[str, int | float]]]:
    """FRAMES of every message: raw values of the signals that are there (a multiplexed frame has some of them)."""
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


def test_python_packs_and_c_unpacks(codec: Codec) -> None:
    for message, values in random_frames(codec):
        structure = codec.unpack(message, message.encode(values, scaling=False))
        for name, raw in values.items():
            assert getattr(structure, camel_to_snake_case(name)) == raw, f"{message.name}.{name}, seed {SEED}"


def test_c_packs_and_python_unpacks(codec: Codec) -> None:
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
                held = getattr(structure, camel_to_snake_case(signal.name))
                assert held == min(max(raw, low), high), f"{message.name}.{signal.name} from {raw}"


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
                # 2**-8: a double has 53 bits, the widest signal 48, so that much of an LSB is lost in the scale.
                assert abs(getattr(structure, field) - min(max(value / signal.scale, low), high)) <= 0.5 + 2**-8
            for value, held in ((math.inf, high), (-math.inf, low), (1e300, high), (-1e300, low), (math.nan, low)):
                setter(ctypes.byref(structure), ctypes.c_double(value))
                assert getattr(structure, field) == held, f"{message.name}.{signal.name} from {value}"


def test_identifiers_and_lengths(codec: Codec, tmp_path: Path) -> None:
    prefix = codec.name.upper()
    checks = []
    for message in codec.database.messages:
        name = f"{prefix}_{camel_to_snake_case(message.name).upper()}"
        checks += [
            f'static_assert({name}_FRAME_ID == {message.frame_id}u, "");',
            f'static_assert({name}_LENGTH == {message.length}u, "");',
            f'static_assert({name}_IS_EXTENDED == {int(message.is_extended_frame)}, "");',
        ]
    dbc, integer = DATABASES[codec.name]
    for file, text in generate_codec(dbc, integer).items():
        (tmp_path / file).write_text(text)
    compile_c(tmp_path, [f"{codec.name}_codec.h"], checks, [tmp_path])


def test_generated_text_depends_on_the_database_alone(codec: Codec, tmp_path: Path) -> None:
    dbc, integer = DATABASES[codec.name]
    copy = tmp_path / dbc.name
    copy.write_bytes(dbc.read_bytes())
    assert generate_codec(copy, integer) == generate_codec(dbc, integer)


def compile_c(folder: Path, headers: list[str], statements: list[str], include: list[Path]) -> None:
    """Compiles headers and statements, as a check that the compiler makes."""
    source = folder / "check.c"
    lines = ["#include <assert.h>", *(f'#include "{header}"' for header in headers), *statements]
    source.write_text("\n".join(lines) + "\n")
    folders = [flag for path in include for flag in ("-I", str(path))]
    run = subprocess.run(["gcc", "-std=c11", "-fsyntax-only", *folders, source], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize(
    ("signal", "prefix", "count"),
    [("fault", "FAULT", "FAULT_COUNT"), ("state", "DRIVE_STATE", None), ("controller", "DRIVE_CONTROLLER", None)],
)
def test_texts_of_the_dbc_are_the_enumerations_of_the_firmware(
    tmp_path: Path, signal: str, prefix: str, count: str | None
) -> None:
    database = cantools.database.load_file(DATABASES["drive"][0])
    found = [s.choices for m in database.messages for s in m.signals if s.name == signal]
    texts = {number: str(text) for number, text in found[0].items()}
    assert all({number: str(text) for number, text in choices.items()} == texts for choices in found)
    checks = [f'static_assert({prefix}_{text.upper()} == {number}, "");' for number, text in texts.items()]
    if count:
        checks.append(f'static_assert({count} == {len(texts)}, "a number without a text");')
    headers = ["drive/fault.h", "drive/state_machine.h", "drive/control.h"]
    for file, text in generate_codec(*DATABASES["drive"]).items():
        (tmp_path / file).write_text(text)
    compile_c(tmp_path, headers, checks, [ROOT / "firmware", ROOT / "hal", tmp_path])


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
        ('VERSION ""\nBU_: A\nBO_ 1 X: 1 A\n SG_ a : 0|8@1+ (1,0) [300|400] "" A\n', "signal a: its range"),
    ],
)
def test_a_bad_database_gives_one_line_and_exit_code_2(
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
