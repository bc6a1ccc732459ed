"""Metrics of the two experiments, from the true state that the emulator recorded.

A recording is a structured array with one row per sample, at least with the fields `time_s`, `speed_rpm` and
`torque_Nm` (shaft torque: the sum of the phases). The time increases by a constant step. Nothing is filtered or
resampled: every sample counts, so a single sample outside a band is an exit from that band.

Definitions
    band          reference +-0.5 % (BAND), its edges included
    settling      from the speed command to the first sample after the last exit from the band; 0 when the speed is
                  never outside, None when the last sample is outside (not settled within the recording)
    recovery      the same, counted from the load step
    overshoot     (maximum speed - reference) / reference in percent, not below 0
    speed drop    reference - minimum speed after the load step, not below 0
    torque ripple K_t = (T_max - T_min) / T_mean, equation (28) of the paper, over every sample of RIPPLE_WINDOW_S;
                  the samples must be 1 us apart or closer, because coarser ones can alias with the switching and hide
                  the ripple
    speed error   maximum deviation from the reference within a window, in percent of the reference
    strongest line  of the torque's spectrum over a window, below SPECTRUM_TO_HZ and away from the strokes' harmonics:
                  amplitude in percent of the mean torque. The torque of a steady drive is periodic with the strokes;
                  other lines are noise or a limit cycle
    mean powers   differences of the emulator's energies (fields `energy_..._J`) over a window, divided by its length.
                  They balance: input = copper + converter + friction + output + stored
        input     from the DC link into the half bridges, net of the returned power
        returned  from the half bridges back into the DC link
        copper, converter   heat in the windings and in the half bridges' devices
        friction, output    of the shaft; work on the load
        stored    into magnetic fields and the rotor: difference between the ends of the window
    efficiency    output / (output + copper + converter + friction), independent of stored energy; None when the load
                  takes no power
    RMS current   of all phases over every sample of the window
    iron loss     an estimate, separate from the above (iron_loss.py)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from salient.machine.file import Machine
from salient.machine.iron_loss import iron_loss_W

BAND = 0.005
RIPPLE_WINDOW_S = (0.3, 0.4)
RIPPLE_STEP_MAX_S = 1e-6
SPECTRUM_TO_HZ = 2000.0
# The spectrum is of means over this time, a multiple of the period at every control rate, which removes the
# switching.
SPECTRUM_STEP_S = 100e-6
_WINDOW_BINS = 3  # a line's width under a Hann window, to either side

# Times are compared with this tolerance: far below any sample step, far above the rounding of a double near 1 s.
_TIME_TOLERANCE_S = 1e-10


class MetricsError(ValueError):
    """A recording without the data of a metric; the message names the defect."""


def time_to_stay_in_band_s(time_s: np.ndarray, speed_rpm: np.ndarray, reference_rpm: float, since_s: float,
                           band: float = BAND) -> float | None:
    """Time from `since_s` until the speed is in reference +-band (a fraction) for the rest of the recording.

    Returns 0.0 when no sample from `since_s` is outside, None when the last one is.
    """
    first = _index_at(time_s, since_s)
    error_rpm = np.abs(np.asarray(speed_rpm[first:], dtype=float) - reference_rpm)
    outside = np.flatnonzero(~(error_rpm <= band * abs(reference_rpm)))
    if outside.size == 0:
        return 0.0
    inside_again = first + int(outside[-1]) + 1
    if inside_again == len(time_s):
        return None
    return float(time_s[inside_again]) - since_s


def start_metrics(recording: np.ndarray, reference_rpm: float, command_time_s: float = 0.0) -> dict[str, float | None]:
    """Metrics of a start from standstill to `reference_rpm` (> 0), commanded at `command_time_s`."""
    _check_recording(recording)
    speed_max_rpm = float(np.max(recording["speed_rpm"]))
    return {
        "settling_time_s": time_to_stay_in_band_s(recording["time_s"], recording["speed_rpm"], reference_rpm,
                                                  command_time_s),
        "overshoot_percent": max(0.0, (speed_max_rpm - reference_rpm) / reference_rpm * 100.0),
        "max_speed_rpm": speed_max_rpm,
    }


def load_step_metrics(recording: np.ndarray, reference_rpm: float, step_time_s: float,
                      ripple_window_s: tuple[float, float] = RIPPLE_WINDOW_S) -> dict[str, float | None]:
    """Metrics of a run at `reference_rpm` with a load step at `step_time_s`; torque over `ripple_window_s`."""
    after = speed_after_step(recording, reference_rpm, step_time_s)
    return {
        "speed_dip_rpm": after["speed_dip_rpm"],
        "recovery_time_s": after["recovery_time_s"],
        "max_speed_rpm": float(np.max(recording["speed_rpm"])),
        **torque_metrics(recording["time_s"], recording["torque_Nm"], ripple_window_s),
    }


def torque_metrics(time_s: np.ndarray, torque_Nm: np.ndarray, window_s: tuple[float, float]) -> dict[str, float]:
    """Maximum, minimum and mean torque and K_t over the samples with window_s[0] <= time <= window_s[1].

    Raises MetricsError when the recording does not span the window or its samples are more than 1 us apart, or when
    the mean torque is not positive, for which K_t is not defined.
    """
    start_s, end_s = window_s
    step_s = sample_step_s(time_s)
    if step_s > RIPPLE_STEP_MAX_S + _TIME_TOLERANCE_S:
        raise MetricsError(f"torque ripple needs samples {RIPPLE_STEP_MAX_S * 1e6:g} us apart or closer, the recording"
                           f" has {step_s * 1e6:g} us")
    if time_s[0] > start_s + _TIME_TOLERANCE_S or time_s[-1] < end_s - step_s - _TIME_TOLERANCE_S:
        raise MetricsError(f"torque ripple is taken from {start_s:g} s to {end_s:g} s, the recording spans"
                           f" {time_s[0]:g} s to {time_s[-1]:g} s")
    torque_Nm = np.asarray(torque_Nm[_index_at(time_s, start_s):_index_after(time_s, end_s)], dtype=float)
    max_Nm, min_Nm, mean_Nm = float(torque_Nm.max()), float(torque_Nm.min()), float(torque_Nm.mean())
    if mean_Nm <= 0.0:
        raise MetricsError(f"torque ripple needs a positive mean torque, the window has {mean_Nm:g} N m")
    return {
        "torque_max_Nm": max_Nm,
        "torque_min_Nm": min_Nm,
        "torque_mean_Nm": mean_Nm,
        "torque_ripple": (max_Nm - min_Nm) / mean_Nm,
    }


def speed_after_step(recording: np.ndarray, reference_rpm: float, step_time_s: float) -> dict[str, float | None]:
    """Speed drop, recovery time and maximum speed after a load step at `step_time_s`; earlier samples do not count."""
    _check_recording(recording)
    time_s, speed_rpm = recording["time_s"], recording["speed_rpm"]
    after_rpm = speed_rpm[_index_at(time_s, step_time_s):]
    return {
        "speed_dip_rpm": max(0.0, reference_rpm - float(np.min(after_rpm))),
        "recovery_time_s": time_to_stay_in_band_s(time_s, speed_rpm, reference_rpm, step_time_s),
        "speed_after_rpm": float(np.max(after_rpm)),
    }


def speed_error_percent(recording: np.ndarray, reference_rpm: float, window_s: tuple[float, float]) -> float:
    """Maximum deviation of the speed from `reference_rpm` (> 0) in the window, in percent of the reference."""
    time_s = recording["time_s"]
    part_rpm = np.asarray(recording["speed_rpm"][_index_at(time_s, window_s[0]):_index_after(time_s, window_s[1])],
                          dtype=float)
    return 100.0 * float(np.max(np.abs(part_rpm - reference_rpm))) / reference_rpm


def stroke_deg(machine: Machine) -> float:
    """Rotor angle between the turn-on of consecutive phases, in mechanical degrees."""
    return 360.0 / (machine.rotor_poles * machine.phases)


def strongest_line_percent(recording: np.ndarray, window_s: tuple[float, float], stroke_angle_deg: float) -> float:
    """Amplitude of the strongest line of the torque's spectrum that is not a harmonic of the strokes, in percent of
    the mean torque. stroke_angle_deg: see stroke_deg.

    The strokes follow from the mean speed of the window. MetricsError when the window has fewer than 4 * _WINDOW_BINS
    strokes, which would not separate lines from harmonics, when samples are more than a tenth of SPECTRUM_STEP_S
    apart, or when the mean torque is not positive.
    """
    time_s = recording["time_s"]
    first, last = _index_at(time_s, window_s[0]), _index_after(time_s, window_s[1])
    per_block = round(SPECTRUM_STEP_S / sample_step_s(time_s))
    if per_block < 10:
        raise MetricsError(f"a spectrum needs samples {SPECTRUM_STEP_S * 1e5:g} us apart or closer, the recording has"
                           f" {sample_step_s(time_s) * 1e6:g} us")
    blocks = (last - first) // per_block
    torque_Nm = np.asarray(recording["torque_Nm"][first:first + blocks * per_block], dtype=float)
    means_Nm = torque_Nm.reshape(blocks, per_block).mean(axis=1)
    mean_Nm = float(means_Nm.mean())
    if mean_Nm <= 0.0:
        raise MetricsError(f"a spectrum in percent needs a positive mean torque, the window has {mean_Nm:g} N m")
    # 1 r/min is 6 degrees per second.
    travel_deg = 6.0 * float(np.mean(recording["speed_rpm"][first:last], dtype=float)) * blocks * SPECTRUM_STEP_S
    strokes = abs(travel_deg) / stroke_angle_deg  # in the window; also the bin of their first harmonic
    if strokes < 4 * _WINDOW_BINS:
        raise MetricsError(f"a spectrum between the strokes needs {4 * _WINDOW_BINS} of them, the window has"
                           f" {strokes:.1f}")
    window = np.hanning(blocks)
    amplitude_Nm = 2.0 * np.abs(np.fft.rfft((means_Nm - mean_Nm) * window)) / window.sum()
    bins = np.arange(len(amplitude_Nm))
    off_harmonic = np.abs(bins - strokes * np.round(bins / strokes))
    counted = (off_harmonic > _WINDOW_BINS) & (bins < SPECTRUM_TO_HZ * SPECTRUM_STEP_S * blocks)
    return 100.0 * float(np.max(amplitude_Nm[counted])) / mean_Nm


def losses(recording: np.ndarray, machine: Machine, window_s: tuple[float, float]) -> dict[str, Any]:
    """Power balance over window_s: mean powers in W, efficiency, RMS phase current, and window_s itself.

    `recording` needs the energies and currents that the emulator records. The key iron_estimate_W exists when the
    machine file has a table [iron_loss]; its value is None when the recording is too coarse or too short. MetricsError
    when the recording does not span the window.
    """
    time_s = recording["time_s"]
    step_s = sample_step_s(time_s)
    if time_s[0] > window_s[0] + _TIME_TOLERANCE_S or time_s[-1] < window_s[1] - step_s - _TIME_TOLERANCE_S:
        raise MetricsError(f"losses are taken from {window_s[0]:g} s to {window_s[1]:g} s, the recording spans"
                           f" {time_s[0]:g} s to {time_s[-1]:g} s")
    part = recording[_index_at(time_s, window_s[0]):_index_after(time_s, window_s[1])]
    if len(part) < 2:
        raise MetricsError(f"losses need at least 2 samples from {window_s[0]:g} s to {window_s[1]:g} s")
    power_W = {name: (float(part[f"energy_{name}_J"][-1]) - float(part[f"energy_{name}_J"][0]))
               / float(part["time_s"][-1] - part["time_s"][0])
               for name in ("drawn", "returned", "copper", "converter", "friction", "load")}
    input_W = power_W["drawn"] - power_W["returned"]
    lost_W = power_W["copper"] + power_W["converter"] + power_W["friction"]
    output_W = power_W["load"]
    square_A2 = [float(np.mean(np.square(part[name], dtype=float)))
                 for name in part.dtype.names or () if name.startswith("current_")]
    powers: dict[str, Any] = {
        "window_s": list(window_s),
        "input_W": input_W,
        "returned_W": power_W["returned"],
        "copper_W": power_W["copper"],
        "converter_W": power_W["converter"],
        "friction_W": power_W["friction"],
        "output_W": output_W,
        "stored_W": input_W - lost_W - output_W,
        "efficiency_percent": 100.0 * output_W / (output_W + lost_W) if output_W > 0.0 else None,
        "phase_current_rms_A": (sum(square_A2) / len(square_A2)) ** 0.5,
    }
    if machine.iron_loss is not None:
        powers["iron_estimate_W"] = iron_loss_W(machine, recording, window_s)
    return powers


def sample_step_s(time_s: np.ndarray) -> float:
    """The constant step between the samples of a recording, in seconds, from its first and last time."""
    if len(time_s) < 2:
        raise MetricsError(f"a recording needs at least 2 samples, this one has {len(time_s)}")
    return (float(time_s[-1]) - float(time_s[0])) / (len(time_s) - 1)


def _check_recording(recording: np.ndarray) -> None:
    for field in ("time_s", "speed_rpm", "torque_Nm"):
        if field not in (recording.dtype.names or ()):
            raise MetricsError(f"the recording has no field {field}")
        if not np.all(np.isfinite(recording[field])):
            raise MetricsError(f"the recording's field {field} has a value that is not finite")
    time_s = recording["time_s"]
    step_s = sample_step_s(time_s)
    steps_s = np.diff(time_s)
    if step_s <= 0.0 or float(steps_s.min()) < 0.5 * step_s or float(steps_s.max()) > 1.5 * step_s:
        raise MetricsError("the recording's times do not increase in equal steps")


def _index_at(time_s: np.ndarray, when_s: float) -> int:
    """Index of the first sample at or after `when_s`; MetricsError when there is none."""
    index = int(np.searchsorted(time_s, when_s - _TIME_TOLERANCE_S, side="left"))
    if index == len(time_s):
        raise MetricsError(f"the recording ends at {time_s[-1]:g} s, before {when_s:g} s")
    return index


def _index_after(time_s: np.ndarray, when_s: float) -> int:
    """Index one past the last sample at or before `when_s`."""
    return int(np.searchsorted(time_s, when_s + _TIME_TOLERANCE_S, side="right"))
