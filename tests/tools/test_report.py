"""Plots, results.json and the report page from synthetic recordings: complete, self-contained, equal bytes."""

import json
import re
from html.parser import HTMLParser
from itertools import combinations

import numpy as np
import pytest

from salient.experiments import demo, metrics, plots, report, results
from salient.pages import CONTROLLER_COLOUR, Plot
from salient.paths import ROOT

CONTROLLERS = ("traditional", "paper", "salient")
"""Controllers of pages and plots; the paper has no values for the last."""
CONDITIONS = {
    "operating_point": {"start_rpm": 600.0, "step_rpm": 150.0, "load_Nm": 8.0, "step_at_s": 0.13,
                        "window_s": [0.3, 0.4]},
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
    """0.5 s at 1 us: a first-order start, 8 N m from 0.13 s with a speed drop, torque with a fast ripple."""
    names = ("speed_rpm", "torque_Nm", "load_torque_Nm", "rotor_angle_deg", "current_a_A", "current_b_A", "current_c_A")
    rows = np.zeros(500_001, dtype=[("time_s", "<f8")] + [(name, "<f4") for name in names])
    time_s = rows["time_s"] = np.arange(len(rows)) * 1e-6
    after_s = np.clip(time_s - 0.13, 0.0, None)
    rows["speed_rpm"] = reference_rpm * (1.0 - np.exp(-time_s / 0.01)) - 500.0 * after_s * np.exp(-after_s / 0.01)
    rows["load_torque_Nm"] = np.where(time_s >= 0.13, 8.0, 0.0)
    rows["torque_Nm"] = rows["load_torque_Nm"] + 0.314 + ripple_Nm * np.sin(2 * np.pi * 9_700.0 * time_s)
    rows["rotor_angle_deg"] = (reference_rpm * 6.0 * time_s) % 360.0
    for phase, name in enumerate(names[-3:]):
        angle_deg = (reference_rpm * 6.0 * time_s - 30.0 * phase) % 90.0
        rows[name] = np.where((angle_deg > 45.0) & (angle_deg < 80.0), 15.0, 0.0)
    return rows


@pytest.fixture(scope="module")
def runs():
    ripple_Nm = {"traditional": 3.0, "paper": 0.3, "salient": 0.05}
    return {
        "start_600": {controller: recording(600.0, ripple_Nm[controller]) for controller in CONTROLLERS},
        "load_step_150": {controller: recording(150.0, ripple_Nm[controller]) for controller in CONTROLLERS},
    }


@pytest.fixture(scope="module")
def content(runs):
    return results.make_results({
        "start_600": {name: metrics.start_metrics(run, 600.0) for name, run in runs["start_600"].items()},
        "load_step_150": {name: metrics.load_step_metrics(run, 150.0, 0.13)
                          for name, run in runs["load_step_150"].items()},
    }, {experiment: dict.fromkeys(CONTROLLERS, LOSSES) for experiment in ("start_600", "load_step_150")}, CONDITIONS)


def plot_all(folder, runs, content):
    folder.mkdir()
    paths = [folder / f"{name}.png" for name in ("figure_5", "figure_6", "figure_7", "phase_currents")]
    ours, paper = content["experiments"], content["paper"]
    plots.plot_start(paths[0], runs["start_600"], ours["start_600"], paper["start_600"])
    step = runs["load_step_150"], ours["load_step_150"], paper["load_step_150"]
    plots.plot_load_step_speed(paths[1], *step)
    plots.plot_load_step_torque(paths[2], *step)
    plots.plot_phase_currents(paths[3], runs["load_step_150"])
    return paths


@pytest.fixture(scope="module")
def plot_files(runs, content, tmp_path_factory):
    return plot_all(tmp_path_factory.mktemp("plots") / "figures", runs, content)


def page(path, content, plot_files, files=()):
    captions = report.captions(content)
    report.write_report(path, content,
                        [Plot(file.stem, captions[file.stem], file.read_bytes()) for file in plot_files],
                        ["tools/salient demo"], files)
    return path.read_text(encoding="utf-8")


# --- plots --------------------------------------------------------------------------------------------------------

def test_extremes_keep_a_spike_of_a_single_sample_at_any_position():
    time = np.arange(400_000, dtype=float)
    for spike in (0, 1, 12_345, 399_998, 399_999):
        values = np.zeros(len(time))
        values[spike] = -7.0
        plotted_time, plotted = plots.extremes(time, values)
        assert plotted.min() == -7.0
        assert plotted_time[plotted.argmin()] == spike


def test_extremes_contain_minimum_and_maximum_of_every_slice_in_time_order():
    values = np.random.default_rng(1).standard_normal(50_000)
    time, plotted = plots.extremes(np.arange(50_000), values, slices=100)
    assert len(plotted) == 200
    assert np.all(np.diff(time) >= 0)
    slices = values.reshape(100, 500)
    assert np.array_equal(plotted.reshape(100, 2).min(axis=1), slices.min(axis=1))
    assert np.array_equal(plotted.reshape(100, 2).max(axis=1), slices.max(axis=1))


def test_extremes_return_short_lines_unchanged():
    values = np.arange(3000.0)
    assert np.array_equal(plots.extremes(values, values)[1], values)


# Linear RGB as dichromats see it: G. M. Machado, M. M. Oliveira, L. A. F. Fernandes, "A physiologically-based model for
# simulation of color vision deficiency", IEEE Trans. Visualization and Computer Graphics 15(6), 2009, severity 1.
EYES = {
    "normal": ([1, 0, 0], [0, 1, 0], [0, 0, 1]),
    "protanope": ([0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]),
    "deuteranope": ([0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]),
    "tritanope": ([1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]),
}


def lab(colour, eyes):
    """CIE L*a*b* (D65) of "#rrggbb" as perceived with this colour vision."""
    rgb = np.array([int(colour[place:place + 2], 16) for place in (1, 3, 5)]) / 255.0
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(np.array(EYES[eyes]) @ linear, 0.0, 1.0)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ seen
    x, y, z = np.cbrt(np.maximum(xyz / (0.9505, 1.0, 1.089), 0.008856))
    return np.array([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)])


