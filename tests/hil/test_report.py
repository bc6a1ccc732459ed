"""Pictures, results.json and the report page from made-up recordings: nothing hidden or fetched, equal bytes."""

import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from salient import figures, metrics, report, results

CONTROLLERS = ("traditional", "paper")
CONDITIONS = {
    "control_rate_hz": 40_000,
    "adc": {"bits": 12, "range_A": [0.0, 80.0]},
    "encoder": {"bits": 17},
    "machine": "saturating",
    "torque_sample_step_s": 1e-6,
    "seed": 1,
    "versions": {"salient": "0"},
}

LOSSES = {"window_s": [0.3, 0.4], "input_W": 175.9, "returned_W": 62.1, "copper_W": 45.3, "converter_W": 0.0,
          "friction_W": 4.9, "output_W": 125.7, "stored_W": -0.02, "efficiency_percent": 71.43,
          "phase_current_rms_A": 17.38}


def recording(reference_rpm, ripple_Nm):
    """0.5 s at 1 us: a first-order start, 8 N m from 0.13 s on with a dip, torque with a fast ripple."""
    names = ("speed_rpm", "torque_Nm", "load_torque_Nm", "rotor_angle_deg", "current_a_A", "current_b_A", "current_c_A")
    rows = np.zeros(500_001, dtype=[("time_s", "<f8")] + [(name, "<f4") for name in names])
    time_s = rows["time_s"] = np.arange(len(rows)) * 1e-6
    after_s = np.clip(time_s - 0.13, 0.0, None)
    rows["speed_rpm"] = reference_rpm * (1.0 - np.exp(-time_s / 0.01)) - 500.0 * after_s * np.exp(-after_s / 0.01)
    rows["load_torque_Nm"] = np.where(time_s >= 0.13, 8.0, 0.0)
    rows["torque_Nm"] = rows["load_torque_Nm"] + 0.314 + ripple_Nm * np.sin(2 * np.pi * 9_700.0 * time_s)
    rows["rotor_angle_deg"] = (reference_rpm * 6.0 * time_s) % 360.0
    for phase, name in enumerate(names[-3:]):
        way_deg = (reference_rpm * 6.0 * time_s - 30.0 * phase) % 90.0
        rows[name] = np.where((way_deg > 45.0) & (way_deg < 80.0), 15.0, 0.0)
    return rows


@pytest.fixture(scope="module")
def runs():
    ripple_Nm = {"traditional": 3.0, "paper": 0.3}
    return {
        "start_600": {controller: recording(600.0, ripple_Nm[controller]) for controller in CONTROLLERS},
        "load_step_150": {controller: recording(150.0, ripple_Nm[controller]) for controller in CONTROLLERS},
    }


@pytest.fixture(scope="module")
def made(runs):
    return results.make_results({
        "start_600": {name: metrics.start_metrics(run, 600.0) for name, run in runs["start_600"].items()},
        "load_step_150": {name: metrics.load_step_metrics(run, 150.0, 0.13)
                          for name, run in runs["load_step_150"].items()},
    }, {experiment: dict.fromkeys(CONTROLLERS, LOSSES) for experiment in ("start_600", "load_step_150")}, CONDITIONS)


def draw_all(folder, runs, made):
    folder.mkdir()
    paths = [folder / f"{name}.png" for name in ("figure_5", "figure_6", "figure_7", "phase_currents")]
    ours, paper = made["experiments"], made["paper"]
    figures.draw_start(paths[0], runs["start_600"], ours["start_600"], paper["start_600"])
    step = runs["load_step_150"], ours["load_step_150"], paper["load_step_150"]
    figures.draw_load_step_speed(paths[1], *step)
    figures.draw_load_step_torque(paths[2], *step)
    figures.draw_phase_currents(paths[3], runs["load_step_150"])
    return paths


@pytest.fixture(scope="module")
def pictures(runs, made, tmp_path_factory):
    return draw_all(tmp_path_factory.mktemp("drawn") / "figures", runs, made)


def page(path, made, pictures, files=()):
    captions = report.captions(made)
    report.write_report(path, made, [report.Picture(picture, picture.stem, captions[picture.stem])
                                     for picture in pictures], ["tools/salient demo"], files)
    return path.read_text(encoding="utf-8")


# --- drawing without hiding -------------------------------------------------------------------------------------------

def test_extremes_keep_a_single_sample_spike_wherever_it_is():
    time = np.arange(400_000, dtype=float)
    for spike in (0, 1, 12_345, 399_998, 399_999):
        values = np.zeros(len(time))
        values[spike] = -7.0
        drawn_time, drawn = figures.extremes(time, values)
        assert drawn.min() == -7.0
        assert drawn_time[drawn.argmin()] == spike


def test_extremes_reach_lowest_and_highest_of_every_slice_in_time_order():
    values = np.random.default_rng(1).standard_normal(50_000)
    time, drawn = figures.extremes(np.arange(50_000), values, slices=100)
    assert len(drawn) == 200
    assert np.all(np.diff(time) >= 0)
    slices = values.reshape(100, 500)
    assert np.array_equal(drawn.reshape(100, 2).min(axis=1), slices.min(axis=1))
    assert np.array_equal(drawn.reshape(100, 2).max(axis=1), slices.max(axis=1))


def test_extremes_leave_short_lines_alone():
    values = np.arange(3000.0)
    assert np.array_equal(figures.extremes(values, values)[1], values)


