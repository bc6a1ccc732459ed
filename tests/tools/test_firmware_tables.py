"""The firmware's tables of a phase as generated, read back in double precision: machines whose flux linkage is not
separable in angle and current, and magnetics that the tables cannot represent."""

import math

import numpy as np
import pytest

from salient.errors import UsageError
from salient.generate import machine as generate_machine
from salient.machine.cache import machine_image
from salient.machine.file import MachineError, load_machine
from salient.machine.firmware_tables import (
    ANGLE_BINS,
    CURRENT_A,
    CURVATURE_SHIFT_MAX,
    ROW_UNITS,
    ROWS,
    ROWS_INSIDE_BIN_MAX,
    PhaseMapError,
    machine_phase_map,
    phase_map,
)
from salient.machine.scaling import Exponents
from salient.paths import MACHINES

POLES = 4
HALF_RAD = math.pi / POLES


class LocalSaturation:
    """Poles that overlap over an arc, and saturate at a flux proportional to the overlap, so at an angle-dependent
    current. psi = Lu i + S o(x) (1 - e^(-b i)), b = (La - Lu) / S (1 + spread (1 - o)), of the overlap o."""

    pitch_rad = 2.0 * HALF_RAD
    current_max_A = math.inf

    def __init__(self, spread: float = 0.8):
        self.spread = spread

    def _overlap(self, angle_rad):
        """Overlap and its slope: a smooth step over the angle from aligned, 15 deg wide around 17 deg."""
        wrapped = np.mod(np.asarray(angle_rad, float) + HALF_RAD, self.pitch_rad) - HALF_RAD
        x = (np.abs(wrapped) - math.radians(17.0)) / math.radians(4.0)
        return 0.5 * (1.0 - np.tanh(x)), -0.5 / np.cosh(x) ** 2 / math.radians(4.0) * np.sign(wrapped)

    def _rate(self, overlap):
        return 0.0572 * (1.0 + self.spread * (1.0 - overlap)), -0.0572 * self.spread

    def flux_linkage_Wb(self, angle_rad, current_A):
        overlap, _ = self._overlap(angle_rad)
        rate, _ = self._rate(overlap)
        return 0.67e-3 * np.asarray(current_A) - 0.4 * overlap * np.expm1(-rate * current_A)

    def torque_Nm(self, angle_rad, current_A):
        overlap, slope = self._overlap(angle_rad)
        rate, rate_slope = self._rate(overlap)
        decay = np.exp(-rate * current_A)
        risen_A = current_A - (1.0 - decay) / rate
        by_rate = (1.0 - decay) / rate**2 - current_A * decay / rate
        return 0.4 * slope * (risen_A + overlap * rate_slope * by_rate)


def read_back(tables, surface, position, current_A):
    """Interpolation of firmware/control/phase_map.c in double precision; position from 0, unaligned, to 1, aligned."""
    start = tables.row_start / ROW_UNITS
    row = np.clip(np.searchsorted(start, position, side="right") - 1, 0, ROWS - 2)
    u = ((position - start[row]) / (start[row + 1] - start[row]))[:, None]
    curvatures = surface.curvature[row] * 2.0**surface.curvature_shift
    rows = surface.node[row] + u * (surface.node[row + 1] - surface.node[row]) - u * (1.0 - u) * curvatures
    value = np.array([np.interp(current_A, CURRENT_A, at_angle) for at_angle in rows])
    return value * current_A / 2.0**surface.fraction_bits


def differences(magnetics, current_max_A):
    """Maximum differences of torque in N m and flux linkage in Wb between tables and machine."""
    tables = phase_map(magnetics)
    position = (np.arange(1999) + 0.37) / 2000.0
    current_A = np.arange(0.3, current_max_A, 0.4)
    half_rad = magnetics.pitch_rad / 2.0
    angle_rad = half_rad + half_rad * position[:, None]
    torque_Nm = read_back(tables, tables.torque_per_ampere, position, current_A)
    flux_Wb = read_back(tables, tables.flux_per_ampere, position, current_A)
    return (
        np.max(np.abs(torque_Nm - magnetics.torque_Nm(angle_rad, current_A))),
        np.max(np.abs(flux_Wb - magnetics.flux_linkage_Wb(angle_rad, current_A))),
    )


