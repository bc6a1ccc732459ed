"""Values of the command line: numbers below zero, times, and options that exclude each other."""

from __future__ import annotations

import pytest

from salient.cli import make_parser


@pytest.mark.parametrize(("line", "name", "value"), [
    ("command speed -1e3", "value", -1000.0), ("command torque -.5", "value", -0.5),
    ("command load -5e-1", "value", -0.5), ("sim --initial-angle-deg -5E0", "initial_angle_deg", -5.0),
    ("sweep start_600 --load-Nm -1,2", "load_Nm", [-1.0, 2.0]),
])
def test_number_below_zero_is_a_value_and_no_option(line: str, name: str, value: object) -> None:
    assert getattr(make_parser().parse_args(line.split()), name) == value


@pytest.mark.parametrize(("line", "message"), [
    ("command speed -inf", "RPM -inf: must be a number"),
    ("command load -nan", "NM -nan: must be a number"),
    ("sim --initial-angle-deg -1e400", "--initial-angle-deg -1e400: must be a number from -360 to 360"),
    ("sim --initial-angle-deg 1e", "--initial-angle-deg 1e: must be a number from -360 to 360"),
    ("sim --initial-angle-deg 1_0", "--initial-angle-deg 1_0: must be a number from -360 to 360"),
    ("monitor --every-s 1e300", "--every-s 1e300: must be a number above 0 and at most 1000000000"),
    ("log --duration-s -1e300", "--duration-s -1e300: must be a number above 0 and at most 1000000000"),
    ("monitor --signals", "--signals: requires a value"),
    ("monitor --replay a.log --can auto", "--can: not allowed with --replay"),
    ("sim -pace free", "unrecognised argument -pace free; the nearest of 23 are --pace, "),
])
def test_message_says_what_is_allowed(capsys: pytest.CaptureFixture[str], line: str, message: str) -> None:
    with pytest.raises(SystemExit):
        make_parser().parse_args(line.split())
    errors = capsys.readouterr().err
    assert errors.startswith(f"salient: {message}") and errors.count("\n") == 1, errors
