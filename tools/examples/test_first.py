"""A first test of a drive: the fixture `bench` is a drive and its test bench on a bus of their own.

    python -m pytest test_first.py
"""

from salient.suite import Bench


def test_load_step_is_compensated(bench: Bench) -> None:
    bench.drive.speed_reference_rpm = 150
    bench.at(0.13).load_torque_Nm = 8
    bench.run_for(0.3)
    speed = bench.truth["speed_rpm"]
    assert 149.2 < speed.last < 150.8
    assert 146.0 < speed.between(0.13, 0.3).value.min() < 149.0  # the dip