def test_torque_of_the_test_machine_is_the_slope_of_its_co_energy():
    magnetics = LocalSaturation()
    angle_rad, step_rad = HALF_RAD * np.linspace(1.05, 1.95, 50), 1e-5
    current_A = np.linspace(0.0, 40.0, 4001)
    coenergy_J = [
        np.trapezoid(magnetics.flux_linkage_Wb((angle_rad + s)[:, None], current_A), current_A, axis=1)
        for s in (-step_rad, step_rad)
    ]
    slope_Nm = (coenergy_J[1] - coenergy_J[0]) / (2.0 * step_rad)
    assert np.max(np.abs(slope_Nm - magnetics.torque_Nm(angle_rad, 40.0))) < 1e-4 * np.max(slope_Nm)


def test_angle_dependent_saturation_is_approximated_within_21_millinewton_metres():
    magnetics = LocalSaturation()
    # Not separable: the saturation at half overlap is not a scaled copy of that at the aligned position.
    halved = magnetics.flux_linkage_Wb(np.array([[0.0], [math.radians(17.0)]]), np.array([5.0, 60.0]))
    assert halved[1, 0] / halved[0, 0] > 1.2 * halved[1, 1] / halved[0, 1]
    torque_Nm, flux_Wb = differences(magnetics, 30.0)
    assert 0.016 < torque_Nm < 0.021
    assert 110e-6 < flux_Wb < 140e-6


def test_rows_are_densest_where_the_torque_curvature_is_largest():
    start_deg = 45.0 * phase_map(load_machine(MACHINES / "linear_trapezoid.toml").magnetics).row_start / ROW_UNITS
    for corner_deg in (1.0, 3.0, 42.0, 44.0):
        assert np.min(np.abs(start_deg - corner_deg)) < 0.003, corner_deg


