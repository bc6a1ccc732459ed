"""Import of tables of flux linkages: layouts, units, corrections and refusals."""

from __future__ import annotations

import io
import math
import re

import numpy as np
import pytest
from scipy.io import savemat

from salient.experiments.compare.random_maps import random_map
from salient.machine.file import load_machine
from salient.machine.flux_map import ORIGIN_ERRORS, ORIGIN_TOLERANCE_RAD, FluxMapError
from salient.machine.flux_map_csv import map_of_text
from salient.machine.flux_map_origin import find_origin
from salient.machine.map_import.command import map_text, read_points
from salient.machine.map_import.correct import Imported, Supply, correct
from salient.machine.map_import.layouts import Points, points_of
from salient.machine.map_import.mat import mat_points
from salient.machine.map_import.text import blocks, decode
from salient.machine.report import describe
from salient.paths import MACHINES

TRUTH = load_machine(MACHINES / "finite_element.toml").magnetics
POLES, PHASES, PITCH_DEG = 6, 4, 60.0
SUPPLY = Supply(240.0, 0.096)
ANGLES_DEG = np.arange(0.0, 61.0)
CURRENTS_A = np.arange(5.0, 81.0, 5.0)


def flux(angles_deg=ANGLES_DEG, currents_A=CURRENTS_A, shift_deg: float = 0.0) -> np.ndarray:
    return TRUTH.flux_linkage_Wb(np.radians(np.asarray(angles_deg) - shift_deg)[:, None], currents_A)


def long_table(values: np.ndarray, header: str = "angle_deg,current_A,flux_linkage_Wb", separator: str = ",") -> str:
    rows = [separator.join(f"{value:.9g}" for value in (angle, current, psi))
            for angle, fluxes in zip(ANGLES_DEG, values, strict=True)
            for current, psi in zip(CURRENTS_A, fluxes, strict=True)]
    return "\n".join(([header] if header else []) + rows) + "\n"


def matrix(values: np.ndarray, corner: str, separator: str = ",") -> str:
    rows = [[corner, *(f"{current:g}" for current in CURRENTS_A)],
            *([f"{angle:g}", *(f"{psi:.9g}" for psi in fluxes)]
              for angle, fluxes in zip(ANGLES_DEG, values, strict=True))]
    return "\n".join(separator.join(row) for row in rows) + "\n"


def imported(text: str) -> Imported:
    return correct(points_of(blocks(text)), POLES, PHASES, SUPPLY)


def deviation(of: Imported) -> float:
    """Largest difference from the truth, of its largest flux linkage."""
    expected = flux(of.angle_deg, of.current_A)
    return float(np.max(np.abs(of.flux_Wb - expected)) / np.max(expected))


def origin_of(of: Imported) -> tuple[float, float]:
    found = re.search(r"aligned at (\S+) \+- (\S+) deg", "\n".join(of.lines))
    return float(found[1]), float(found[2])


VALUES = flux(shift_deg=0.5)
MAXWELL = "\n".join([
    ",".join(f"\"Moving1.Position [deg]\",\"FluxLinkage(A) [mWb] - I_aa='{current:g}A'\"" for current in CURRENTS_A),
    *(",".join(f"{angle:g},{1e3 * psi:.9g}" for psi in fluxes)
      for angle, fluxes in zip(ANGLES_DEG, VALUES, strict=True))])
FEMM = "\n".join(f"--> {angle:g}\t{current:g}\t{0.7 * current:.9g}\t{psi:.9g}"
                 for angle, fluxes in zip(ANGLES_DEG, VALUES, strict=True)
                 for current, psi in zip(CURRENTS_A, fluxes, strict=True))
