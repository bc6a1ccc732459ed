"""Machines by a flux-linkage map: from the CSV file to the emulator.

Maps are sampled from the bundled formulas, so that the error of the model can be measured. Saturating machine to
100 A, 20 x 20 points, relative to the maximum value (regular grid; irregular grid): flux linkage
1.3e-4; 8.2e-5, torque 5.3e-6; 2.6e-4. The plant with such a map against SciPy's DOP853: at most 9e-7 of the range;
energy balance while chopping: 5e-8 of the energy drawn.
"""

from __future__ import annotations

import ctypes
import math
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from flux_map_files import (
    CURRENT_MAX_A,
    HALF_DEG,
    REGULAR_A,
    REGULAR_DEG,
    csv_text,
    formula,
    irregular,
    rows,
    write_machine,
)
from flux_map_reference import MapReference
from reference_plant import MAP, Machine, Magnetics, flux_map_of, load_library, run_plant, run_reference
from test_plant_against_scipy import chopping_stroke, deviation, machine_of, single_pulse

from salient.machine.file import MachineError, load_machine
from salient.machine.flux_map import FluxMap
from salient.machine.flux_map_csv import load_flux_map
from salient.paths import MACHINES

POLES = 4
GRIDS = {"regular": (REGULAR_DEG, REGULAR_A), "irregular": irregular()}


def load(folder: Path, text: str | bytes) -> FluxMap:
    magnetics = load_machine(write_machine(folder, "map_under_test", text)).magnetics
    assert isinstance(magnetics, FluxMap)
    return magnetics


@pytest.fixture(scope="module", params=GRIDS)
def sampled(request, tmp_path_factory) -> tuple[str, FluxMap]:
    """The saturating formula by a map of 20 x 20 points, on a regular or on an irregular grid."""
    points = rows(formula("saturating"), *GRIDS[request.param])
    assert len(points) == 400
    return request.param, load(tmp_path_factory.mktemp("map"), csv_text(points))


# --- The model ---


def worst(flux_map: FluxMap, name: str, up_to_A: float) -> tuple[float, float]:
    """Largest deviation of flux linkage and of torque from a formula, relative to the maximum values of the formula."""
    angle_rad = np.radians(np.linspace(0.0, 2.0 * HALF_DEG, 721))[:, None]
    current_A = np.linspace(0.0, up_to_A, 301)
    deviations = []
    for method in ("flux_linkage_Wb", "torque_Nm"):
        expected = getattr(formula(name), method)(angle_rad, current_A)
        measured = getattr(flux_map, method)(angle_rad, current_A)
        deviations.append(float(np.max(np.abs(measured - expected)) / np.max(np.abs(expected))))
    return deviations[0], deviations[1]


@pytest.mark.in_turns
def test_map_of_the_saturating_formula_reproduces_the_formula(sampled):
    grid, flux_map = sampled
    flux, torque = worst(flux_map, "saturating", CURRENT_MAX_A)
    print(f"{grid}: flux linkage {flux:.2g}, torque {torque:.2g} of the maximum")
    flux_bound, torque_bound = {"regular": (2e-4, 1e-5), "irregular": (2e-4, 5e-4)}[grid]
    assert 1e-6 < flux < flux_bound
    assert 1e-7 < torque < torque_bound
    assert flux_map.unaligned_inductance_H == pytest.approx(formula("saturating").unaligned_inductance_H, rel=1e-5)
    # Every angle has points up to this current, so nothing is extrapolated below it.
    reached_A = np.broadcast_to(GRIDS[grid][1], (20, 20))[:, -1]
    assert flux_map.current_max_A == pytest.approx(min(reached_A), rel=1e-9)


@pytest.mark.in_turns
def test_finer_maps_converge_to_the_formula(tmp_path):
    deviations = []
    for count in (10, 20, 40):
        angles_deg = np.linspace(0.0, HALF_DEG, count + 1)
        currents_A = np.linspace(CURRENT_MAX_A / count, CURRENT_MAX_A, count)
        flux_map = load(tmp_path, csv_text(rows(formula("linear_cosine"), angles_deg, currents_A)))
        deviations.append(worst(flux_map, "linear_cosine", CURRENT_MAX_A)[1])
    assert deviations[0] > 4.0 * deviations[1] > 16.0 * deviations[2], deviations
    assert deviations[2] < 1e-5