def rows_inside_bins(tables):
    """Rows that begin within each angle bin, not counting one at its start."""
    inside = tables.row_start[tables.row_start % (ROW_UNITS // ANGLE_BINS) != 0]
    return np.bincount(inside * ANGLE_BINS // ROW_UNITS, minlength=ANGLE_BINS)


def assert_lookup_finds_every_row(tables):
    """The look-up of firmware/control/phase_map.h, with ROWS_INSIDE_BIN_MAX steps, at each unit of the angle."""
    assert ROWS_INSIDE_BIN_MAX == 2
    start = tables.row_start
    assert len(start) == ROWS and start[0] == 0 and start[-1] == ROW_UNITS and np.all(np.diff(start) >= 1)
    distance = np.arange(ROW_UNITS)
    row = tables.angle_bin_row()[distance * ANGLE_BINS // ROW_UNITS]
    for _ in range(ROWS_INSIDE_BIN_MAX):
        row += start[row + 1] <= distance
    assert np.all(row == np.searchsorted(start, distance, side="right") - 1)


@pytest.mark.parametrize("path", sorted(MACHINES.glob("*.toml")), ids=lambda path: path.stem)
def test_lookup_finds_every_row_of_the_bundled_machines(path):
    assert_lookup_finds_every_row(phase_map(load_machine(path).magnetics))


class Structured:
    """Poles whose torque has random structure over a part of the angle: `points` of a polygon from `first` to `last`,
    fractions of half a pitch. psi = (Lu + overlap(x)) i, T = slope of overlap i^2 / 2; psi = L i otherwise."""

    pitch_rad = 2.0 * HALF_RAD
    current_max_A = math.inf

    def __init__(self, seed, first, last, points, depth):
        chance = np.random.default_rng(seed)
        inside = np.sort(chance.uniform(first, last, points))
        self.x = np.concatenate([[0.0, first], inside, [last, 1.0]])
        self.shape = np.concatenate([[0.6, 0.6], 0.6 + depth * chance.uniform(-0.5, 0.5, points), [0.6, 0.6]])
        at = np.linspace(0.0, 1.0, 200_001)
        value = np.interp(at, self.x, self.shape)
        self.at, self.overlap = at, np.concatenate([[0.0], np.cumsum(0.5 * (value[1:] + value[:-1]) * np.diff(at))])

    def _position(self, angle_rad):
        return (np.asarray(angle_rad, float) - HALF_RAD) / HALF_RAD

    def flux_linkage_Wb(self, angle_rad, current_A):
        inductance_H = 0.001 + 0.02 * np.interp(self._position(angle_rad), self.at, self.overlap)
        return inductance_H * np.asarray(current_A)

    def torque_Nm(self, angle_rad, current_A):
        slope_H = 0.02 / HALF_RAD * np.interp(self._position(angle_rad), self.x, self.shape)
        return 0.5 * slope_H * np.asarray(current_A) ** 2


@pytest.mark.in_turns
@pytest.mark.parametrize(("first", "last", "points"), [
    (0.3, 0.3 + 0.9 / ANGLE_BINS, 12), (0.5, 0.5 + 1.0 / ANGLE_BINS, 3), (0.3, 0.35, 40), (0.1, 0.2, 30),
    (0.0, 1.0, 12), (0.0, 1.0, 400), (0.9, 1.0, 60), (0.0, 0.02, 25),
])  # fmt: skip
def test_at_most_two_rows_begin_inside_an_angle_bin_of_any_machine(first, last, points):
    crowded = 0
    for seed in range(4):
        tables = phase_map(Structured(seed, first, last, points, 1.0))
        assert_lookup_finds_every_row(tables)
        inside = rows_inside_bins(tables)
        crowded = max(crowded, np.max(inside))
        assert np.max(inside) <= ROWS_INSIDE_BIN_MAX
    assert crowded == ROWS_INSIDE_BIN_MAX or points == 400, "no bin is full"


def test_structure_within_one_angle_bin_costs_accuracy_only_there():
    position = (np.arange(1999) + 0.37) / 2000.0
    angle_rad = HALF_RAD + HALF_RAD * position[:, None]
    magnetics = Structured(0, 0.3, 0.3 + 0.9 / ANGLE_BINS, 12, 1.0)
    tables = phase_map(magnetics)
    current_A = np.array([20.0])
    error_Nm = np.abs(read_back(tables, tables.torque_per_ampere, position, current_A)
                      - magnetics.torque_Nm(angle_rad, current_A))[:, 0]
    there = np.unique((magnetics.x[1:-1] * ANGLE_BINS).astype(int))
    elsewhere = ~np.isin((position * ANGLE_BINS).astype(int), there)
    assert len(there) == 2 and ROWS_INSIDE_BIN_MAX in rows_inside_bins(tables)[there]
    assert np.max(error_Nm[elsewhere]) < 0.001 < np.max(error_Nm)


class Scaled:
    """A machine with its flux linkage multiplied, and its torque by the same or another factor."""

    def __init__(self, magnetics, factor, torque_factor=None):
        self.magnetics, self.factor = magnetics, factor
        self.torque_factor = torque_factor or factor
        self.pitch_rad, self.current_max_A = magnetics.pitch_rad, magnetics.current_max_A

    def flux_linkage_Wb(self, angle_rad, current_A):
        return self.factor * self.magnetics.flux_linkage_Wb(angle_rad, current_A)

    def torque_Nm(self, angle_rad, current_A):
        return self.torque_factor * self.magnetics.torque_Nm(angle_rad, current_A)


@pytest.mark.parametrize(("factor", "torque_factor"), [(0.5, 0.5), (1.0, 1.0), (7.0, 7.0), (7.0, 100.0)])
def test_format_depends_on_the_range_of_the_machine(factor, torque_factor):
    machine = load_machine(MACHINES / "saturating.toml").magnetics
    tables = phase_map(Scaled(machine, factor, torque_factor))
    for surface in (tables.torque_per_ampere, tables.flux_per_ampere):
        assert 32768 <= np.max(surface.node) <= 65535, "all 16 bits in use"
        assert np.min(surface.node) >= 0
        assert 64 <= np.max(np.abs(surface.curvature)) <= 127, "and of the curvatures all 8"
        assert 0 <= surface.curvature_shift <= CURVATURE_SHIFT_MAX
        assert 0 <= surface.result_shift <= 12


def test_weak_machine_has_the_finest_format():
    machine = load_machine(MACHINES / "saturating.toml").magnetics
    tables = phase_map(Scaled(machine, 0.01))
    for surface in (tables.torque_per_ampere, tables.flux_per_ampere):
        assert surface.result_shift == 0
        assert 500 < np.max(surface.node) < 5000


def test_unrepresentable_machine_is_rejected_in_one_line():
    machine = load_machine(MACHINES / "saturating.toml").magnetics
    with pytest.raises(PhaseMapError, match=r"^[0-9.]+ N m/A of torque is more than the firmware's tables hold$"):
        phase_map(Scaled(machine, 2000.0))
    with pytest.raises(PhaseMapError, match=r"^at [0-9.]+ deg, towards aligned, the torque falls to [-0-9.]+ N m at"):
        phase_map(LocalSaturation(spread=2.0))


def largest_interpolated_flux_linkage_Wb(tables):
    """Largest flux linkage of the look-up up to 80 A."""
    position = (np.arange(3999) + 0.37) / 4000.0
    return np.max(read_back(tables, tables.flux_per_ampere, position, np.linspace(0.5, 80.0, 160)))


@pytest.mark.parametrize("name", ["saturating", "linear_cosine", "finite_element"])
def test_flux_linkage_beyond_its_format_is_rejected_in_one_line(name):
    machine = load_machine(MACHINES / f"{name}.toml").magnetics
    largest_Wb = largest_interpolated_flux_linkage_Wb(phase_map(machine))
    accepted = phase_map(Scaled(machine, 0.93 * 4.0 / largest_Wb, 0.1))
    assert 0.9 * 4.0 < largest_interpolated_flux_linkage_Wb(accepted) < 4.0
    with pytest.raises(PhaseMapError, match=r"^the flux linkage .* is up to [0-9.]+ Wb; it must be below 4 Wb$"):
        phase_map(Scaled(machine, 1.001 * 4.0 / largest_Wb, 0.1))


class BetweenRows(Scaled):
    """Flux linkage with a maximum half way between rows: the rows of the saturating machine are equidistant."""

    def flux_linkage_Wb(self, angle_rad, current_A):
        row = (np.asarray(angle_rad) - HALF_RAD) / HALF_RAD * (ROWS - 1)
        return self.factor * (0.6 + 0.4 * np.sin(math.pi * row) ** 2) * np.asarray(current_A) / 80.0


def test_flux_linkage_between_rows_counts():
    machine = load_machine(MACHINES / "saturating.toml").magnetics
    tables = phase_map(BetweenRows(machine, 3.9, 1.0))
    assert np.max(tables.flux_per_ampere.node[:, -1]) * 80.0 / 2.0**tables.flux_per_ampere.fraction_bits < 2.5
    assert largest_interpolated_flux_linkage_Wb(tables) == pytest.approx(3.9, rel=0.01)
    with pytest.raises(PhaseMapError, match=r"is up to 4\.[0-9]+ Wb; it must be below 4 Wb$"):
        phase_map(BetweenRows(machine, 4.1, 1.0))


@pytest.mark.parametrize("name", ["saturating", "linear_cosine", "finite_element"])
def test_torque_beyond_its_format_is_accepted(name):
    """The firmware saturates it."""
    machine = load_machine(MACHINES / f"{name}.toml").magnetics
    tables = phase_map(Scaled(machine, 1.0, 20.0))
    torque_Nm = tables.torque_per_ampere.node[:, -1] * 80.0 / 2.0**tables.torque_per_ampere.fraction_bits
    assert np.max(torque_Nm) > 128.0


def test_results_in_units_of_the_tables_are_below_2_to_29():
    """By construction: nodes of 16 bits, curvatures within 127, and u (1 - u) <= 1/4."""
    value_max_q14 = (65535 << 14) + 127 * ((1 << 12) << CURVATURE_SHIFT_MAX)
    assert value_max_q14 < 1 << 31
    assert value_max_q14 * (80 << 9 << 15) >> 32 < 1 << 29
    for seed in range(4):
        tables = phase_map(Structured(seed, 0.0, 1.0, 60, 1.0))
        for surface in (tables.torque_per_ampere, tables.flux_per_ampere):
            assert np.min(surface.node) >= 0 and np.max(surface.node) <= 65535
            assert np.max(np.abs(surface.curvature)) <= 127 and surface.curvature_shift <= CURVATURE_SHIFT_MAX
            values = surface.over_angle(np.linspace(0.0, 1.0, 33))
            assert np.max(np.abs(values)) * 2.0 ** (surface.fraction_bits + 14) <= value_max_q14


@pytest.fixture
def strong_machine(tmp_path):
    """A file of valid numbers whose torque exceeds the range of the tables."""
    text = (MACHINES / "linear_cosine.toml").read_text(encoding="utf-8")
    text = text.replace("stator = 6", "stator = 12").replace("rotor = 4", "rotor = 8")
    path = tmp_path / "strong.toml"
    path.write_text(text.replace("23.6e-3", "9.0"), encoding="utf-8")
    return path


def test_build_step_names_the_rejected_file(strong_machine, tmp_path, capsys):
    assert generate_machine.main([str(strong_machine), str(tmp_path / "out")]) == 2
    output = capsys.readouterr().err
    assert output.startswith(f"salient: {strong_machine}: magnetics.aligned_inductance_H: 9 H: ")
    assert output.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_rejected_machine_is_named_before_anything_is_built(strong_machine):
    with pytest.raises(UsageError, match=r"strong\.toml: magnetics\.aligned_inductance_H: 9 H: must not be above"):
        machine_image(str(strong_machine))


def test_map_that_ends_early_is_levelled_where_linear_extrapolation_loses_torque(tmp_path):
    lines = (MACHINES / "finite_element.csv").read_text(encoding="utf-8").splitlines()
    kept = [line for line in lines if not line[0].isdigit() or float(line.split(",")[1]) <= 20.0]
    (tmp_path / "finite_element.csv").write_text("\n".join([*kept, ""]), encoding="utf-8")
    text = (MACHINES / "finite_element.toml").read_text(encoding="utf-8")
    without_drive = text.partition("\n[drive]")[0]  # whose currents are beyond 20 A
    (tmp_path / "finite_element.toml").write_text(without_drive, encoding="utf-8")
    magnetics = load_machine(tmp_path / "finite_element.toml").magnetics
    half_rad = magnetics.pitch_rad / 2.0
    angle_rad = half_rad + half_rad * np.linspace(0.0, 1.0, 100)[:, None]
    assert magnetics.current_max_A == 20.0
    assert np.min(np.diff(magnetics.torque_Nm(angle_rad, CURRENT_A), axis=1)) < -1.0, "no loss to level"
    torque = phase_map(magnetics).torque_per_ampere.node * CURRENT_A  # N m, in LSB
    assert np.all(np.diff(torque, axis=1) >= -0.5 * (CURRENT_A[1:] + CURRENT_A[:-1])), "beyond rounding of T / i"
    assert differences(magnetics, 18.0)[0] < 0.02


def test_flux_linkage_beyond_its_format_is_an_error_that_names_the_file(tmp_path):
    text = (MACHINES / "linear_cosine.toml").read_text(encoding="utf-8")
    path = tmp_path / "inductive.toml"
    path.write_text(text.replace("23.6e-3", "60e-3"), encoding="utf-8")
    with pytest.raises(MachineError, match=r"inductive\.toml: magnetics: the flux linkage .* it must be below 4 Wb$"):
        machine_phase_map(path, load_machine(path), Exponents())
