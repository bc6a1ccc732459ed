"""The parameter table: the reference page is generated from it, and every row is complete."""

from __future__ import annotations

from salient.generate.parameters import PAGE, page, read_table


def test_reference_page_is_generated_from_the_table():
    assert PAGE.read_text(encoding="utf-8") == page(), "run python -m salient.generate.parameters"


def test_every_parameter_has_a_description():
    rows = read_table()
    assert len({row.text for row in rows}) == len(rows) == 73
    for row in rows:
        assert row.text.endswith("."), row.name
        assert row.constant == row.name.upper()
        assert row.minimum <= row.default <= row.maximum, row.name


def test_values_are_written_with_the_digits_of_their_format():
    by_name = {row.name: row for row in read_table()}
    torque, gain = by_name["torque_max_Nm"], by_name["bp_kp_max"]
    assert torque.physical(torque.default) == "19.1"
    assert gain.physical(gain.maximum) == "1.99997"
    assert by_name["bp_seed"].physical(2**31 - 1) == "2147483647"