def test_map_with_sharp_corners_does_not_ring(tmp_path):
    """The trapezoid's torque jumps within 2 degrees; 2.4 degrees between the points are too coarse for it, but between
    the corners the torque stays near its plateau, and its sign is right everywhere."""
    magnetics = formula("linear_trapezoid")
    flux_map = load(tmp_path, csv_text(rows(magnetics, REGULAR_DEG, REGULAR_A)))
    torque_Nm = -flux_map.torque_Nm(np.radians(np.linspace(0.0, HALF_DEG, 901)), 20.0)
    plateau_Nm = -float(magnetics.torque_Nm(math.radians(22.5), 20.0))
    assert torque_Nm.min() > -2e-3 * plateau_Nm
    assert torque_Nm.max() < 1.15 * plateau_Nm
    middle_Nm = torque_Nm[200:700]  # 10 to 35 degrees
    assert np.all(np.abs(middle_Nm / plateau_Nm - 1.0) < 0.02)


def test_noise_on_the_map_is_not_amplified(tmp_path):
    """0.2 % of noise on every point of a coarse irregular map gives about 0.4 % of the aligned flux linkage in the
    model from the first current (3 A) on, and about 1 % of the torque."""
    rng = np.random.default_rng(3)
    angles_deg, currents_A = irregular(12, 10)
    points = rows(formula("saturating"), angles_deg, currents_A)
    noisy = [(angle, current, flux * (1.0 + 0.002 * rng.uniform(-1.0, 1.0))) for angle, current, flux in points]
    clean, rough = load(tmp_path, csv_text(points)), load(tmp_path, csv_text(noisy))
    angle_rad, current_A = np.radians(np.linspace(0.0, HALF_DEG, 181))[:, None], np.linspace(3.0, CURRENT_MAX_A, 200)
    flux_Wb, torque_Nm = clean.flux_linkage_Wb(angle_rad, current_A), clean.torque_Nm(angle_rad, current_A)
    flux_noise = np.abs(rough.flux_linkage_Wb(angle_rad, current_A) - flux_Wb) / flux_Wb[0]
    torque_noise = np.abs(rough.torque_Nm(angle_rad, current_A) - torque_Nm) / np.max(np.abs(torque_Nm))
    assert 1e-3 < np.max(flux_noise) < 5e-3
    assert 3e-3 < np.max(torque_noise) < 2e-2
    assert rough.inductance_extremes[0] > 0.0


def test_all_derivatives_are_those_of_one_potential(sampled):
    _, flux_map = sampled
    rng = np.random.default_rng(5)
    angle_rad = np.radians(rng.uniform(-HALF_DEG, 3.0 * HALF_DEG, 400))
    current_A = rng.uniform(0.5, 1.3 * CURRENT_MAX_A, 400)
    for by_angle, by_current in [(0, 1), (1, 0), (0, 2), (1, 1), (2, 0), (1, 2), (2, 1)]:
        value = flux_map.derivative(angle_rad, current_A, by_angle, by_current)
        if by_angle > 0:
            turn_rad = 1e-5
            right, left = (
                flux_map.derivative(angle_rad + sign * turn_rad, current_A, by_angle - 1, by_current)
                for sign in (1, -1)
            )
            quotient = (right - left) / (2.0 * turn_rad)
        else:
            more_A = 1e-4
            right, left = (
                flux_map.derivative(angle_rad, current_A + sign * more_A, by_angle, by_current - 1) for sign in (1, -1)
            )
            quotient = (right - left) / (2.0 * more_A)
        assert np.max(np.abs(quotient - value)) < 2e-5 * np.max(np.abs(value)), (by_angle, by_current)


