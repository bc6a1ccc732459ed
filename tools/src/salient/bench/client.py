"""A client of a bus as Drive and Rig need it, and attributes that catch misspelt assignments."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, Protocol

import can
from cantools.database.can import Database

from salient.bus.signals import SignalTable
from salient.errors import close_names


class Client(Protocol):
    """Sends and receives frames in virtual time; Session is one."""

    telemetry: SignalTable
    truth: SignalTable
    drive_database: Database
    """The DBC of the drive, with the identifiers of its node number."""
    rig_database: Database
    """Database of its test bench."""

    @property
    def time_ns(self) -> int:
        """Virtual time."""

    def require_drive_database(self) -> None:
        """Raises an exception when the drive is known to have another DBC."""

    def send(self, message: can.Message) -> None:
        """Sends a frame."""

    def receive_until(self, matches: Callable[[can.Message], bool]) -> can.Message:
        """Receives, without time passing in lock-step, until a frame meets the condition."""

    def advance_to(self, time_ns: int) -> None:
        """Lets virtual time pass until `time_ns`."""

    def advance_until_frame(self, matches: Callable[[can.Message], bool], timeout_s: float) -> can.Message:
        """Lets virtual time pass until a frame meets the condition; TimeoutError after timeout_s."""


class LoggingClient(Client, Protocol):
    """A client that keeps what it has received, as Session does."""

    log: list[tuple[int, can.Message]]
    machine: str | None

    def run_for(self, duration_s: float) -> None:
        """Lets virtual time pass."""


def unknown_attribute(name: str, known: Iterable[str]) -> AttributeError:
    """The error for an attribute that does not exist; its text names the nearest."""
    return AttributeError(f"no attribute '{name}'; {close_names(name, sorted(known))}")


class KnownAttributes:
    """Base of classes to whose objects only properties and annotated attributes can be assigned.

    AttributeError for any other name, so that a misspelt one does not pass unnoticed; it names the nearest, also where
    an attribute is read. Names with a leading underscore are free.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        cls = type(self)
        if not (name.startswith("_") or name in _annotated(cls) or hasattr(getattr(cls, name, None), "__set__")):
            raise unknown_attribute(name, _public(cls))
        super().__setattr__(name, value)

    if not TYPE_CHECKING:  # where it is seen, every attribute is taken to exist

        def __getattr__(self, name: str) -> Any:
            if name.startswith("_") or name in _public(type(self)):
                return object.__getattribute__(self, name)  # an AttributeError within a property is its own
            raise unknown_attribute(name, _public(type(self)))


def _annotated(cls: type) -> set[str]:
    return {n for base in cls.__mro__ for n in vars(base).get("__annotations__", ()) if n[0] != "_"}


def _public(cls: type) -> set[str]:
    return _annotated(cls) | {n for n in dir(cls) if not n.startswith("_")}
