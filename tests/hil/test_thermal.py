"""Heat of windings and switches: derating before the trip, the trip, and no effect on a healthy drive. [SR-16]"""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from salient.bench.bench import Bench
from salient.machine.drive_data import derive
from salient.machine.file import load_machine
from salient.paths import ROOT

THERMAL = "DRIVE_THERMAL."


def load_percent(bench: Bench, part: str = "winding") -> float:
    return bench.telemetry[f"{THERMAL}{part}_load"].last


@pytest.mark.in_turns
@pytest.mark.parametrize("machine", ["saturating", "finite_element", "linear_cosine", "linear_trapezoid"])
@pytest.mark.parametrize("controller", ["traditional", "paper", "salient"])
def test_rated_torque_below_base_speed_is_continuous(make_bench, machine, controller):
    """In the steady state, which a time constant of a second reaches to a part of exp(-2.5)."""
    bench = make_bench(machine=machine, controller=controller)
    data = derive(load_machine(ROOT / f"tools/machines/{machine}.toml"))
    bench.drive.parameters["winding_time_constant_s"] = 1
    bench.rig.held_speed_rpm = 0.9 * data.speed_base_rpm
    bench.run_for(0.2)
    bench.drive.torque_reference_Nm = data.torque_rated_Nm
    bench.run_for(2.5)
    steady_percent = load_percent(bench) / (1 - math.exp(-2.5))
    assert 30 < steady_percent < 85  # the narrow windows of finite_element: 32 to 35
    assert 5 < load_percent(bench, "switch") < 50
    assert bench.telemetry[f"{THERMAL}torque_limit_Nm"].last == pytest.approx(data.torque_peak_Nm, rel=1e-3)
    assert bench.drive.state == "run"