def test_bundled_map_is_met_at_every_point_and_its_torque_has_the_right_sign():
    """The finite elements' points within 1e-4 of the maximum flux linkage (5e-5 measured); torque away from the aligned
    position is at most 1e-3 of the maximum."""
    machine = load_machine(MACHINES / "finite_element.toml")
    flux_map = machine.magnetics
    lines = (MACHINES / "finite_element.csv").read_text(encoding="utf-8").splitlines()
    points = np.array([line.split(",") for line in lines if line[0].isdigit()], dtype=float)
    assert len(points) > 1000
    angle_deg, current_A, flux_Wb = points.T
    miss_Wb = flux_map.flux_linkage_Wb(np.radians(angle_deg), current_A) - flux_Wb
    assert 1e-7 * flux_Wb.max() < np.max(np.abs(miss_Wb)) < 1e-4 * flux_Wb.max()
    to_unaligned_rad = np.linspace(0.0, machine.pitch_rad / 2.0, 601)[:, None]
    torque_Nm = flux_map.torque_Nm(to_unaligned_rad, np.linspace(0.0, flux_map.current_max_A, 81))
    assert torque_Nm.min() < -30.0
    assert torque_Nm.max() < 1e-3 * -torque_Nm.min()


# --- The emulator's kernel ---


@pytest.fixture(scope="module")
def library() -> ctypes.CDLL:
    return load_library()


class Point(ctypes.Structure):
    """magnetics_point_t; orders of the derivative of the co-energy for each member: by angle, by current."""

    ORDERS: ClassVar = {
        "flux_linkage_Wb": (0, 1),
        "incremental_inductance_H": (0, 2),
        "flux_gradient_Wb_rad": (1, 1),
        "torque_Nm": (1, 0),
        "inductance_slope_H_A": (0, 3),
        "inductance_gradient_H_rad": (1, 2),
        "flux_curvature_Wb_rad2": (2, 1),
        "torque_gradient_Nm_rad": (2, 0),
    }
    _fields_ = [(name, ctypes.c_double) for name in ORDERS]


def test_kernel_and_numpy_agree_to_rounding(sampled, library):
    _, flux_map = sampled
    model = ctypes.create_string_buffer(1 << 16)  # includes a magnetics_model_t
    magnetics = Magnetics(form=MAP, map=ctypes.pointer(flux_map_of(flux_map)))
    library.magnetics_prepare(model, ctypes.byref(magnetics), ctypes.c_uint(POLES))
    library.magnetics_coenergy_J.restype = ctypes.c_double
    rng = np.random.default_rng(11)
    angle_rad = np.radians(rng.uniform(-4.0 * HALF_DEG, 4.0 * HALF_DEG, 2000))
    current_A = rng.uniform(-0.5, 1.2 * CURRENT_MAX_A, 2000)
    measured, coenergy_J, point = {name: [] for name in Point.ORDERS}, [], Point()
    for angle, current in zip(angle_rad, current_A, strict=True):
        arguments = (model, ctypes.c_double(angle), ctypes.c_double(current))
        library.magnetics_evaluate(*arguments, ctypes.byref(point))
        coenergy_J.append(library.magnetics_coenergy_J(*arguments))
        for name in Point.ORDERS:
            measured[name].append(getattr(point, name))
    assert np.allclose(coenergy_J, flux_map.coenergy_J(angle_rad, current_A), rtol=1e-12, atol=1e-13)
    for name, orders in Point.ORDERS.items():
        expected = flux_map.derivative(angle_rad, current_A, *orders)
        assert np.max(np.abs(expected)) > 0.0
        # Second derivative by the angle: rounding of differences that are 1e-4 of the co-energy.
        bound = 4e-12 if orders[0] == 2 else 1e-12
        assert np.max(np.abs(np.array(measured[name]) - expected)) < bound * np.max(np.abs(expected)), name


# --- The plant ---


def plant_machine(flux_map: FluxMap) -> Machine:
    machine = machine_of("saturating")
    machine.magnetics = Magnetics(
        form=MAP,
        unaligned_inductance_H=flux_map.unaligned_inductance_H,
        map=ctypes.pointer(flux_map_of(flux_map)),
    )
    return machine


