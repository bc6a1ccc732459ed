"""Machines of other pole numbers than the bundled ones, of three to six phases, rotors with more poles than the stator
among them: runs with every controller, and the faults of machines of five and six phases.

The torque ripple of `salient` is judged against its reference model in double precision (salient_reference), as in
`compare machines`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_fault_table import CELL, table

from salient.bench.bench import Bench
from salient.config import CONTROLLERS
from salient.dbc import PHASES
from salient.experiments.compare import every_machine
from salient.experiments.fault_table import CASES, measure
from salient.experiments.scenario import run_scenario
from salient.machine.drive_data import derive
from salient.machine.file import load_machine
from salient.paths import ROOT

FILES = {5: ROOT / "tests" / "machines" / "five_phases.toml", 6: ROOT / "tests" / "machines" / "six_phases.toml"}
POLES = {(18, 12): 3, (24, 16): 3, (6, 8): 3, (12, 16): 3, (16, 12): 4, (8, 10): 4, (10, 8): 5, (20, 16): 5,
         (12, 10): 6}
TO_BOUND_MAX = {"start": 1.25, "brake": 1.35, "reverse": 1.25}
"""Times of `salient` by what current, voltage and inertia permit. Six phases take the longest to brake."""


def machine_file(poles: tuple[int, int], folder: Path) -> Path:
    """The machine of five phases with other pole numbers."""
    text = FILES[5].read_text(encoding="utf-8")
    stator, rotor = poles
    for key, number in (("stator = 10", stator), ("rotor = 8", rotor)):
        assert text.count(key) == 1
        text = text.replace(key, f"{key.split()[0]} = {number}")
    file = folder / f"poles_{stator}_{rotor}.toml"
    file.write_text(text, encoding="utf-8")
    return file


@pytest.mark.in_turns
@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("poles", POLES, ids=lambda poles: "{}/{}".format(*poles))
def test_starts_takes_a_load_step_and_reverses_with_the_ripple_of_the_reference_model(poles, controller, tmp_path):
    file = machine_file(poles, tmp_path)
    assert load_machine(file).phases == POLES[poles]
    scenario = every_machine.scenario(file, controller)
    result = run_scenario(scenario, tmp_path)
    assert result.fault == "none"
    values = every_machine.extract(scenario, result.recording)
    print({name: value and round(value, 4) for name, value in values.items()})
    assert values["hold_percent"] < 0.05
    assert 0.0 < values["dip_percent"] < 8.0
    if controller == "traditional":  # two phases make its torque, and its ripple may exceed the band
        assert (values["recovery_time_s"] or 0.001) < 0.06 and 0.95 < (values["start_to_bound"] or 1.0) < 3.0
    else:
        assert 0.0005 < values["recovery_time_s"] < 0.004 and 0.95 < values["start_to_bound"] < 1.6
    if controller == "salient":
        assert 0.7 < values["ripple"] / values["ripple_reference"] < every_machine.RIPPLE_OF_REFERENCE
        for change, most in TO_BOUND_MAX.items():
            assert 0.95 < values[f"{change}_to_bound"] < most, change


@pytest.mark.in_turns
@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("poles", POLES, ids=lambda poles: "{}/{}".format(*poles))
def test_runs_above_its_base_speed_under_load(make_bench, poles, controller, tmp_path):
    file = machine_file(poles, tmp_path)
    machine = load_machine(file)
    data = derive(machine)
    speed_rpm = 1.3 * data.speed_base_rpm
    start_s = machine.inertia_kg_m2 * speed_rpm * math.pi / 30.0 / (0.3 * data.torque_rated_Nm)
    bench = make_bench(machine=str(file), controller=controller)
    bench.drive.speed_reference_rpm = speed_rpm
    bench.run_for(start_s + 0.1)
    bench.load_torque_Nm = 0.2 * data.torque_rated_Nm
    bench.run_for(0.3)
    assert (bench.drive.state, bench.drive.fault) == ("run", "none")
    speed = bench.truth["RIG_TRUTH_MOTION.speed_rpm"].between(bench.time_s - 0.1, bench.time_s).value
    assert speed.mean() == pytest.approx(speed_rpm, rel=0.01)
    assert np.ptp(speed) < 0.03 * speed_rpm


def loaded(make_bench, phases: int, controller: str = "salient", **parameters: float) -> Bench:
    data = derive(load_machine(FILES[phases]))
    bench = make_bench(machine=str(FILES[phases]), controller=controller)
    for name, value in parameters.items():
        bench.drive.parameters[name] = value
    bench.drive.speed_reference_rpm = 0.3 * data.speed_base_rpm
    bench.run_for(0.15)
    bench.load_torque_Nm = 0.3 * data.torque_rated_Nm
    bench.run_for(0.1)
    assert bench.drive.state == "run"
    return bench


@pytest.mark.in_turns
@pytest.mark.parametrize("phases", FILES)
@pytest.mark.parametrize("number", range(len(CASES)), ids=[case.name for case in CASES])
def test_fault_in_the_last_phase_has_a_cause_that_the_table_has_for_it(number, phases):
    """Every row of firmware/FAULTS.md, with a controller that changes from one to the next."""
    case, last = CASES[number], PHASES[phases - 1]
    if case.unsupported:
        return
    cells = [CELL.fullmatch(cell) for (name, _, _), cell in table().items() if name == case.name]
    causes = {cell["fault"] for cell in cells if cell} | ({"none"} if None in cells else set())
    if case.kind.startswith("current_sensor"):  # where the rotor is decides whether a current is too large before
        causes |= {"over_current", "hardware_over_current"}
    arguments = {**case.arguments, "phase": last} if "phase" in case.arguments else case.arguments
    reaction = measure(replace(case, arguments=arguments), str(FILES[phases]), CONTROLLERS[number % len(CONTROLLERS)])
    print(reaction, causes)
    assert reaction.fault in causes or (reaction.fault == "none" and case.unseen)


@pytest.mark.parametrize("phases", FILES)
def test_currents_of_the_phases_e_and_f_are_measured_logged_and_traced(make_bench, phases):
    bench = loaded(make_bench, phases)
    from_s, to_s = bench.time_s - 0.05, bench.time_s
    for phase in PHASES[4:]:
        measured = bench.telemetry[f"DRIVE_PHASES_E_F.current_{phase}_A"].between(from_s, to_s).value
        true = bench.truth[f"RIG_TRUTH_CURRENTS.current_{phase}_A"].between(from_s, to_s).value
        assert (measured.max() > 5.0) == (true.max() > 5.0) == (phase in PHASES[:phases])
        assert measured.max() == pytest.approx(true.max(), rel=0.1, abs=0.1)
    last = PHASES[phases - 1]
    bench.fault("current_sensor_high_rail", phase=last)
    bench.run_for(0.05)
    assert bench.drive.fault == "over_current"
    trace = bench.drive.fault_trace()
    assert trace.current_A.shape[1] == trace.upper_duty.shape[1] == trace.lower_duty.shape[1] == phases
    full_scale_A = derive(load_machine(FILES[phases])).adc_current_A
    assert trace.current_A[-1, -1] == pytest.approx(full_scale_A, rel=0.01)
    assert trace.current_A[-1, :-1].max() < 0.9 * full_scale_A
    logged = bench.drive.fault_log[-1].currents_A
    assert len(logged) == len(PHASES) and logged[phases - 1] == logged[-1 if phases == 6 else -2]
    assert logged[phases - 1] == pytest.approx(full_scale_A, rel=0.01)


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("phases", FILES)
def test_drive_goes_on_without_its_last_phase(make_bench, phases, controller):
    bench = loaded(make_bench, phases, controller, degraded_running=1)
    last, begin_s = PHASES[phases - 1], bench.time_s
    speed_rpm = bench.truth["RIG_TRUTH_MOTION.speed_rpm"].last
    bench.fault("winding_open", phase=last)
    bench.run_for(0.4)
    assert (bench.drive.state, bench.drive.fault) == ("run", "none")
    lost = [phase for phase in PHASES[:4] if bench.telemetry[f"DRIVE_DEGRADED.lost_phase_{phase}"].last]
    lost += [phase for phase in PHASES[4:] if bench.telemetry[f"DRIVE_PHASES_E_F.lost_phase_{phase}"].last]
    assert lost == [last] and bench.telemetry["DRIVE_DEGRADED.degraded"].last == 1
    speed = bench.truth["RIG_TRUTH_MOTION.speed_rpm"].between(begin_s + 0.2, bench.time_s).value
    assert speed.mean() == pytest.approx(speed_rpm, rel=0.02)


@pytest.mark.parametrize("part", ["winding", "inverter"])
@pytest.mark.parametrize("phases", FILES)
def test_temperature_sensor_of_the_last_phase_is_named(make_bench, phases, part):
    bench, last = loaded(make_bench, phases), PHASES[phases - 1]
    bench.fault(f"{part}_temperature_sensor_open", phase=last)
    bench.run_for(0.2)
    assert bench.drive.fault == "temperature_sensor"
    names = [f"{each}_sensor_{phase}" for each in ("winding", "inverter") for phase in PHASES[4:]]
    assert [name for name in names if bench.telemetry[f"DRIVE_PHASES_E_F.{name}"].last] == [f"{part}_sensor_{last}"]
    assert bench.drive.fault_log[-1].self_test == (f"{part}_sensor_{last}",)


def test_fault_in_a_phase_that_the_machine_does_not_have_is_refused(make_bench):
    bench = loaded(make_bench, 5)
    with pytest.raises(Exception, match="no_such_place"):
        bench.fault("winding_open", phase="f")


def test_only_a_drive_of_more_than_four_phases_sends_currents_of_phases_e_and_f(make_bench):
    bench = make_bench(machine="finite_element")
    bench.run_for(0.3)
    assert 0x288 not in {message.arbitration_id for _, message in bench.log}
    with pytest.raises(KeyError, match="DRIVE_PHASES_E_F"):
        bench.telemetry["DRIVE_PHASES_E_F.current_e_A"].last  # noqa: B018
