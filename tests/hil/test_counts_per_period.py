"""Torque ripple after a load step where the rotor turns by nearly a ratio of encoder counts in a control period: the
rounding to counts is then slow, and is no load. `tools/salient compare speeds every_speed` covers more speeds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
import pytest

from salient.bench.bench import Bench
from salient.experiments.metrics import torque_metrics

LOAD_NM = 8.0
LOADED_S = 0.2
STEADY_RAD_S = 250.0
WINDOWS_S = tuple((LOADED_S + after_s, LOADED_S + after_s + 0.1) for after_s in (0.02, 0.12, 0.22, 0.32))


@pytest.fixture
def after_step(make_bench: Callable[..., Bench], tmp_path):
    """Ripple in the windows after a step to 8 N m, and the bench."""

    def run(speed_rpm: float, rig: Mapping[str, float] = MappingProxyType({}), **options) -> tuple[list[float], Bench]:
        bench = make_bench(controller="salient", record=tmp_path / "recording.npy", record_step_ns=1_000,
                           record_from_us=round(LOADED_S * 1e6), **options)
        for name, value in rig.items():
            setattr(bench.rig, name, value)
        bench.drive.parameters["telemetry_slow_period_ms"] = 1
        bench.drive.speed_reference_rpm = speed_rpm
        bench.at(LOADED_S).load_torque_Nm = LOAD_NM
        bench.run_for(WINDOWS_S[-1][1])
        assert bench.drive.fault == "none"
        bench.close()
        recording = np.load(bench.options.record)
        return [torque_metrics(recording["time_s"], recording["torque_Nm"], window)["torque_ripple"]
                for window in WINDOWS_S], bench

    return run


def speed_rpm(counts: float, bits: int, rate_hz: int) -> float:
    """At which the rotor turns by `counts` in a period."""
    return round(counts * rate_hz / 2**bits * 60.0, 4)


@pytest.mark.in_turns
@pytest.mark.parametrize(("machine", "rate_hz", "counts"), [
    ("saturating", 40_000, 3.0081), ("saturating", 40_000, 6.0036), ("saturating", 40_000, 6.4990),
    ("saturating", 40_000, 8.4989), ("saturating", 40_000, 12.0078), ("saturating", 20_000, 9.0046),
    ("saturating", 40_000, 7.3333), ("finite_element", 40_000, 20.0001), ("finite_element", 40_000, 14.9986),
])  # fmt: skip
def test_17_bits_ripple_hardly_near_ratios_of_counts(after_step, machine, rate_hz, counts):
    ripples, _ = after_step(speed_rpm(counts, 17, rate_hz), machine=machine, control_rate_hz=rate_hz)
    assert 0.002 < max(ripples) < 0.02


@pytest.mark.parametrize("counts", [0.9999, 1.0030, 2.0, 1.5001])
def test_14_bits_ripple_little_near_ratios_of_counts(after_step, counts):
    """A count is eight times as much."""
    ripples, bench = after_step(speed_rpm(counts, 14, 40_000), encoder_bits=14)
    assert max(ripples) < 0.25
    assert 0.003 < max(ripples[2:]) < 0.06
    bandwidth = bench.telemetry["DRIVE_ADAPTATION.observer_bandwidth_rad_s"]
    assert max(bandwidth.between(LOADED_S + 0.1, WINDOWS_S[-1][1]).value) <= STEADY_RAD_S


@pytest.mark.parametrize("flux_linkage_gain", [0.91, 1.09])
@pytest.mark.parametrize("inertia_gain", [0.65, 1.5])
def test_14_bits_ripple_little_with_other_flux_linkages_near_a_count_per_period(after_step, flux_linkage_gain,
                                                                               inertia_gain):
    """The ripple of wrong tables in the narrow bandwidth of a beat is no load that moves: the wide one would pass the
    beat on to the torque."""
    rig = {"flux_linkage_gain": flux_linkage_gain, "inertia_gain": inertia_gain, "friction_gain": 4.3,
           "supply_voltage_V": 277.6, "encoder_offset_deg": 0.07, "current_noise_A": 0.04}
    ripples, bench = after_step(speed_rpm(1.024, 14, 40_000), rig, encoder_bits=14)
    assert 0.003 < max(ripples[1:]) < 0.1
    bandwidth = bench.telemetry["DRIVE_ADAPTATION.observer_bandwidth_rad_s"]
    assert max(bandwidth.between(LOADED_S + 0.1, WINDOWS_S[-1][1]).value) <= STEADY_RAD_S


@pytest.mark.parametrize(("bits", "counts"), [(17, 8.382), (14, 1.382), (12, 0.382)])
def test_a_load_step_is_no_load_that_moves(after_step, bits, counts):
    """Far from ratios: the bandwidth decays at once, 5 / t from the trigger on."""
    ripples, bench = after_step(speed_rpm(counts, bits, 40_000), encoder_bits=bits)
    bandwidth = bench.telemetry["DRIVE_ADAPTATION.observer_bandwidth_rad_s"]
    assert max(bandwidth.between(LOADED_S, LOADED_S + 0.01).value) > 300
    for after_s in (0.02, 0.03, 0.05):
        after = bandwidth.between(LOADED_S + after_s, LOADED_S + 0.4).value
        assert max(after) <= max(STEADY_RAD_S, 1.3 * 5.0 / after_s)
    assert max(ripples) < {17: 0.012, 14: 0.03, 12: 0.08}[bits]


def test_ripple_after_a_load_step_is_that_of_an_ideal_encoder(after_step):
    ripples, _ = after_step(speed_rpm(8.382, 17, 40_000))
    ideal, _ = after_step(speed_rpm(8.382, 17, 40_000), encoder_bits=0)
    assert max(ripples) < 1.3 * max(ideal)
