"""results.json: this drive's figures beside the paper's, and the conditions they were obtained under."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SCHEMA = 1

# Floats are written with this many significant digits: more than any of the figures means, few enough to be read.
SIGNIFICANT_DIGITS = 6

# The figures as the paper prints them, section 3 with tables 1 and 2; None where it prints none.
PAPER: dict[str, dict[str, dict[str, float | None]]] = {
    "start_600": {
        "traditional": {"settling_time_s": 0.18, "overshoot_percent": 3.3, "max_speed_rpm": 620.0},
        "paper": {"settling_time_s": 0.07, "overshoot_percent": 0.5, "max_speed_rpm": 603.0},
    },
    "load_step_150": {
        "traditional": {
            "speed_dip_rpm": 7.0,
            "recovery_time_s": 0.37,
            "max_speed_rpm": 158.0,
            "torque_max_Nm": 8.65,
            "torque_min_Nm": 8.287,
            "torque_mean_Nm": 8.45,
            "torque_ripple": 0.04295,
        },
        "paper": {
            "speed_dip_rpm": 0.4,
            "recovery_time_s": 0.001,
            "max_speed_rpm": 150.5,
            "torque_max_Nm": 8.4,
            "torque_min_Nm": 8.24,
            "torque_mean_Nm": 8.32,
            "torque_ripple": 0.0197,
        },
    },
}

# Where the printed figures need a word; kept beside them, because they are quoted as printed.
PAPER_NOTES = (
    "Recovery of the traditional controller: the paper prints that the speed is steady at 0.5 s, which is 0.37 s after"
    " the step at 0.13 s.",
    "Torque ripple of the paper's controller: its own Table 2 gives (8.40 - 8.24) / 8.32 = 0.0192, not 0.0197.",
    "Mean torque of the traditional controller: a steady mean must be load plus friction,"
    " 8 + 0.02 * 15.71 = 8.314 N m; 8.45 N m is no steady mean.",
    "Minimum torque of the traditional controller: the text says 8.2 N m, Table 2 says 8.287 N m; Table 2 is quoted.",
    "The paper does not say how it defines settled, nor its sampling time, hysteresis bands, network settings and the"
    " rotor angle of the load step.",
)


def make_results(experiments: Mapping[str, Mapping[str, Mapping[str, float | None]]],
                 losses: Mapping[str, Mapping[str, Mapping[str, Any]]],
                 conditions: Mapping[str, Any]) -> dict[str, Any]:
    """The content of results.json.

    `experiments` maps experiment -> controller -> figure of merit -> value or None, `losses` experiment -> controller
    -> what metrics.losses gives. Floats in them and in `conditions` are rounded to SIGNIFICANT_DIGITS; the order of the
    keys is kept.
    """
    return {
        "schema": SCHEMA,
        "experiments": rounded(experiments),
        "losses": rounded(losses),
        "paper": PAPER,
        "paper_notes": list(PAPER_NOTES),
        "conditions": rounded(conditions),
    }


def write_results(path: Path, results: Mapping[str, Any]) -> None:
    """Writes `results` as JSON; equal results give equal bytes."""
    path.write_text(json.dumps(results, indent=2, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")


def rounded(value: Any) -> Any:
    """`value` with every float in it, however deep in mappings and lists, at SIGNIFICANT_DIGITS digits."""
    if isinstance(value, float):
        return float(f"{value:.{SIGNIFICANT_DIGITS}g}")
    if isinstance(value, Mapping):
        return {key: rounded(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(part) for part in value]
    return value
