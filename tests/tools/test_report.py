"""Pictures, results.json and the report page from made-up recordings: nothing hidden or fetched, equal bytes."""

import json
import re
from html.parser import HTMLParser
from itertools import combinations

import numpy as np
import pytest

from salient.experiments import demo, metrics, report, results
from salient.experiments import plots as figures

CONTROLLERS = ("traditional", "paper", "salient")
"""Of the pages and pictures; the paper prints nothing for the last."""
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
    ripple_Nm = {"traditional": 3.0, "paper": 0.3, "salient": 0.05}
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


# Linear RGB as dichromats see it: G. M. Machado, M. M. Oliveira, L. A. F. Fernandes, "A physiologically-based model for
# simulation of color vision deficiency", IEEE Trans. Visualization and Computer Graphics 15(6), 2009, severity 1.
EYES = {
    "normal": ([1, 0, 0], [0, 1, 0], [0, 0, 1]),
    "protanope": ([0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]),
    "deuteranope": ([0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]),
    "tritanope": ([1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]),
}


def lab(colour, eyes):
    """CIE L*a*b* (D65) of "#rrggbb" as these eyes see it."""
    rgb = np.array([int(colour[place:place + 2], 16) for place in (1, 3, 5)]) / 255.0
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.array(EYES[eyes]) @ linear, 0.0, 1.0)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ seen
    x, y, z = np.cbrt(np.maximum(xyz / (0.9505, 1.0, 1.089), 0.008856))
    return np.array([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)])


@pytest.mark.parametrize("eyes", EYES)
def test_colours_of_controllers_are_apart_for_all_eyes(eyes):
    """20 is ten times a difference that is just noticed side by side."""
    for one, other in combinations(CONTROLLERS, 2):
        colours = figures.CONTROLLER_COLOUR[one], figures.CONTROLLER_COLOUR[other]
        assert 20.0 < np.linalg.norm(lab(colours[0], eyes) - lab(colours[1], eyes)) < 150.0, (one, other)


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
    for part, controllers in (("experiments", CONTROLLERS), ("paper", ("traditional", "paper"))):
        assert list(read[part]) == ["start_600", "load_step_150"]
        for controller in controllers:
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


def of_controllers(made, controllers):
    """The results of some of the controllers only."""
    return made | {part: {experiment: {controller: of[controller] for controller in controllers}
                          for experiment, of in made[part].items()} for part in ("experiments", "losses")}


@pytest.mark.parametrize("controllers", [("traditional",), ("salient",), ("paper", "salient"),
                                         ("salient", "traditional", "paper")])
def test_any_controllers_in_any_order_make_a_page_and_pictures(runs, made, controllers, tmp_path):
    some = of_controllers(made, controllers)
    some_runs = {experiment: {controller: of[controller] for controller in controllers}
                 for experiment, of in runs.items()}
    text = page(tmp_path / "report.html", some, draw_all(tmp_path / "figures", some_runs, some))
    read_page(text)
    for controller, of in made["experiments"]["load_step_150"].items():
        assert (f"{of['torque_ripple']:.4f}" in text) == (controller in controllers)
    # In the tables of both experiments; nothing says "printed" of what is not.
    assert text.count("<th class=paper>printed</th>") == 2 * len({"traditional", "paper"} & set(controllers))


def test_the_terminal_s_table_has_a_printed_column_only_where_the_paper_prints(made):
    lines = demo.summary(made).splitlines()
    assert [line.split() for line in lines if line.startswith("start_600")] == [
        ["start_600", "traditional", "printed", "paper", "printed", "salient"]]
    (ripple,) = (line for line in lines if "K_t" in line)
    assert ripple.split()[3:] == [f"{made['experiments']['load_step_150'][controller]['torque_ripple']:.4f}" if ours
                                  else f"{made['paper']['load_step_150'][controller]['torque_ripple']:g}"
                                  for controller, ours in (("traditional", True), ("traditional", False),
                                                           ("paper", True), ("paper", False), ("salient", True))]


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
    assert text.count("<td>4.75</td>") == len(CONTROLLERS)
    assert "iron, an estimate" in text and "no part of the ledger" in text


def test_words_from_outside_are_escaped(made, pictures, tmp_path):
    conditions = dict(CONDITIONS, machine="<b>&odd")
    text = page(tmp_path / "report.html", dict(made, conditions=conditions), pictures, [("<i>", [("<u>", "a&b.json")])])
    assert "<b>&odd" not in text
    assert "&lt;b&gt;&amp;odd" in text
    read_page(text)


def test_equal_results_give_an_equal_page(made, pictures, tmp_path):
    assert page(tmp_path / "a.html", made, pictures) == page(tmp_path / "b.html", made, pictures)
