"""results.json: this drive's metrics, the paper's published values, and the conditions of both."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SCHEMA = 1

# Significant digits of floats: more than the precision of any metric, few enough to be readable.
SIGNIFICANT_DIGITS = 6

# The published values, section 3 with tables 1 and 2.
PAPER: dict[str, dict[str, dict[str, float]]] = {
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

# Remarks on published values, which are quoted unchanged.
PAPER_NOTES = (
    "Recovery of the traditional controller: the paper states that the speed is steady at 0.5 s, which is 0.37 s after"
    " the step at 0.13 s.",
    "Torque ripple of the paper's controller: its own Table 2 gives (8.40 - 8.24) / 8.32 = 0.0192, not 0.0197.",
    "Mean torque of the traditional controller: a steady mean must be load plus friction,"
    " 8 + 0.02 * 15.71 = 8.314 N m; 8.45 N m is not a steady mean.",
    "Minimum torque of the traditional controller: 8.2 N m in the text, 8.287 N m in Table 2; Table 2 is quoted.",
    "The paper gives neither its definition of settling nor the sampling time, the hysteresis bands, the network"
    " settings and the rotor angle of the load step.",
)


def make_results(experiments: Mapping[str, Mapping[str, Mapping[str, float | None]]],
                 losses: Mapping[str, Mapping[str, Mapping[str, Any]]],
                 conditions: Mapping[str, Any]) -> dict[str, Any]:
    """The content of results.json.

    `experiments` maps experiment -> controller -> metric -> value or None, `losses` experiment -> controller -> result
    of metrics.losses. Floats in them and in `conditions` are rounded to SIGNIFICANT_DIGITS; the order of the
    keys is preserved.
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
    """`value` with all floats, also in nested mappings and lists, rounded to SIGNIFICANT_DIGITS digits."""
    if isinstance(value, float):
        return float(f"{value:.{SIGNIFICANT_DIGITS}g}")
    if isinstance(value, Mapping):
        return {key: rounded(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(part) for part in value]
    return value