@pytest.mark.in_turns
@pytest.mark.parametrize("stroke", [chopping_stroke, single_pulse])
def test_plant_agrees_with_an_independent_integration(sampled, library, stroke):
    _, flux_map = sampled
    machine, run = plant_machine(flux_map), stroke()
    expected, ends = run_reference(machine, run, reference=MapReference(machine, flux_map))
    measured, _ = run_plant(library, machine, run)
    assert np.max(expected["currents"]) > 10.0
    assert len(ends) >= 1
    deviations = deviation(measured, expected)
    print(deviations)
    assert max(deviations.values()) < 4e-6, deviations


def test_energy_balance_closes_while_chopping(sampled, library):
    _, flux_map = sampled
    machine, run = plant_machine(flux_map), chopping_stroke()
    _, state = run_plant(library, machine, run)
    stored_J = state.field_energy_J + state.kinetic_energy_J - machine.inertia_kg_m2 * run.speed_rad_s**2 / 2
    spent_J = state.energy_copper_J + state.energy_load_J + state.energy_friction_J
    missing_J = state.energy_drawn_J - state.energy_returned_J - spent_J - stored_J
    print(f"{missing_J} J of {state.energy_drawn_J} J")
    assert state.energy_drawn_J > 1.0
    assert state.energy_returned_J > 0.1
    assert abs(missing_J) < 3e-7 * state.energy_drawn_J


# --- The file ---

GOOD = csv_text(rows(formula("saturating"), REGULAR_DEG, REGULAR_A))


def test_units_line_endings_comments_and_a_byte_order_mark_give_the_same_map(tmp_path):
    points = rows(formula("saturating"), REGULAR_DEG, REGULAR_A)
    expected = load(tmp_path, GOOD)
    lines = [f"{math.radians(angle)!r},{current!r},{1000.0 * flux!r}" for angle, current, flux in points]
    for at in range(len(lines) - 20, -1, -20):
        lines.insert(at, f"{lines[at].split(',')[0]},0,0")
    text = "\ufeff# a bench\r\n\r\nangle_rad, current_A ,flux_linkage_mWb\r\n# points\r\n" + "\r\n\r\n".join(lines)
    assert np.allclose(load(tmp_path, text.encode()).coefficients_J, expected.coefficients_J, rtol=1e-9, atol=1e-12)


def test_map_over_a_whole_pitch_is_averaged_with_its_mirror_image(tmp_path):
    """Opposite errors of half a percent on the two sides cancel."""
    magnetics = formula("saturating")
    whole_deg = np.concatenate([REGULAR_DEG, 2.0 * HALF_DEG - REGULAR_DEG[-2::-1]])
    even = rows(magnetics, whole_deg, REGULAR_A)
    uneven = [
        (angle, current, flux * (1.0 + 0.005 * math.sin(math.pi * angle / HALF_DEG))) for angle, current, flux in even
    ]
    expected = load(tmp_path, GOOD)
    angle_rad, current_A = np.radians(np.linspace(0.0, HALF_DEG, 91))[:, None], np.linspace(1.0, CURRENT_MAX_A, 50)
    for points in (even, uneven):
        flux_map = load(tmp_path, csv_text(points))
        difference_Wb = flux_map.flux_linkage_Wb(angle_rad, current_A) - expected.flux_linkage_Wb(angle_rad, current_A)
        assert np.max(np.abs(difference_Wb)) < 1e-9


def edited(line: int, text: str | None) -> str:
    """The valid file with another text in a line (1 is the header), or without the line."""
    lines = GOOD.split("\n")
    lines[line - 1 : line] = [] if text is None else [text]
    return "\n".join(lines)


def scaled(line: int, factor: float) -> str:
    """The valid file with the flux linkage of one line multiplied by a factor."""
    angle, current, flux = GOOD.split("\n")[line - 1].split(",")
    return edited(line, f"{angle},{current},{float(flux) * factor!r}")


def sampled_file(angles_deg, currents_A, change=lambda angle, current, flux: flux) -> str:
    points = rows(formula("saturating"), angles_deg, currents_A)
    return csv_text([(angle, current, change(angle, current, flux)) for angle, current, flux in points])


def aligned_Wb(current_A: float) -> float:
    return float(formula("saturating").flux_linkage_Wb(0.0, current_A))