LAYOUTS = {
    "long table": long_table(VALUES),
    "without a header, blanks": long_table(VALUES, "", " "),
    "decimal comma": long_table(VALUES, "Winkel [deg];Strom [A];Fluss [Wb]", ";").replace(".", ","),
    "tabs, mA and mWb": "theta (deg)\tI (mA)\tpsi (mWb)\n" + "\n".join(
        f"{angle:g}\t{1e3 * current:g}\t{1e3 * psi:.9g}" for angle, fluxes in zip(ANGLES_DEG, VALUES, strict=True)
        for current, psi in zip(CURRENTS_A, fluxes, strict=True)),
    "matrix, currents across": matrix(VALUES, ""),
    "field solver's columns": MAXWELL,
    "field solver's console": FEMM,
    "currents down the rows": "current_A," + ",".join(f"{angle:g}" for angle in ANGLES_DEG) + "\n" + "\n".join(
        ",".join(f"{value:.9g}" for value in (current, *fluxes))
        for current, fluxes in zip(CURRENTS_A, VALUES.T, strict=True)),
    "numbers alone, currents across": matrix(VALUES, "0"),
    "field solver's long table with time": "\"Time [s]\",\"Angle [deg]\",\"Current [A]\",\"FluxLinkage [Wb]\"\n"
        + "\n".join(f"{1e-3 * angle:.9g},{angle:g},{current:g},{psi:.9g}"
                    for angle, fluxes in zip(ANGLES_DEG, VALUES, strict=True)
                    for current, psi in zip(CURRENTS_A, fluxes, strict=True)),
    "mA and mWb without units": "angle,current,flux\n" + "\n".join(
        f"{angle:g},{1e3 * current:g},{1e3 * psi:.9g}" for angle, fluxes in zip(ANGLES_DEG, VALUES, strict=True)
        for current, psi in zip(CURRENTS_A, fluxes, strict=True)),
    "remarks behind the rows": long_table(VALUES).replace("\n", " # of the bench\n"),
    "currents in the names of the columns": matrix(VALUES, "theta").replace(
        ",".join(f"{current:g}" for current in CURRENTS_A), ",".join(f"psi_{current:g}A" for current in CURRENTS_A)),
    "numbers in the names of the columns": matrix(VALUES, "theta").replace(
        ",".join(f"{current:g}" for current in CURRENTS_A), ",".join(f"Flux({current:g})" for current in CURRENTS_A)),
    "units below the currents": matrix(VALUES, "Angle").replace(
        "\n", "\n[deg]," + ",".join("[Wb]" for _ in CURRENTS_A) + "\n", 1),
    "blocks by angle under comments": "\n\n".join(f"# theta = {angle:g} deg\n" + "\n".join(
        f"{current:g} {psi:.9g}" for current, psi in zip(CURRENTS_A, fluxes, strict=True))
        for angle, fluxes in zip(ANGLES_DEG, VALUES, strict=True)),
    "revolutions": "angle [rev],current [A],flux [Wb]\n" + "\n".join(
        f"{angle / 360.0:.9g},{current:g},{psi:.9g}" for angle, fluxes in zip(ANGLES_DEG, VALUES, strict=True)
        for current, psi in zip(CURRENTS_A, fluxes, strict=True)),
    "thousands grouped, decimal points": "angle [deg];current [mA];flux [Wb]\n" + "\n".join(
        f"{angle:g};{1e3 * current:,.0f};{psi:.9g}" for angle, fluxes in zip(ANGLES_DEG, VALUES, strict=True)
        for current, psi in zip(CURRENTS_A, fluxes, strict=True)),
    "electrical radians": "theta_elec_rad,current_A,flux_Wb\n" + "\n".join(
        f"{math.radians(POLES * angle):.9g},{current:g},{psi:.9g}"
        for angle, fluxes in zip(ANGLES_DEG, VALUES, strict=True)
        for current, psi in zip(CURRENTS_A, fluxes, strict=True)),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layout_is_found_and_its_origin_shifted(layout):
    result = imported(LAYOUTS[layout])
    aligned_deg, error_deg = origin_of(result)
    assert abs(aligned_deg - 0.5) <= error_deg + 0.001 and error_deg < 0.1
    assert deviation(result) < 5e-3
    map_of_text(map_text(result, "table", 8, POLES), POLES)


@pytest.mark.parametrize("shift_deg", [-2.0, -0.7, 0.0, 1.3, 2.0, 30.0, 47.0])
def test_any_origin_is_stated_within_its_own_error(shift_deg):
    result = imported(long_table(flux(shift_deg=shift_deg)))
    aligned_deg, error_deg = origin_of(result)
    assert abs(math.remainder(aligned_deg - shift_deg, PITCH_DEG)) <= error_deg + 0.001 and error_deg < 0.1
    assert deviation(result) < 5e-3


def test_phases_that_differ_are_averaged_and_their_spread_stated():
    text = "".join(f"phase {name}\n" + long_table(factor * flux(shift_deg=0.5 + 15.0 * number))
                   for number, (name, factor) in enumerate({"A": 0.97, "B": 1.0, "C": 1.03}.items()))
    result = imported(text)
    assert deviation(result) < 5e-3
    spread = next(line for line in result.lines if line.startswith("spread"))
    assert float(re.search(r"up to ([\d.]+) %", spread)[1]) == pytest.approx(100.0 * 0.06 / 1.03, abs=0.3)


def test_halves_that_differ_are_no_shift():
    """Even sums alone put the aligned position 0.4 deg off, which costs twice the torque ripple."""
    higher = 1.0 + 0.03 * np.sin(np.radians(POLES * ANGLES_DEG))[:, None]
    result = imported(long_table(higher * flux()))
    assert abs(origin_of(result)[0]) < 0.02
    assert deviation(result) < 5e-3
    asymmetry = next(line for line in result.lines if line.startswith("asymmetry"))
    assert 1.0 < float(re.search(r"up to ([\d.]+) %", asymmetry)[1]) < 6.0


def test_mat_file_is_read_and_that_of_version_7_3_is_refused_in_a_line():
    file = io.BytesIO()
    savemat(file, {"RotorAngles": ANGLES_DEG, "StatorCurrents": CURRENTS_A, "FTBL": VALUES.T})
    points: Points = mat_points(file.getvalue())
    assert deviation(correct(points, POLES, PHASES, SUPPLY)) < 5e-3
    with pytest.raises(FluxMapError, match=r"7\.3.*-v7"):
        mat_points(b"MATLAB 7.3 MAT-file")


MATRICES = {
    "of unknown names": {"x": ANGLES_DEG, "y": CURRENTS_A, "z": VALUES},
    "with currents down": {"pos": np.radians(ANGLES_DEG), "cur": CURRENTS_A, "lambda_mWb": 1e3 * VALUES.T},
    "of a mesh grid": {"TH": np.repeat(ANGLES_DEG[:, None], len(CURRENTS_A), 1), "PSI": VALUES,
                       "II": np.repeat(CURRENTS_A[None], len(ANGLES_DEG), 0)},
}


@pytest.mark.parametrize("version", ["4", "5", "Octave"])
@pytest.mark.parametrize("arrays", MATRICES)
def test_matrices_are_read_from_files_of_all_versions(tmp_path, arrays, version):
    path = tmp_path / "table.mat"
    if version == "Octave":
        path.write_text("# Created by Octave 6.2.0\n" + "\n\n".join(
            f"# name: {name}\n# type: matrix\n# rows: {len(array)}\n# columns: {array.shape[1]}\n" + "\n".join(
                " ".join(f"{value:.12g}" for value in row) for row in array)
            for name, array in ((name, np.atleast_2d(of)) for name, of in MATRICES[arrays].items())))
    else:
        savemat(path, MATRICES[arrays], format=version)
    assert deviation(correct(read_points(path), POLES, PHASES, SUPPLY)) < 5e-3


@pytest.mark.parametrize("names", ["Flux_{}", "case {}", "psi{}"])
def test_columns_that_are_only_counted_are_refused(names):
    """Their first row was taken for the currents."""
    head = ",".join(names.format(number + 1) for number in range(len(CURRENTS_A)))
    with pytest.raises(FluxMapError, match=r"line 2: the header above it.* does not name .*'I=5A'"):
        imported(matrix(VALUES, "theta").replace(",".join(f"{current:g}" for current in CURRENTS_A), head))


@pytest.mark.parametrize(("name", "data", "way"), [
    ("a.xlsx", b"PK\3\4" + bytes(range(256)), "a spreadsheet.*save the table as CSV"),
    ("a.xls", b"\xd0\xcf\x11\xe0" + bytes(300), "a spreadsheet.*save the table as CSV"),
    ("a.npy", b"\x93NUMPY" + bytes(300), r"an array of NumPy.*numpy\.savetxt"),
])
def test_file_that_is_no_text_says_what_it_is(tmp_path, name, data, way):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(FluxMapError, match=way):
        read_points(tmp_path / name)


def test_dip_is_refused_with_its_line():
    values = flux()
    values[0:4] *= 1.0 - 0.17 * np.array([1.0, 0.8, 0.5, 0.2])[:, None]
    with pytest.raises(FluxMapError, match=r"^line \d+"):
        imported(long_table(values))


@pytest.mark.parametrize("row", [0, 4, 9, 14])
@pytest.mark.parametrize("rows", [1, 3])
@pytest.mark.parametrize("pitches", [0.5, 1.0])
def test_dip_on_a_flank_is_refused_with_its_line(pitches, rows, row):
    """A curve that falls there by itself stays monotonic."""
    angles_deg = np.arange(0.0, PITCH_DEG * pitches + 1.0)
    values = flux(angles_deg)
    values[row : row + rows] *= 0.83
    text = "\n".join(f"{angle:.9g},{current:.9g},{psi:.9g}" for angle, fluxes in zip(angles_deg, values, strict=True)
                     for current, psi in zip(CURRENTS_A, fluxes, strict=True))
    with pytest.raises(FluxMapError, match=r"^line \d+"):
        imported(f"angle_deg,current_A,flux_linkage_Wb\n{text}\n")


@pytest.mark.parametrize("form", ["mH", "H", "a matrix in mH", "MAT"])
def test_inductances_are_multiplied_by_their_current(form):
    inductances = VALUES / CURRENTS_A
    if form == "MAT":
        file = io.BytesIO()
        savemat(file, {"theta_deg": ANGLES_DEG, "i_A": CURRENTS_A, "L_H": inductances})
        result = correct(mat_points(file.getvalue()), POLES, PHASES, SUPPLY)
    elif form == "a matrix in mH":
        result = imported(matrix(1e3 * inductances, "L [mH] angle [deg] \\ current [A]"))
    else:
        result = imported(long_table((1e3 if form == "mH" else 1.0) * inductances, f"angle_deg,current_A,L_{form}"))
    assert deviation(result) < 5e-3
    assert "inductance times current" in result.lines[0]


def test_matrix_of_inductances_without_named_axes_is_refused():
    with pytest.raises(FluxMapError, match="whose corner does not name"):
        imported(matrix(1e3 * VALUES / CURRENTS_A, "L [mH]"))


@pytest.mark.parametrize("title", ["Torque [Nm]", "Coenergy [J]"])
@pytest.mark.parametrize("is_first", [True, False])
def test_table_of_another_quantity_beside_is_left_out_and_that_is_stated(title, is_first):
    of_flux, other = matrix(VALUES, "Flux linkage [Wb]"), matrix(VALUES**2, title)
    result = imported("\n".join([other, of_flux] if is_first else [of_flux, other]))
    assert deviation(result) < 5e-3
    assert any(line.startswith("left out: 1 tables") for line in result.lines)


@pytest.mark.parametrize("quantity", ["coenergy_J", "torque_Nm", "differential_inductance_H"])
def test_table_without_flux_linkages_is_refused_by_its_columns(quantity):
    with pytest.raises(FluxMapError, match=rf"line 2: the columns .*{quantity}.* have no flux linkage"):
        imported(long_table(VALUES, f"angle_deg,current_A,{quantity}"))


@pytest.mark.parametrize("shift_deg", [0.0, 0.5, 1.0, 2.0])
def test_half_a_pitch_is_shifted_where_its_points_show_it_and_else_kept_or_refused(shift_deg):
    """From aligned it shows the shift; from unaligned, with the peak outside, it does not."""
    angles_deg = np.arange(0.0, PITCH_DEG / 2.0 + 0.1, 2.0 / 3.0)
    for first_deg in (0.0, PITCH_DEG / 2.0):
        at_deg = angles_deg + first_deg
        text = "\n".join(f"{angle:.9g},{current:.9g},{psi:.9g}"
                         for angle, fluxes in zip(at_deg, flux(at_deg, shift_deg=shift_deg), strict=True)
                         for current, psi in zip(CURRENTS_A, fluxes, strict=True))
        text = f"angle_deg,current_A,flux_linkage_Wb\n{text}\n"
        if first_deg and shift_deg == 2.0:
            with pytest.raises(FluxMapError, match="do not tell where the poles are aligned"):
                imported(text)
            continue
        result = imported(text)
        aligned_deg, error_deg = origin_of(result)
        assert abs(math.remainder(aligned_deg - shift_deg, PITCH_DEG)) <= max(error_deg, 0.1)
        kept = any("kept: half a pitch" in line for line in result.lines)
        assert kept == (first_deg > 0.0 or shift_deg == 0.0) and (kept or deviation(result) < 5e-3)


def test_direct_map_of_half_a_pitch_with_another_origin_is_refused_and_names_the_import():
    saturating = load_machine(MACHINES / "saturating.toml").magnetics
    rows = [f"{angle:g},{current:g},{float(saturating.flux_linkage_Wb(math.radians(angle - 1.0), current)):.9g}"
            for angle in range(46) for current in range(5, 101, 5)]
    with pytest.raises(FluxMapError, match="--import") as refusal:
        map_of_text("\n".join(["angle_deg,current_A,flux_linkage_Wb", *rows]), 4)
    aligned_deg, error_deg = map(float, re.search(r"about (\S+) \+- (\S+) deg", str(refusal.value)).groups())
    assert abs(aligned_deg - 1.0) <= error_deg < 0.5


@pytest.mark.parametrize("every", [4, 6, 8])
def test_coarse_half_pitch_of_narrow_poles_keeps_its_origin_within_its_own_error(every):
    """Corners where poles begin to overlap look like a shift where few points are between them and the end."""
    for number in range(30):
        rows = np.array([row.split(",") for row in random_map(number)[1].split()[1:]], dtype=float)
        values = rows[:, 2].reshape(97, -1)[::every]
        origin = find_origin(np.linspace(0.0, math.pi, len(values)), values)
        assert abs(origin.aligned_rad) <= max(ORIGIN_TOLERANCE_RAD, ORIGIN_ERRORS * origin.error_rad), number


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "cp1252"])
def test_text_of_a_spreadsheet_is_decoded(encoding):
    text = long_table(VALUES, "Winkel [\u00b0];Strom [A];Fluss [Wb]", ";")
    assert decode(text.encode(encoding)) == text
    assert origin_of(imported(decode(text.encode(encoding))))[0] == pytest.approx(0.5, abs=0.05)


