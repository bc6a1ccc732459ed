"""The comparison of the controller salient with its reference model in double precision, on machines of other sizes."""

from __future__ import annotations

import subprocess

import numpy as np
import pytest

from salient.bench.programs import reference_executable
from salient.experiments.compare import every_machine, reference
from salient.experiments.compare.every_machine import EXAMPLES
from salient.experiments.compare.targets import TARGETS, target_of
from salient.machine.cache import machine_image
from salient.machine.file import load_machine, machine_path
from salient.machine.scaling import Exponents, scaling_of
from salient.paths import MACHINES

AT_150_RPM = {"control_rate_hz": 40_000, "speed_rpm": 150.0, "load_Nm": 8.0, "load_at_s": 0.13, "from_s": 0.3,
              "window_s": 0.1}


@pytest.mark.parametrize(("name", "least", "most"), [("fan12", 0.009, 0.012), ("servo86", 0.007, 0.010)])
def test_ripple_of_another_machine_is_at_most_1_1_times_that_of_the_reference_model(name, least, most):
    ripple = every_machine.ripples(every_machine.scenario(EXAMPLES / f"{name}.toml", "salient"))
    assert least < ripple["reference"] < most
    assert 0.9 < ripple["firmware"] / ripple["reference"] < 1.1


def test_reference_model_of_a_machine_with_another_unit_of_speed_has_the_same_ripple(tmp_path):
    faster = tmp_path / "faster.toml"
    text = (MACHINES / "saturating.toml").read_text(encoding="utf-8")
    faster.write_text(text.replace("[drive]\n", "[drive]\nspeed_max_rpm = 4100.0\n"), encoding="utf-8")
    assert scaling_of(faster, load_machine(faster)).exponents == Exponents(speed=1)
    measured = [reference.measure(machine, **AT_150_RPM) for machine in ("saturating", str(faster))]
    for drive in reference.DRIVES:
        of = [each[drive] for each in measured]
        assert of[0]["speed_mean_rpm"] == pytest.approx(150.0, rel=1e-4)
        assert of[0]["torque_mean_Nm"] == pytest.approx(of[1]["torque_mean_Nm"], rel=1e-3)
        assert of[0]["ripple"] == pytest.approx(of[1]["ripple"], rel=0.05)
        assert 0.004 < of[0]["ripple"] < 0.0065


def judged(monkeypatch, ripple: float, of_reference: float) -> tuple[float, list[str]]:
    """ripple_to_allowed of a recording with this ripple, and what is wrong with it."""
    monkeypatch.setattr(every_machine, "ripples", lambda scenario: {"reference": of_reference})
    scenario = every_machine.scenario(EXAMPLES / "fan12.toml", "salient")
    samples = round(scenario.duration_s * 1e6)
    recording = np.zeros(samples, dtype=[("time_s", float), ("speed_rpm", float), ("torque_Nm", float)])
    recording["time_s"] = np.arange(samples) / 1e6
    for step in scenario.speed:
        recording["speed_rpm"][recording["time_s"] >= step.at_s] = step.value_rpm
    recording["torque_Nm"] = 1.0 + 0.5 * ripple * (-1.0) ** np.arange(samples)
    values = every_machine.extract(scenario, recording)
    assert values["ripple"] == pytest.approx(ripple) and values["ripple_reference"] == of_reference
    return values["ripple_to_allowed"], every_machine.failures(values, "salient")


@pytest.mark.parametrize(("ripple", "of_reference", "to_allowed"), [
    (0.0099, 0.002, 0.99), (0.0101, 0.002, 1.01), (0.0119, 0.010, 0.0119 / 0.012), (0.0121, 0.010, 0.0121 / 0.012)])
def test_ripple_is_allowed_up_to_a_hundredth_or_1_2_times_that_of_the_reference_model(monkeypatch, ripple, of_reference,
                                                                                      to_allowed):
    value, wrong = judged(monkeypatch, ripple, of_reference)
    assert value == pytest.approx(to_allowed)
    assert wrong == ([] if to_allowed < 1.0 else [f"K_t {ripple:.4f}, of the reference model {of_reference:.4f}"])


@pytest.mark.parametrize(("arguments", "expected"), [
    (["speed=1"], "salient_reference: speed=1: must be NAME=VALUE, NAME one of control_rate_hz"),
    (["speed_rpm=fast"], "salient_reference: speed_rpm=fast: must be a number from"),
    (["adc_bits=12.5"], "salient_reference: adc_bits=12.5: must be a whole number from 12 to 16"),
    (["encoder_bits=7"], "salient_reference: encoder_bits=7: must be 0"),
    (["control_rate_hz=30000"], "salient_reference: control_rate_hz=30000: must be 20000, 40000"),
])
def test_wrong_argument_is_reported_in_one_line(arguments, expected):
    image = machine_image(str(machine_path("saturating")))
    done = subprocess.run([reference_executable(), image, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith(expected) and done.stderr.count("\n") == 1


def test_ripple_of_any_machine_is_judged():
    for machine in ("fan12", "one of a user"):
        assert target_of(TARGETS, ("machines", machine, "ripple_to_allowed", "")).limit == 1.0
        assert target_of(TARGETS, ("machines", machine, "ripple", "")).limit is None