REJECTED = {
    "not UTF-8": (GOOD.encode()[:50] + b"\xff" + GOOD.encode()[50:], ["not UTF-8 at byte 51"]),
    "too large": (b"#" * 20_000_001, ["larger than 20 MB"]),
    "empty": ("", ["no header", "angle_deg|angle_rad,current_A,flux_linkage_Wb|flux_linkage_mWb"]),
    "other columns": (edited(1, "angle_deg,current_A,torque_Nm"),
                      ["line 1:", "the header must be", "flux_linkage_mWb"]),
    "other unit": (edited(1, "angle_deg,current_mA,flux_linkage_Wb"), ["line 1:", "current_mA", "current_A"]),
    "no header": (edited(1, "# nothing"), ["line 2:", "the header must be"]),
    "two columns": (edited(5, "0,20"), ["line 5:", "2 columns", "3"]),
    "decimal comma": (edited(5, "0,0,20,0,0,2"), ["line 5:", "6 columns"]),
    "not a number": (edited(7, "0,30,much"), ["line 7:", "flux_linkage_Wb", "'much'", "must be a finite number"]),
    "nan": (edited(7, "0,30,nan"), ["line 7:", "'nan'", "must be a finite number"]),
    "infinite": (edited(7, "0,1e999,0.3"), ["line 7:", "current_A", "must be a finite number"]),
    "negative current": (edited(3, "0,-10,0.1"), ["line 3:", "current_A", "negative"]),
    "negative flux linkage": (edited(3, "0,10,-0.1"), ["line 3:", "flux_linkage_Wb", "negative"]),
    "negative angle": (edited(2, "-1,5,0.1"), ["line 2:", "angle_deg", "negative"]),
    "angles fall": (edited(42, "1,5,0.1"), ["line 42:", "2.3684", "1 deg", "must rise"]),
    "angles do not rise enough": (edited(42, "2.37,5,0.1"), ["line 42:", "must rise", "0.02 deg"]),
    "first angle missing": (sampled_file(REGULAR_DEG[1:], REGULAR_A), ["line 2:", "begin at 2.3684 deg", "aligned"]),
    "last angle missing": (sampled_file(REGULAR_DEG[:-1], REGULAR_A), ["line 381:", "end at 42.632", "45 deg", "90"]),
    "beyond the pitch": (sampled_file([*REGULAR_DEG, 91.0], REGULAR_A), ["line 421:", "end at 91", "90 deg"]),
    "seven angles": (sampled_file(np.linspace(0, 45, 7), REGULAR_A), ["7 angles", "8"]),
    "five currents": (sampled_file(REGULAR_DEG, REGULAR_A[3::4]), ["line 6:", "5 currents", "6"]),
    "currents fall": (edited(4, "0,9,0.2"), ["line 4:", "9 A comes after 10 A", "must rise"]),
    "a current twice": (edited(4, GOOD.split("\n")[2]), ["line 4:", "must rise"]),
    "flux linkage falls": (scaled(5, 0.5), ["line 5:", "at 20 A", "must rise"]),
    "flux linkage stays": (edited(21, "0,100," + GOOD.split("\n")[19].split(",")[2]), ["line 21:", "must rise"]),
    "flux linkage at 0 A": (edited(2, "0,0,0.01"), ["line 2:", "at 0 A", "0.01 Wb", "must be 0"]),
    "0 A later": (edited(3, "0,0,0"), ["line 3:", "must rise"]),
    "too few amperes at an angle": (
        sampled_file(REGULAR_DEG, [REGULAR_A * (0.8 if at == 4 else 1.0) for at in range(20)]),
        ["line 101:", "end at 80 A", "100 A", "10%"],
    ),
    "too many amperes": (sampled_file(REGULAR_DEG, 200 * REGULAR_A), ["line 12:", "11000 A", "10000 A"]),
    "milliwebers as webers": (sampled_file(REGULAR_DEG, REGULAR_A, lambda _, __, flux: 1e3 * flux), ["100 Wb"]),
    "0 degrees unaligned": (
        sampled_file(REGULAR_DEG, REGULAR_A, lambda angle, current, _: float(
            formula("saturating").flux_linkage_Wb(math.radians(HALF_DEG - angle), current))),
        ["must fall", "aligned (0 deg)", "line ", "--import"],
    ),
    "a bump over the angle": (
        sampled_file(REGULAR_DEG, REGULAR_A, lambda angle, _, flux: flux * (1.4 if 20 < angle < 22 else 1.0)),
        ["at 21.316 deg", "at 18.947 deg", "must fall", "line "],
    ),
    "no saliency": (
        sampled_file(REGULAR_DEG, REGULAR_A, lambda _, current, __: 1e-3 * current),
        ["45 deg must be below", "line 382:"],
    ),
    "a slow rise over the angle": (
        sampled_file(REGULAR_DEG, REGULAR_A, lambda angle, current, flux: max(flux, 0.06 * aligned_Wb(current) * (
            1.0 + 0.05 * (angle - 30.0)))),
        ["at 45 deg", "at 40.263 deg", "must fall", "line 38"],
    ),
    "a rise in the second half": (
        sampled_file(
            np.linspace(0, 90, 37), REGULAR_A, lambda angle, _, flux: flux * (0.9 if 79 < angle < 81 else 1.0)
        ),
        ["at 77.5 deg", "at 80 deg", "must fall", "line "],
    ),
    "halves that differ": (
        sampled_file(np.linspace(0, 90, 37), REGULAR_A, lambda angle, _, flux: flux * (1.1 if angle > 45 else 1.0)),
        ["do not mirror", "2%"],
    ),
    "a step over the angle that the model's grid cannot follow": (
        sampled_file(
            sorted([*REGULAR_DEG, 20.0, 20.1]), REGULAR_A, lambda angle, _, flux: flux * (0.5 if angle > 20.05 else 1.0)
        ),
        ["misses this point", "2%", "uneven", "line "],
    ),
    "a step in the current": (
        sampled_file(REGULAR_DEG, REGULAR_A, lambda _, current, flux: 0.2 * (current > 51) + 1e-9 * current + (
            1e-4 * flux)),
        ["gives without saturation", "5% of the map's largest", "inductance of line 2,", "line "],
    ),
    "no rise in the current": (
        sampled_file(REGULAR_DEG, REGULAR_A, lambda _, current, flux: 0.2 * (current > 0) + 1e-9 * current + (
            1e-4 * flux)),
        ["incremental inductance", "uneven", "line "],
    ),
}