def test_equal_runs_give_equal_pictures(runs, made, pictures, tmp_path):
    for first, again in zip(pictures, draw_all(tmp_path / "again", runs, made), strict=True):
        assert first.read_bytes() == again.read_bytes(), first.name


def test_a_run_that_never_settles_and_never_recovers_is_drawn(runs, made, tmp_path):
    ours = json.loads(json.dumps(made["experiments"]))
    for controller in CONTROLLERS:
        ours["start_600"][controller]["settling_time_s"] = None
        ours["load_step_150"][controller]["recovery_time_s"] = None
    changed = dict(made, experiments=ours)
    text = page(tmp_path / "report.html", changed, draw_all(tmp_path / "figures", runs, changed))
    assert "not in this run" in text


# --- results.json -----------------------------------------------------------------------------------------------------

def test_results_have_the_shape_that_scripts_rely_on(made, tmp_path):
    results.write_results(tmp_path / "results.json", made)
    read = json.loads((tmp_path / "results.json").read_text(encoding="utf-8"))
    assert read["schema"] == 1
    start = ["settling_time_s", "overshoot_percent", "max_speed_rpm"]
    step = ["speed_dip_rpm", "recovery_time_s", "max_speed_rpm", "torque_max_Nm", "torque_min_Nm", "torque_mean_Nm",
            "torque_ripple"]
    for part in ("experiments", "paper"):
        assert list(read[part]) == ["start_600", "load_step_150"]
        for controller in CONTROLLERS:
            assert list(read[part]["start_600"][controller]) == start
            assert list(read[part]["load_step_150"][controller]) == step
    assert read["conditions"] == CONDITIONS


def test_results_quote_the_paper_as_printed():
    assert results.PAPER["load_step_150"]["traditional"]["torque_ripple"] == 0.04295
    assert results.PAPER["load_step_150"]["traditional"]["torque_mean_Nm"] == 8.45
    assert results.PAPER["load_step_150"]["paper"]["torque_ripple"] == 0.0197
    assert results.PAPER["start_600"]["paper"]["settling_time_s"] == 0.07


def test_rounding_keeps_six_digits_and_everything_that_is_no_float():
    given = {"a": 1.23456789e-7, "b": [149.99999999, 3], "c": None, "d": "x", "e": {"f": 0.1 + 0.2}}
    assert results.rounded(given) == {"a": 1.23457e-7, "b": [150.0, 3], "c": None, "d": "x", "e": {"f": 0.3}}


def test_a_figure_that_is_no_number_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        results.write_results(tmp_path / "results.json", {"a": float("nan")})


# --- the page ---------------------------------------------------------------------------------------------------------

class _Reader(HTMLParser):
    """Collects what a page refers to, and checks that its elements nest."""

    VOID = ("meta", "img", "br", "link", "hr")

    def __init__(self):
        super().__init__()
        self.open, self.links, self.images = [], [], []

    def handle_starttag(self, tag, attributes):
        if tag not in self.VOID:
            self.open.append(tag)
        attributes = dict(attributes)
        self.links += [attributes["href"]] if "href" in attributes else []
        self.images += [attributes["src"]] if "src" in attributes else []

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def read_page(text):
    reader = _Reader()
    reader.feed(text)
    assert reader.open == []
    return reader


def test_the_page_holds_its_pictures_and_fetches_nothing(made, pictures, tmp_path):
    text = page(tmp_path / "report.html", made, pictures, [("the figures", [("results.json", "results.json")])])
    reader = read_page(text)
    assert len(reader.images) == len(pictures)
    assert all(image.startswith("data:image/png;base64,") for image in reader.images)
    assert reader.links == ["results.json"]
    assert not re.search(r"https?://|@import|<script|url\(", text)


def test_the_page_has_our_figures_and_the_printed_ones(made, pictures, tmp_path):
    text = page(tmp_path / "report.html", made, pictures)
    for controller in CONTROLLERS:
        assert f"{made['experiments']['load_step_150'][controller]['torque_ripple']:.4f}" in text
    assert "0.04295" in text
    assert "0.0197" in text


def test_the_page_shows_losses_and_the_iron_only_where_it_was_estimated(made, pictures, tmp_path):
    text = page(tmp_path / "without.html", made, pictures)
    assert "<td>71.4</td>" in text and "<td>17.38</td>" in text
    assert "<td>0.0</td>" in text and "<td>-0.0</td>" not in text
    assert "Steinmetz" not in text and "iron, an estimate" not in text
    losses = json.loads(json.dumps(made["losses"]))
    for controller in CONTROLLERS:
        losses["start_600"][controller]["iron_estimate_W"] = None
        losses["load_step_150"][controller]["iron_estimate_W"] = 4.747
    text = page(tmp_path / "with.html", dict(made, losses=losses), pictures)
    read_page(text)
    assert text.count("<td>4.75</td>") == 2
    assert "iron, an estimate" in text and "no part of the ledger" in text


def test_words_from_outside_are_escaped(made, pictures, tmp_path):
    conditions = dict(CONDITIONS, machine="<b>&odd")
    text = page(tmp_path / "report.html", dict(made, conditions=conditions), pictures, [("<i>", [("<u>", "a&b.json")])])
    assert "<b>&odd" not in text
    assert "&lt;b&gt;&amp;odd" in text
    read_page(text)


def test_equal_results_give_an_equal_page(made, pictures, tmp_path):
    assert page(tmp_path / "a.html", made, pictures) == page(tmp_path / "b.html", made, pictures)