@pytest.mark.parametrize("eyes", EYES)
def test_colours_of_the_phases_on_the_live_page_are_distinguishable_with_any_colour_vision(eyes):
    palette = (ROOT / "tools/src/salient/view/page/palette.js").read_text()
    colours = re.findall("#[0-9a-f]{6}", re.search(r"PHASE_COLOURS = \[(.*?)\]", palette)[1])
    assert len(colours) == 6
    for one, other in combinations(colours, 2):
        assert 20.0 < np.linalg.norm(lab(one, eyes) - lab(other, eyes)) < 150.0, (one, other)


@pytest.mark.parametrize("eyes", EYES)
def test_colours_of_controllers_are_distinguishable_with_any_colour_vision(eyes):
    """20 is ten times the just noticeable difference."""
    for one, other in combinations(CONTROLLERS, 2):
        colours = CONTROLLER_COLOUR[one], CONTROLLER_COLOUR[other]
        assert 20.0 < np.linalg.norm(lab(colours[0], eyes) - lab(colours[1], eyes)) < 150.0, (one, other)


@pytest.mark.in_turns
def test_equal_runs_give_equal_plots(runs, content, plot_files, tmp_path):
    for first, again in zip(plot_files, plot_all(tmp_path / "again", runs, content), strict=True):
        assert first.read_bytes() == again.read_bytes(), first.name


@pytest.mark.in_turns
def test_run_without_settling_and_recovery_is_plotted(runs, content, tmp_path):
    ours = json.loads(json.dumps(content["experiments"]))
    for controller in CONTROLLERS:
        ours["start_600"][controller]["settling_time_s"] = None
        ours["load_step_150"][controller]["recovery_time_s"] = None
    changed = dict(content, experiments=ours)
    text = page(tmp_path / "report.html", changed, plot_all(tmp_path / "figures", runs, changed))
    assert "not in this run" in text


# --- results.json -----------------------------------------------------------------------------------------------------

def test_results_have_the_keys_that_scripts_rely_on(content, tmp_path):
    results.write_results(tmp_path / "results.json", content)
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


def test_results_quote_the_published_values():
    assert results.PAPER["load_step_150"]["traditional"]["torque_ripple"] == 0.04295
    assert results.PAPER["load_step_150"]["traditional"]["torque_mean_Nm"] == 8.45
    assert results.PAPER["load_step_150"]["paper"]["torque_ripple"] == 0.0197
    assert results.PAPER["start_600"]["paper"]["settling_time_s"] == 0.07


def test_rounding_keeps_six_digits_and_all_other_types():
    given = {"a": 1.23456789e-7, "b": [149.99999999, 3], "c": None, "d": "x", "e": {"f": 0.1 + 0.2}}
    assert results.rounded(given) == {"a": 1.23457e-7, "b": [150.0, 3], "c": None, "d": "x", "e": {"f": 0.3}}


def test_nan_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="JSON"):
        results.write_results(tmp_path / "results.json", {"a": float("nan")})


# --- the page ---------------------------------------------------------------------------------------------------------

class _Reader(HTMLParser):
    """Collects the references of a page, and checks that its elements nest."""

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


