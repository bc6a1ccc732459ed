"""Load profiles: the bundled compressors against their model, files with mistakes, scenarios."""

from __future__ import annotations

import numpy as np
import pytest

from salient.bench.load_profile import load_profile_path, read_load_profile
from salient.errors import UsageError
from salient.experiments import compressor
from salient.experiments.scenario import LoadStep, load_scenarios

ROWS = "".join(f"{45 * n},{n}\n" for n in range(8))
SCENARIO = 'machine = "saturating"\ncontrollers = ["salient"]\nduration_s = 0.1\n'


@pytest.mark.parametrize("name", compressor.PROFILES)
def test_bundled_profile_is_what_its_command_writes(name, tmp_path):
    compressor.main(tmp_path)
    assert load_profile_path(name).read_text() == (tmp_path / f"{name}.csv").read_text()


@pytest.mark.parametrize(("name", "cylinders", "peak"), [("compressor_one_cylinder", 1, 6.4),
                                                         ("compressor_two_cylinders", 2, 3.2)])
def test_work_of_a_turn_is_that_of_the_ideal_cycle(name, cylinders, peak):
    """Area of the pressure-volume diagram: n / (n - 1) (ratio^((n - 1) / n) - 1) times the suction volume."""
    values = np.array(read_load_profile(load_profile_path(name)))
    assert len(values) == compressor.VALUES
    assert values.mean() == pytest.approx(1.0, abs=1e-6)
    assert values.max() == pytest.approx(peak, rel=0.02)
    n, ratio, clearance = compressor.EXPONENT, compressor.PRESSURE_RATIO, compressor.CLEARANCE
    suction_volume = 1.0 + clearance - clearance * ratio ** (1.0 / n)
    work = n / (n - 1.0) * (ratio ** ((n - 1.0) / n) - 1.0) * suction_volume
    angle_rad = np.linspace(0.0, 2.0 * np.pi, 100_000, endpoint=False)
    # The torque is in suction pressure * area * radius, the swept volume is area * 2 radius.
    assert cylinders * compressor.cylinder_torque(angle_rad).mean() * np.pi == pytest.approx(cylinders * work, rel=1e-4)


def test_file_is_read_without_comments_and_blank_lines(tmp_path):
    path = tmp_path / "load.csv"
    path.write_text(f"# comment\n\nangle_deg,torque\n{ROWS}")
    assert read_load_profile(path) == tuple(float(n) for n in range(8))


@pytest.mark.parametrize(("text", "message"), [
    ("angle,torque\n" + ROWS, "the header must be angle_deg,torque"),
    ("", "the header must be angle_deg,torque"),
    ("angle_deg,torque\n0,1\n", "1 rows; must be 8 to 256"),
    ("angle_deg,torque\n" + ROWS.replace("90,2", "90"), "line 4: '90': must be two numbers, angle_deg,torque"),
    ("angle_deg,torque\n" + ROWS.replace("90,2", "91,2"), "line 4: angle_deg 91: must be 90, for equal steps"),
    ("angle_deg,torque\n" + ROWS.replace("90,2", "90,nan"), "line 4: torque nan: must be a number from -1000 to"),
])  # fmt: skip
def test_mistake_in_a_file_is_named(tmp_path, text, message):
    path = tmp_path / "load.csv"
    path.write_text(text)
    with pytest.raises(UsageError) as caught:
        read_load_profile(path)
    assert str(caught.value).startswith(f"{path}: {message}")


def test_scenario_names_a_bundled_profile_or_a_file_next_to_it(tmp_path):
    (tmp_path / "load.csv").write_text("angle_deg,torque\n" + ROWS)
    path = tmp_path / "scenario.toml"
    for name, expected in (("compressor_one_cylinder", "compressor_one_cylinder"),
                           ("load.csv", str((tmp_path / "load.csv").resolve()))):
        load = "[[load]]\nat_s = 0.0\ntorque_Nm = 1.0\nprofile_Nm = 2.0\n"
        path.write_text(f'{SCENARIO}load_profile = "{name}"\n{load}')
        (scenario,) = load_scenarios(path)
        assert scenario.load_profile == expected
        assert scenario.load == (LoadStep(0.0, 1.0, 2.0),)
    path.write_text(f'{SCENARIO}load_profile = "compressor"\n')
    names = "; must be one of compressor_one_cylinder, compressor_two_cylinders"
    with pytest.raises(UsageError, match=f"no such file, and no bundled load profile of that name{names}"):
        load_scenarios(path)
