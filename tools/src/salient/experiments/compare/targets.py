"""What the figures are held against: what is wanted of a controller, what physics allows, what the paper prints.

Sources. Wanted: the aims of the controller `salient` at 40 kHz with a 17-bit encoder and a 12-bit ADC; under the
paper's conditions what it prints for its controller; in the robustness study the limits of measures.py. Bounds: of the
start, inertia and friction at 19.1 N m; of the load step, a clairvoyant drive that has the whole supply voltage 0 us
(ideal sensing) or 100 us after the step, over the rotor's angles, computed in floating point. Printed: the paper's
section 3 and Table 2 (salient.experiments.results).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from salient.experiments.compare.cases import MAGNETICS
from salient.experiments.compare.metrics import CYCLE_PERCENT, HIGHEST_SPEED_PERCENT, HOLDS_PERCENT, PEAK_CURRENT_A
from salient.experiments.results import PAPER

Key = tuple[str, str, str, str]
"""Group, condition, figure, statistic: a row."""


@dataclass(frozen=True)
class Target:
    """wanted: at most so much of `controller`. bound: what no drive can go below. printed: by controller. In the
    units of the figures. reason: why what is wanted is not reached, where that is known."""

    wanted: float | None = None
    controller: str = "salient"
    bound: float | None = None
    printed: Mapping[str, float | None] = field(default_factory=dict)
    reason: str = ""


def _ripples() -> dict[Key, Target]:
    printed = {name: PAPER["load_step_150"][name]["torque_ripple"] for name in ("traditional", "paper")}
    limits = {("40 kHz", "one pulse"): 0.0100, ("40 kHz", "two pulses"): 0.0065, ("20 kHz", "two pulses"): 0.0115,
              ("100 kHz", "one pulse"): 0.0045, ("100 kHz", "two pulses"): 0.0045}
    targets = {("ripple", f"{machine}, {rate}, {pulses}", figure, ""): Target(limit, printed=printed)
               for machine in MAGNETICS for (rate, pulses), limit in limits.items()
               for figure in ("ripple", "ripple_long")}
    targets |= {("ripple", f"{machine}, 40 kHz, {pulses}, all imperfections", figure, ""): Target(0.0145)
                for machine in MAGNETICS for pulses in ("one pulse", "two pulses")
                for figure in ("ripple", "ripple_long")}
    return targets | {("speeds", f"saturating, {speed} r/min", figure, ""): Target(limit)
                      for speed, limit in (("600", 0.015), ("1500", 0.03), ("3000", 0.03))
                      for figure in ("ripple", "ripple_long")}


def _starts() -> dict[Key, Target]:
    targets = {}
    for figure, wanted, bound in (("settling_time_s", 0.0695, 0.0677), ("overshoot_percent", 0.02, 0.0)):
        printed = {name: PAPER["start_600"][name][figure] for name in ("traditional", "paper")}
        targets["start", "saturating", figure, ""] = Target(wanted, bound=bound, printed=printed)
        for machine in MAGNETICS[1:]:
            targets["start", machine, figure, ""] = Target(bound=bound, printed=printed)
        for machine in MAGNETICS:
            targets["paper_conditions", f"{machine}, start", figure, ""] = Target(bound=bound, printed=printed)
    return targets


# Median and highest over the rotor's angles, with the voltage 0 us and 100 us after the step.
_DIP_BOUNDS = {
    ("saturating", "ideal sensing"): (0.83, 1.95), ("saturating", ""): (1.21, 2.32),
    ("linear_cosine", "ideal sensing"): (1.07, 2.93), ("linear_cosine", ""): (1.46, 3.33),
    ("saturating", "ideal sensing, reserve of 8 N m"): (0.20, 0.28),
    ("linear_trapezoid", "ideal sensing"): (1.53, 3.02), ("linear_trapezoid", ""): (1.92, 3.41),
}  # fmt: skip
# Median dip, highest dip, median recovery, highest speed.
_DIP_WANTED: dict[str, tuple[float | None, ...]] = {
    "17 bits": (3.2, 4.2, None, 150.1),
    "17 bits and edge stamps": (1.9, 3.2, 0.0027, 150.1),
    "ideal sensing": (1.2, 2.3, None, 150.1),
}


def _dips() -> dict[Key, Target]:
    conditions = [("saturating", sensing) for sensing in (*_DIP_WANTED, "ideal sensing, reserve of 8 N m")]
    conditions += [(machine, sensing) for machine in MAGNETICS[1:] for sensing in list(_DIP_WANTED)[1:]]
    targets = {}
    for machine, sensing in conditions:
        median_rpm, worst_rpm = _DIP_BOUNDS.get((machine, sensing)) or _DIP_BOUNDS[machine, ""]
        wanted = (_DIP_WANTED.get(sensing) if machine == "saturating" else None) or (None,) * 4
        rows = (("speed_dip_rpm", "median", median_rpm, "speed_dip_rpm"),
                ("speed_dip_rpm", "worst", worst_rpm, "speed_dip_rpm"),
                ("recovery_time_s", "median", None, "recovery_time_s"),
                ("speed_after_rpm", "worst", None, "max_speed_rpm"))
        for (figure, statistic, bound, name), limit in zip(rows, wanted, strict=True):
            printed = {of: PAPER["load_step_150"][of][name] for of in ("traditional", "paper")}
            targets["dip", f"{machine}, {sensing}", figure, statistic] = Target(limit, bound=bound, printed=printed)
    return targets


def _paper_conditions() -> dict[Key, Target]:
    names = {"speed_dip_rpm": "speed_dip_rpm", "recovery_time_s": "recovery_time_s",
             "speed_after_rpm": "max_speed_rpm", "torque_mean_Nm": "torque_mean_Nm", "ripple": "torque_ripple"}
    printed = {figure: {of: PAPER["load_step_150"][of][name] for of in ("traditional", "paper")}
               for figure, name in names.items()}
    targets = {("paper_conditions", f"{machine}, load step{parameters}", figure, ""): Target(printed=printed[figure])
               for machine in MAGNETICS for parameters in ("", ", usual parameters") for figure in names}
    for machine in MAGNETICS:
        targets["paper_conditions", f"{machine}, load step", "ripple", ""] = Target(
            printed["ripple"]["paper"], "paper", printed=printed["ripple"])
    return targets


def _robustness() -> dict[Key, Target]:
    limits = {("failed", "count"): 0.0, ("peak_current_A", "worst"): PEAK_CURRENT_A,
              ("highest_speed_percent", "worst"): HIGHEST_SPEED_PERCENT,
              ("speed_error_percent", "worst"): HOLDS_PERCENT, ("cycle_percent", "worst"): CYCLE_PERCENT}
    return {("robustness", "random drives", *row): Target(limit) for row, limit in limits.items()}


TARGETS: dict[Key, Target] = {**_ripples(), **_starts(), **_dips(), **_paper_conditions(), **_robustness()}