def test_page_embeds_its_plots_and_is_self_contained(content, plot_files, tmp_path):
    text = page(tmp_path / "report.html", content, plot_files, [("the figures", [("results.json", "results.json")])])
    reader = read_page(text)
    assert len(reader.images) == len(plot_files)
    assert all(image.startswith("data:image/png;base64,") for image in reader.images)
    assert reader.links == ["results.json"]
    assert not re.search(r"https?://|@import|<script|url\(", text)


def test_page_has_our_metrics_and_the_published_values(content, plot_files, tmp_path):
    text = page(tmp_path / "report.html", content, plot_files)
    for controller in CONTROLLERS:
        assert f"{content['experiments']['load_step_150'][controller]['torque_ripple']:.4f}" in text
    assert "0.04295" in text
    assert "0.0197" in text


def of_controllers(content, controllers):
    """The results of a subset of the controllers."""
    return content | {part: {experiment: {controller: of[controller] for controller in controllers}
                          for experiment, of in content[part].items()} for part in ("experiments", "losses")}


@pytest.mark.in_turns
@pytest.mark.parametrize("controllers", [("traditional",), ("salient",), ("paper", "salient"),
                                         ("salient", "traditional", "paper")])
def test_page_and_plots_accept_any_controllers_in_any_order(runs, content, controllers, tmp_path):
    some = of_controllers(content, controllers)
    some_runs = {experiment: {controller: of[controller] for controller in controllers}
                 for experiment, of in runs.items()}
    text = page(tmp_path / "report.html", some, plot_all(tmp_path / "figures", some_runs, some))
    read_page(text)
    for controller, of in content["experiments"]["load_step_150"].items():
        assert (f"{of['torque_ripple']:.4f}" in text) == (controller in controllers)
    # In the tables of both experiments, for controllers with published values only.
    assert text.count("<th class=published>published</th>") == 2 * len({"traditional", "paper"} & set(controllers))


def test_summary_has_a_published_column_only_for_published_values(content):
    lines = demo.summary(content).splitlines()
    assert [lines[at + 1].split() for at, line in enumerate(lines) if line.endswith("(start_600)")] == [
        ["traditional", "published", "paper", "published", "salient"]]
    (ripple,) = (line for line in lines if "K_t" in line)
    assert ripple.split()[3:] == [f"{content['experiments']['load_step_150'][controller]['torque_ripple']:.4f}" if ours
                                  else f"{content['paper']['load_step_150'][controller]['torque_ripple']:g}"
                                  for controller, ours in (("traditional", True), ("traditional", False),
                                                           ("paper", True), ("paper", False), ("salient", True))]


def test_summary_states_the_speeds_and_the_load_that_were_used(content):
    point = {**content["conditions"]["operating_point"], "start_rpm": 430.0, "step_rpm": 110.0, "load_Nm": 0.034}
    summary = demo.summary({**content, "conditions": {**content["conditions"], "operating_point": point}})
    assert "Start to 430 r/min, no load (start_600)\n" in summary
    assert "\n110 r/min, load step of 0.034 N m at " in summary


def test_page_shows_losses_and_iron_loss_only_where_estimated(content, plot_files, tmp_path):
    text = page(tmp_path / "without.html", content, plot_files)
    assert "<td>71.4</td>" in text and "<td>17.38</td>" in text
    assert "<td>0.0</td>" in text and "<td>-0.0</td>" not in text
    assert "Steinmetz" not in text and "iron, an estimate" not in text
    losses = json.loads(json.dumps(content["losses"]))
    for controller in CONTROLLERS:
        losses["start_600"][controller]["iron_estimate_W"] = None
        losses["load_step_150"][controller]["iron_estimate_W"] = 4.747
    text = page(tmp_path / "with.html", dict(content, losses=losses), plot_files)
    read_page(text)
    assert text.count("<td>4.75</td>") == len(CONTROLLERS)
    assert "iron, an estimate" in text and "not part of the energy balance" in text


def test_text_of_the_user_is_escaped(content, plot_files, tmp_path):
    conditions = dict(CONDITIONS, machine="<b>&odd")
    text = page(tmp_path / "report.html", dict(content, conditions=conditions), plot_files,
                [("<i>", [("<u>", "a&b.json")])])
    assert "<b>&odd" not in text
    assert "&lt;b&gt;&amp;odd" in text
    read_page(text)


def test_equal_results_give_equal_pages(content, plot_files, tmp_path):
    assert page(tmp_path / "a.html", content, plot_files) == page(tmp_path / "b.html", content, plot_files)


@pytest.mark.in_turns
@pytest.mark.parametrize("width", [1280, 390])
def test_nothing_of_the_page_is_cut_off_or_covered(unreadable, tmp_path, content, plot_files, width):
    page(tmp_path / "report.html", content, plot_files, [("the figures", [("results.json", "results.json")])])
    assert unreadable(tmp_path / "report.html", width) == []