def test_one_command_imports_and_the_next_describes_the_written_machine(salient_without_build, tmp_path):
    (tmp_path / "table.csv").write_text(long_table(VALUES), encoding="utf-8")
    done = salient_without_build("machine", MACHINES / "finite_element.toml", "--import", tmp_path / "table.csv",
                                 "--out", tmp_path / "new")
    assert done.returncode == 0, done.stderr
    assert "origin: aligned at 0.500" in done.stdout and "asymmetry: " in done.stdout
    written = tmp_path / "new" / "finite_element.toml"
    assert str(written) in done.stdout
    again = salient_without_build("machine", written, "--out", tmp_path / "view")
    assert again.returncode == 0, again.stderr
    assert "8/6 poles, 4 phases, magnetics map" in again.stdout and "imported" not in again.stdout
    angles_rad, currents_A = np.radians(np.arange(31.0))[:, None], CURRENTS_A
    given = TRUTH.flux_linkage_Wb(angles_rad, currents_A)
    assert np.max(np.abs(load_machine(written).magnetics.flux_linkage_Wb(angles_rad, currents_A) - given)) < (
        5e-3 * np.max(given))


def test_saturation_of_a_machine_is_stated():
    """2 mH of 23.6 mH at the least; a linear machine has none."""
    assert "; no saturation" in "\n".join(describe(load_machine(MACHINES / "linear_cosine.toml")))
    machine = load_machine(MACHINES / "saturating.toml")
    found = re.search(r"saturation leaves (\d+) % aligned at (\S+) A", "\n".join(describe(machine)))
    at_A = float(found[2])
    left = float(machine.magnetics.flux_linkage_Wb(0.0, at_A)) / at_A / 23.6e-3
    assert float(found[1]) == pytest.approx(100.0 * left, abs=0.6) and left < 0.9


def test_halves_that_differ_are_named_by_angles_of_the_file():
    angles_deg = np.linspace(0.0, 60.0, 38)
    factor = np.where(angles_deg > 30.0, 1.05, 1.0)[:, None]
    rows = [f"{angle:.9g},{current:g},{psi:.9g}"
            for angle, fluxes in zip(angles_deg, factor * flux(angles_deg), strict=True)
            for current, psi in zip(CURRENTS_A, fluxes, strict=True)]
    with pytest.raises(FluxMapError, match="--import") as refusal:
        map_of_text("\n".join(["angle_deg,current_A,flux_linkage_Wb", *rows]), POLES)
    named = [float(angle) for angle in re.findall(r"line \d+ \((\S+) deg\)", str(refusal.value))]
    assert len(named) == 2 and all(np.min(np.abs(angles_deg - angle)) < 1e-3 for angle in named)
