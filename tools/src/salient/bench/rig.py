"""The test bench over CAN: its quantities, set now or at a virtual time."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import can
from cantools.database.can import Signal

from salient.bus.signals import rig_database

if TYPE_CHECKING:
    from salient.bench.session import Session

_AT_US_MAX = 2**32 - 1


class RigError(Exception):
    """The bench refused a setting; the text says which and why."""


@lru_cache
def quantities() -> dict[str, Signal]:
    """The bench's quantities by name, with their ranges: the signals of RIG_SET that it chooses between."""
    return {s.name: s for s in rig_database().get_message_by_name("RIG_SET").signals if s.multiplexer_ids}


class Quantity:
    """An attribute of Rig: assigning sets the quantity of that name, reading gives what was assigned last."""

    def __init__(self, initial: float | None) -> None:
        self._initial = initial

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, rig: Rig | None, owner: type | None = None):
        if rig is None:
            return self
        value = rig._assigned.get(self._name, self._initial)
        if value is None:
            raise AttributeError(f"{self._name} is as the machine file has it until it is set")
        return value

    def __set__(self, rig: Rig, value: float) -> None:
        rig.set(self._name, value)
        rig._assigned[self._name] = value


class Rig:
    """The bench's quantities, as attributes that act now; `at` gives them at a virtual time.

    rig.load_torque_Nm = 8 acts at once, rig.at(0.13).load_torque_Nm = 8 at exactly 0.13 s. RigError when the bench
    refuses: out of range, in the past, or more than 64 settings ahead.
    """

    load_torque_Nm = Quantity(0.0)
    """On the shaft, positive against forward motion."""
    supply_voltage_V = Quantity(None)
    """Of the DC link."""
    encoder_fault = Quantity(0)
    """0 healthy, 1 frozen at its count, 2 jumps by half a turn."""
    interrupt_time_us = Quantity(0.0)
    """How long the control interrupt takes, on a processor that takes time (BenchConfig.instruction_ns) beside its
    own; beyond a period interrupts are lost."""
    current_sensor_gain = Quantity(None)
    """1 is true."""
    current_sensor_offset_A = Quantity(None)
    """Of every current sensor, behind its gain."""
    current_noise_A = Quantity(None)
    """Standard deviation of every current sensor; its course depends on the seed."""
    current_sensor_limit_A = Quantity(None)
    """Every current sensor saturates here."""
    current_sensor_delay_us = Quantity(None)
    """A sample shows the current of so long before it, from the next control period on."""
    encoder_eccentricity_deg = Quantity(None)
    """The encoder reads angle + this * sin(angle)."""
    flux_linkage_gain = Quantity(1.0)
    """Flux linkage and torque of every phase, at the same angle and current, over the machine file's."""
    resistance_gain = Quantity(1.0)
    """Of every winding, over the machine file's."""
    inertia_gain = Quantity(1.0)
    """Over the machine file's; the speed goes on as it is."""
    friction_gain = Quantity(1.0)
    """Over the machine file's."""
    encoder_offset_deg = Quantity(0.0)
    """Added to the angle that the encoder reads, mechanical."""
    minimum_pulse_ns = Quantity(None)
    """A shorter pulse or gap of a switch does not happen, from the next control period on."""
    truth_period_us = Quantity(1000)
    """How often the true state is sent; 0 never."""

    def __init__(self, session: Session, at_us: int = 0) -> None:
        self._session = session
        self._at_us = at_us
        self._assigned: dict[str, float] = {}

    def at(self, time_s: float) -> Rig:
        """The same bench, set at a virtual time (rounded to microseconds)."""
        return Rig(self._session, round(time_s * 1e6))

    def set(self, name: str, value: float) -> None:
        """Sets a quantity by its name in rig.dbc."""
        signal = quantities()[name]
        if not signal.minimum <= value <= signal.maximum:
            allowed = f"{signal.minimum:g} to {signal.maximum:g} {signal.unit or ''}".rstrip()
            raise RigError(f"{name} {value:g}: allowed are {allowed}")
        if not 0 <= self._at_us <= _AT_US_MAX:
            raise RigError(f"{name} at {self._at_us} us: allowed are 0 to {_AT_US_MAX} us")
        message = rig_database().get_message_by_name("RIG_SET")
        number = signal.multiplexer_ids[0]
        data = message.encode({"quantity": number, name: value, "at_us": self._at_us})
        self._session.send(can.Message(arbitration_id=message.frame_id, is_extended_id=True, data=data))
        reply = rig_database().get_message_by_name("RIG_SET_REPLY")
        answer = self._session.receive_until(
            lambda m: m.arbitration_id == reply.frame_id and m.is_extended_id and m.data[0] == number
        )
        status = reply.decode(bytes(answer.data))["status"]
        if status != "done":
            raise RigError(f"{name} {value:g} at {self._at_us} us: {status}")