@pytest.mark.parametrize("case", REJECTED)
def test_invalid_file_is_rejected_by_one_line_with_the_position(tmp_path, case):
    text, expected_texts = REJECTED[case]
    path = write_machine(tmp_path, "wrong", text)
    with pytest.raises(MachineError) as rejection:
        load_machine(path)
    message = str(rejection.value)
    assert "\n" not in message
    assert message.startswith(f"{tmp_path / 'wrong.csv'}: "), message
    for expected in expected_texts:
        assert expected in message, message


@pytest.mark.parametrize(
    ("old", "new", "expected_texts"),
    [
        ('file = "wrong.csv"\n', "", ["magnetics.file: missing"]),
        ('"wrong.csv"', "7", ["magnetics.file: 7: must be the name of a .csv file"]),
        ('"wrong.csv"', '"wrong.mat"', ["magnetics.file", "'wrong.mat'", ".csv"]),
        ('"wrong.csv"', '"wrong.csv"\nsteps = 3', ["magnetics.steps: unknown key; must be one of form, file"]),
        ('"wrong.csv"', '"none.csv"', ["none.csv: no such file"]),
        ('"wrong.csv"', '"folder.csv"', ["folder.csv: not a file"]),
    ],
)
def test_invalid_key_is_rejected_by_one_line_that_names_it(tmp_path, old, new, expected_texts):
    (tmp_path / "folder.csv").mkdir()
    path = write_machine(tmp_path, "wrong", GOOD, lambda text: text.replace(old, new))
    with pytest.raises(MachineError) as rejection:
        load_machine(path)
    message = str(rejection.value)
    assert "\n" not in message
    for expected in expected_texts:
        assert expected in message, message


def test_map_records_its_file(tmp_path):
    path = write_machine(tmp_path, "here", GOOD)
    assert load_flux_map(tmp_path / "here.csv", POLES).file == load_machine(path).magnetics.file
