"""The drive's data of a machine, and the experiments in its terms."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace

import pytest

from salient.experiments.compare import every_machine
from salient.experiments.compare.cases import GROUPS
from salient.experiments.compare.machine import cases_of, subject
from salient.experiments.compare.random_machines import COUNT, random_machine
from salient.experiments.scaled import scale_of_name, scaled, steady_window_s
from salient.experiments.scenario import load_scenarios
from salient.machine.definition import Machine
from salient.machine.drive_data import DERIVED, DriveData, derive
from salient.machine.file import load_machine
from salient.machine.parameter_table import read_table
from salient.machine.single_pulse import single_pulse
from salient.machine.torque_speed import Source, smooth_torque_Nm, speed_change_s
from salient.paths import MACHINES, ROOT, SCENARIOS

BUNDLED = sorted(MACHINES.glob("*.toml"))
OTHERS = sorted((ROOT / "tools" / "examples" / "machines").glob("*.toml"))


@pytest.mark.parametrize("path", BUNDLED, ids=lambda path: path.stem)
def test_bundled_machines_keep_the_defaults_of_the_firmware(path):
    data = derive(load_machine(path))
    own = {"inertia_kg_m2", "friction_Nm_s", "resistance_ohm", "winding_current_A", "bp_error_scale_Nm"}
    if path.stem == "finite_element":  # light: its reaching law is faster; poles overlap later than the paper's
        own |= {"smc_k", "smc_delta", "turn_on_angle_deg", "turn_off_angle_deg", "outgoing_off_angle_deg",
                "hand_over_angle_deg"}
        assert data.parameters["smc_k"] == pytest.approx(1213, rel=0.001)
        assert data.parameters["smc_delta"] == pytest.approx(2.92, rel=0.01)
    for row in read_table():
        if row.name not in own:
            assert math.floor(math.ldexp(data.parameters[row.name], row.fraction_bits) + 0.5) == row.default, row.name


@pytest.mark.parametrize("path", BUNDLED, ids=lambda path: path.stem)
def test_bundled_machines_keep_the_experiments_of_the_paper(path):
    scale = scale_of_name(path.stem)
    for name in ("start_600", "load_step_150"):
        for scenario in load_scenarios(SCENARIOS / f"{name}.toml"):
            of_machine = replace(scenario, machine=path.stem)
            assert scaled(of_machine, scale) == of_machine
            assert steady_window_s(of_machine, scale) == (0.3, 0.4)


def test_comparison_of_the_papers_machine_is_unchanged():
    on = subject("saturating")
    for group in ("ripple", "speeds", "loads", "start", "moving", "ramps"):
        cases = [case for case in GROUPS[group].cases(False) if case.scenario.machine == "saturating"]
        assert cases_of(cases, on) == cases


def test_comparison_of_another_machine_names_its_speeds_and_loads():
    on = subject(str(OTHERS[0]))
    data = derive(on.machine)
    (case, *_) = cases_of(GROUPS["speeds"].cases(False), on)
    assert case.condition.startswith(on.machine.name)
    shown_rpm = float(re.search(r"([\d.]+) r/min", case.condition)[1])
    assert shown_rpm == case.scenario.speed[0].value_rpm == pytest.approx(0.4 * data.speed_base_rpm, rel=0.05)
    assert case.scenario.load[0].torque_Nm == pytest.approx(0.5 * data.torque_rated_Nm, rel=0.05)


@pytest.mark.parametrize("path", OTHERS, ids=lambda path: path.stem)
def test_every_value_is_finite_and_in_order(path):
    machine = load_machine(path)
    data = derive(machine)
    assert all(math.isfinite(each.value) for each in data.derivations)
    assert data.current_rated_A <= data.current_peak_A < data.current_trip_A < data.adc_current_A
    assert data.torque_rated_Nm <= data.torque_peak_Nm < smooth_torque_Nm(machine.magnetics, machine.phases,
                                                                         data.current_peak_A)
    assert data.speed_base_rpm <= data.speed_max_rpm < data.over_speed_rpm
    assert data.under_voltage_V < data.supply_min_V <= data.supply_max_V < data.over_voltage_V
    # The voltage makes the rated torque at the base speed, and the bound of a start is not below the torque's.
    source = Source(data.supply_min_V, machine.resistance_ohm)
    pulses = single_pulse(replace(machine, supply_voltage_V=data.supply_min_V), data)
    base_rad_s = data.speed_base_rpm * math.pi / 30.0
    assert data.parameters["current_limit_A"] == data.current_peak_A
    assert pulses.mean_Nm[0][pulses.speed_per_voltage * data.supply_min_V <= base_rad_s].min() > data.torque_rated_Nm
    bound_s = speed_change_s(machine.magnetics, machine.phases, source, data.current_peak_A, data.torque_peak_Nm,
                             machine.inertia_kg_m2, machine.friction_Nm_s, 0.0, 0.4 * base_rad_s)
    least_s = machine.inertia_kg_m2 * 0.4 * base_rad_s / data.torque_peak_Nm
    assert least_s <= bound_s < 1.5 * least_s + 2e-3


def test_reaching_law_is_as_steep_as_a_short_start_needs_and_never_more_than_the_torque_can_follow(tmp_path):
    files = [*BUNDLED, *OTHERS, *(tmp_path / f"random_{number:02}.toml" for number in range(COUNT))]
    by_limit = set()
    for path in files:
        if path.parent == tmp_path:
            path.write_text(random_machine(int(path.stem[-2:])))
        machine = load_machine(path)
        data = derive(machine)
        acceleration = data.parameters["torque_max_Nm"] / machine.inertia_kg_m2
        start_s = data.speed_base_rpm * math.pi / 30.0 / acceleration
        followed_s = (data.parameters["torque_max_Nm"] / data.torque_step_Nm + 3.0) / data.control_rate_hz
        delta_s = data.parameters["smc_delta"]
        assert 0.3 < delta_s <= 1.0001 * max(1.0, 0.1 / start_s)
        assert delta_s * acceleration * followed_s <= 8.001
        if delta_s < 0.999 * max(1.0, 0.1 / start_s):
            assert delta_s * acceleration * followed_s == pytest.approx(8.0)
            by_limit.add(path.stem)
    assert {"finite_element", "random_08", "random_13", "random_18"} <= by_limit
    assert by_limit.isdisjoint({"saturating", "linear_cosine", "linear_trapezoid", "traction", "map86"})


def rise_A(machine: Machine, data: DriveData) -> float:
    """Rise of the current in a control period by the largest voltage at the unaligned position."""
    return data.supply_max_V / machine.magnetics.unaligned_inductance_H / data.control_rate_hz


def test_current_range_is_at_a_power_of_two_of_80_A_wherever_the_trip_has_room(tmp_path):
    files = [*OTHERS, *(tmp_path / f"random_{number:02}.toml" for number in range(COUNT))]
    lowered = []
    for number in range(COUNT):
        files[len(OTHERS) + number].write_text(random_machine(number))
    for path in files:
        machine = load_machine(path)
        data = derive(machine)
        margin_A = 2.2 * rise_A(machine, data)
        least_A = 1.01 * data.current_peak_A + 2.4 * rise_A(machine, data)
        most_A = max(1.5 * data.current_peak_A, 1.1 * data.current_peak_A + margin_A)
        assert least_A <= 1.0001 * data.current_trip_A <= 1.0002 * most_A
        assert data.current_trip_A <= 0.9876 * data.adc_current_A
        exponent = math.floor(math.log2(most_A / 0.9375 / 80.0))
        if max(least_A / 0.9875, data.current_peak_A / 0.9) <= 80.0 * 2.0**exponent:
            assert data.adc_current_A == 80.0 * 2.0**exponent
            lowered.append(path.stem)
        else:
            assert data.adc_current_A == pytest.approx(most_A / 0.9375)
            assert data.current_trip_A == pytest.approx(most_A)
    assert {"fan12", "servo86", "random_08", "random_19"} <= set(lowered) and len(lowered) < len(files) / 2


@pytest.mark.parametrize("stated", ["current_trip_A = 93.0", "current_limit_A = 85.0"])
def test_trip_or_limit_that_the_file_states_stays_within_the_current_range(tmp_path, stated):
    path = tmp_path / "stated.toml"
    path.write_text(f"{(every_machine.EXAMPLES / 'servo86.toml').read_text()}\n[drive.parameters]\n{stated}\n")
    data = derive(load_machine(path))
    assert data.parameters[stated.split()[0]] == float(stated.split()[2])
    assert data.adc_current_A == pytest.approx(99.4, rel=0.01)


def test_random_machines_are_valid_and_have_an_experiment(tmp_path):
    for number in range(COUNT):
        path = tmp_path / f"random_{number:02}.toml"
        path.write_text(random_machine(number))
        run = every_machine.scenario(path, "salient")
        times_s = [step.at_s for step in (*run.speed, *run.load)]
        assert min(times_s) == 0.0 and max(times_s) < run.duration_s < 10.0


def test_every_formula_is_documented():
    text = (ROOT / "docs" / "machines" / "data.md").read_text(encoding="utf-8")
    for path in OTHERS:
        for each in derive(load_machine(path)).derivations:
            if each.source == DERIVED and each.name != "current_peak_A":
                assert f"| `{each.name}` | {each.unit} |" in text
                assert each.formula in text or each.name.endswith("_rated_Nm"), each.name


@pytest.mark.in_turns
def test_machine_command_lists_values_with_formula_and_source(salient, tmp_path):
    result = salient("machine", OTHERS[0], "--out", tmp_path, "--json", tmp_path / "drive.json")
    assert result.returncode == 0, result.stderr
    values = json.loads((tmp_path / "drive.json").read_text())["drive"]
    for each in derive(load_machine(OTHERS[0])).derivations:
        assert values[each.name] == {"value": each.value, "unit": each.unit, "source": each.source,
                                     "formula": each.formula}
        if each.source == DERIVED:
            assert re.search(rf"^  {each.name} .*derived +{re.escape(each.formula)}$", result.stdout, re.MULTILINE)