@pytest.mark.in_turns
@pytest.mark.parametrize("controller", ["traditional", "paper", "salient"])
@pytest.mark.parametrize("hot", ["winding", "switch"])
def test_torque_falls_before_the_trip_and_settles_between_90_and_100_percent(make_bench, controller, hot):
    """A held shaft: one or two phases carry the current of the rated torque all the time, the square of which is above
    1.2 times the square of the continuous current."""
    bench = make_bench(controller=controller)
    bench.drive.parameters["winding_time_constant_s"] = 1
    cool = {"winding": "switch", "switch": "winding"}[hot]
    bench.drive.parameters[f"{cool}_current_A"] = 79
    bench.drive.parameters[f"{hot}_current_A"] = 25
    bench.rig.held_speed_rpm = 0
    bench.run_for(0.01)
    begin_s = bench.time_s
    bench.drive.torque_reference_Nm = 16
    bench.run_for(4)
    limit = bench.telemetry[f"{THERMAL}torque_limit_Nm"]
    load = bench.telemetry[f"{THERMAL}{hot}_load"]
    reference = bench.telemetry["torque_reference_Nm"]
    assert bench.drive.state == "run"
    assert max(load.value) < 100
    assert 90 < load.last < 100
    assert 0.5 < limit.last < 15
    assert reference.last <= limit.last + 0.02
    assert reference.last > 0.8 * limit.last
    rated = [value for time_s, value in zip(reference.time_s, reference.value, strict=True)
             if begin_s + 0.1 < time_s < begin_s + 0.2]
    assert min(rated) == pytest.approx(16, abs=0.2), "none of it while the load is low"
    later = list(limit.value)[len(limit.value) // 2 :]
    assert max(abs(b - a) for a, b in pairwise(later)) < 1.0, "smooth"


@pytest.mark.parametrize("controller", ["traditional", "salient"])
@pytest.mark.parametrize("speed_rpm", [0, 300])
def test_in_speed_mode_a_hot_drive_gives_way_to_its_load_and_comes_back_without_it(make_bench, controller, speed_rpm):
    bench = make_bench(controller=controller)
    bench.drive.parameters["winding_time_constant_s"] = 1
    bench.drive.parameters["winding_current_A"] = 15
    bench.drive.parameters["switch_current_A"] = 79
    bench.drive.speed_reference_rpm = speed_rpm
    bench.run_for(0.2)
    bench.drive.speed_reference_rpm = speed_rpm
    bench.load_torque_Nm = 12
    bench.run_for(0.05)
    assert bench.telemetry["torque_reference_Nm"].last > 8
    assert bench.truth["speed_rpm"].last == pytest.approx(speed_rpm, abs=8)
    while bench.truth["speed_rpm"].last > speed_rpm - 20 and bench.time_s < 3:
        bench.run_for(0.005)
    assert bench.drive.state == "run"
    assert 5 < bench.telemetry["torque_reference_Nm"].last < 12.2
    bench.load_torque_Nm = 0
    bench.run_for(0.8)
    assert 80 < max(bench.telemetry[f"{THERMAL}winding_load"].value) < 100
    assert bench.drive.state == "run"
    assert bench.truth["speed_rpm"].last == pytest.approx(speed_rpm, abs=6)


def heat(bench: Bench, current_A: float, time_constant_s: float) -> tuple[list[float], list[float]]:
    """Times and loads in percent of the hottest phase by a first-order model of the true currents."""
    times: list[float] = []
    hottest: list[float] = []
    for phase in "abc":
        current = bench.truth[f"RIG_TRUTH_CURRENTS.current_{phase}_A"]
        load, before_s, loads = 0.0, 0.0, []
        for time_s, value in zip(current.time_s, current.value, strict=True):
            square = (value / current_A) ** 2
            load = square + (load - square) * math.exp(-(time_s - before_s) / time_constant_s)
            before_s = time_s
            loads.append(100 * load)
        times = list(current.time_s)
        hottest = [max(pair) for pair in zip(hottest, loads, strict=True)] if hottest else loads
    return times, hottest


@pytest.mark.parametrize("part", ["winding", "switch"])
def test_a_current_that_derating_does_not_reduce_trips_at_the_time_of_the_model(make_bench, part):
    """A torque reserve keeps opposing currents without torque. The fault cannot be cleared before the load has fallen
    below 90 %."""
    bench = make_bench(controller="salient")
    bench.drive.parameters["torque_reserve_Nm"] = 14
    bench.drive.parameters["winding_time_constant_s"] = 1
    bench.drive.parameters["winding_current_A"] = 12 if part == "winding" else 79
    bench.drive.parameters["switch_current_A"] = 12 if part == "switch" else 79
    bench.rig.held_speed_rpm = 0
    bench.rig.truth_period_us = 250
    bench.run_for(0.01)
    bench.drive.torque_reference_Nm = 2
    bench.run_for(3)
    assert bench.drive.state == "fault"
    assert bench.drive.fault == {"winding": "winding_overload", "switch": "inverter_overload"}[part]
    assert min(bench.telemetry[f"{THERMAL}torque_limit_Nm"].value) < 10  # sent every 100 ms
    tripped_s = bench.telemetry["DRIVE_FAULT_CAUSE.time_us"].last * 1e-6
    times, loads = heat(bench, 12, 1)
    assert tripped_s > 0.1
    at_trip = loads[next(index for index, time_s in enumerate(times) if time_s >= tripped_s)]
    assert at_trip == pytest.approx(100, abs=2)

    begin_s = bench.time_s
    assert load_percent(bench, part) < 90, "gone by now"
    bench.drive.clear_fault()
    bench.run_for(0.01)
    assert bench.drive.state == "ready"
    assert bench.time_s - begin_s < 0.02


def test_an_overload_is_not_cleared_before_its_load_is_below_90_percent(make_bench):
    bench = make_bench(controller="salient")
    bench.drive.parameters["torque_reserve_Nm"] = 14
    bench.drive.parameters["winding_time_constant_s"] = 4
    bench.drive.parameters["winding_current_A"] = 8
    bench.drive.parameters["switch_current_A"] = 79
    bench.rig.held_speed_rpm = 0
    bench.run_for(0.01)
    bench.drive.torque_reference_Nm = 2
    while bench.drive.state != "fault" and bench.time_s < 5:
        bench.run_for(0.01)
    bench.drive.off()
    bench.run_for(0.2)  # 4 s ln(1 / 0.9) is 0.42 s
    assert 92 < load_percent(bench) < 97
    bench.drive.clear_fault()
    bench.run_for(0.01)
    assert (bench.drive.state, bench.drive.fault) == ("fault", "winding_overload")
    bench.drive.off()
    bench.run_for(0.25)
    bench.drive.clear_fault()
    bench.run_for(0.01)
    assert bench.drive.state == "ready"
