"""Scenarios: what is asked of a drive over a stretch of virtual time, from a TOML file to recording, log and summary.

    machine = "saturating"                  # a shipped machine's name or the path of a machine file
    controllers = ["traditional", "paper"]  # one run each
    duration_s = 0.4
    seed = 1                                # optional, as everything below
    initial_angle_deg = 0.0
    control_rate_hz = 40000
    encoder_bits = 17                       # 0: ideal

    [parameters]                            # the drive's parameters by name, in their units
    torque_max_Nm = 19.1

    [[speed]]                               # from the first of these the drive is asked to run
    at_s = 0.0
    value_rpm = 600.0

    [[load]]
    at_s = 0.13
    torque_Nm = 8.0

    [record]                                # the true state, for figures; without it nothing is recorded
    step_us = 1.0
    from_s = 0.0

`load_scenarios` gives one Scenario for each controller, `run_scenario` runs one.
"""

from __future__ import annotations

import json
import math
import os
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from salient.errors import UsageError

CONTROLLERS = ("traditional", "paper")
CONTROL_RATES_HZ = (20_000, 40_000, 50_000, 100_000)


@dataclass(frozen=True)
class SpeedStep:
    """From at_s on the drive is asked for value_rpm."""

    at_s: float
    value_rpm: float


@dataclass(frozen=True)
class LoadStep:
    """From at_s on the bench loads the shaft with torque_Nm, positive against forward motion."""

    at_s: float
    torque_Nm: float


@dataclass(frozen=True)
class Record:
    """The true state every step_us microseconds from from_s on."""

    step_us: float = 1.0
    from_s: float = 0.0


@dataclass(frozen=True)
class Scenario:
    """One run of one drive. Times in seconds of virtual time, not negative."""

    name: str
    duration_s: float
    machine: str = "saturating"
    controller: str = "traditional"
    seed: int = 1
    initial_angle_deg: float = 0.0
    control_rate_hz: int = 40_000
    encoder_bits: int = 17
    parameters: dict[str, float] = field(default_factory=dict)
    speed: tuple[SpeedStep, ...] = ()
    load: tuple[LoadStep, ...] = ()
    record: Record | None = None


@dataclass(frozen=True)
class RunResult:
    """What a run left behind.

    recording: structured array, one row each record.step_us (time_s, speed_rpm, torque_Nm, load_torque_Nm,
    rotor_angle_deg, current_a_A, ...), memory-mapped from recording_path; None when nothing was recorded.
    telemetry, truth: signals by name as they went over CAN (salient.signals.SignalTable).
    fault: the drive's fault at the end, "none" when it is well.
    """

    scenario: Scenario
    folder: Path
    log_path: Path
    text_log_path: Path
    recording_path: Path | None
    recording: Any
    telemetry: Any
    truth: Any
    fault: str
