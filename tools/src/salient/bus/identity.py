"""The machine that a drive carries, by the hashes in DRIVE_IDENTITY and DRIVE_MACHINE: every tool that decodes the
frames of a drive asks `Carrier`, so that none decodes frames of one machine with the factors of another.

Candidates, in their order: the machine that a note beside a log names, the default, the bundled ones, the
examples', and every machine that a drive has been started with here (salient.machine.cache keeps their files). Machines
with the same DBC are equal to what decodes; the hash of the machine tells them apart. A machine that is not known here
but has the DBC of one that is, is decoded as that one, and said to be another.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import can

from salient.bus.signals import drive_database
from salient.config import DEFAULTS
from salient.dbc import database_hash
from salient.errors import RunFailed, UsageError
from salient.machine.cache import kept_machines
from salient.machine.content import machine_hash
from salient.machine.file import MachineError, machine_path
from salient.paths import EXAMPLE_MACHINES, MACHINES

IDENTITY_WAIT_NS = 250_000_000
"""More than two periods of DRIVE_IDENTITY: a drive that is heard for so long without one sends none."""


class OtherDatabase(RunFailed, UsageError):
    """The drive's DBC is another one than stated, or none that is known here."""


@lru_cache
def hash_of(machine: str | None) -> int:
    """Hash of the DBC of a machine's drive, without a machine of that in SI units. MachineError."""
    return database_hash(drive_database(machine))


def machines_of(reported: int, noted: str | None = None) -> Iterator[str]:
    """The machines with a DBC of this hash, by name or file. noted: the first one to be tried."""
    bundled = [str(path) for folder in (MACHINES, EXAMPLE_MACHINES) for path in sorted(folder.glob("*.toml"))]
    tried = set()
    for machine in [*([noted] if noted else []), DEFAULTS["machine"], *bundled, *map(str, kept_machines(reported))]:
        try:
            path = machine_path(machine)
            if path in tried:
                continue
            tried.add(path)
            if hash_of(machine) == reported:
                yield path.stem if path.parent in (MACHINES, EXAMPLE_MACHINES) else machine
        except MachineError:
            continue  # a file that has gone, or one of the user's that has become wrong


@lru_cache
def _first(reported: int, noted: str | None) -> str | None:
    return next(machines_of(reported, noted), None)


@lru_cache
def _machine_hash(machine: str) -> int:
    """Hash of a machine by name or file; MachineError."""
    return machine_hash(machine_path(machine))


@lru_cache
def _same(reported: int, carried: int, noted: str | None) -> str | None:
    """The machine of these hashes, of DBC and machine."""
    return next((machine for machine in machines_of(reported, noted) if _machine_hash(machine) == carried), None)


class Carrier:
    """The machine of the drive with a node number, from the frames of its bus or log.

    where: the bus or log, for messages. given: the machine that the user states; another one than the drive's is
    refused, as is a drive whose machine is not known here (OtherDatabase, one line). option: how the user states it.
    noted: a machine that need not be right. machine: name or file, None before the drive has reported its identity.
    A drive whose machine is another one of the same DBC is one line on stderr. UsageError: there is no such machine.
    """

    def __init__(self, where: str, given: str | None, node: int = 0, *, option: str = "--machine",
                 noted: str | None = None) -> None:
        try:
            self._given = None if given is None else hash_of(given)
        except MachineError as error:
            raise UsageError(str(error)) from None
        self.machine: str | None = None
        self._where, self._node, self._option, self._noted, self._stated = where, node, option, noted, given
        database = drive_database(None, node)
        self._identity, self._machine = map(database.get_message_by_name, ("DRIVE_IDENTITY", "DRIVE_MACHINE"))
        self._lengths = {frame.frame_id: frame.length for frame in (self._identity, self._machine)}
        self._reported: int | None = None
        self._carried: int | None = None
        self._settled = False

    @property
    def likely(self) -> str:
        """The drive's machine; before it has reported one that is given or noted, else the default."""
        return self.machine or self._stated or self._noted or str(DEFAULTS["machine"])

    def take(self, message: can.Message) -> bool:
        """Takes a frame; True once the machine is known: DRIVE_MACHINE comes just before DRIVE_IDENTITY, whose second
        one is taken without. OtherDatabase: see above, and when the drive becomes another one."""
        if self.concerns(message):
            if message.arbitration_id == self._machine.frame_id:
                self._take_machine(bytes(message.data))
            else:
                self._take_identity(bytes(message.data))
        return self._settled

    def concerns(self, message: can.Message) -> bool:
        """Whether a frame says which machine the drive carries."""
        return (message.arbitration_id in self._lengths
                and len(message.data) == self._lengths[message.arbitration_id]
                and not (message.is_extended_id or message.is_remote_frame or message.is_error_frame or message.is_fd))

    def _take_machine(self, data: bytes) -> None:
        values: dict[str, Any] = dict(self._machine.decode_simple(data))
        carried = int(values["machine_hash"])
        if self._settled and self._carried not in {None, carried}:
            raise OtherDatabase(f"{self._where}: the drive with node number {self._node} has become one of another "
                                "machine; start again")
        self._carried = carried

    def _take_identity(self, data: bytes) -> None:
        identity: dict[str, Any] = dict(self._identity.decode_simple(data))
        reported = int(identity["dbc_hash"])
        if self._settled and reported == self._reported:
            return
        version = ".".join(str(identity[f"firmware_{part}"]) for part in ("major", "minor", "patch"))
        drive = f"{self._where}: the drive with node number {self._node} (firmware {version})"
        if self._reported not in {None, reported}:
            raise OtherDatabase(f"{drive} has become one of another machine: its database {reported:08x} was "
                                f"{self._reported:08x}; start again")
        if self._given is None:
            machine = _first(reported, self._noted)
        else:
            machine = self._stated if reported == self._given else None
        if machine is None:
            raise OtherDatabase(f"{drive} {self._refusal(reported)}")
        self._settled = self._carried is not None or self._reported is not None
        self._reported, self.machine = reported, machine
        if self._carried is not None:
            self._tell_apart(drive, reported, self._carried)

    def _tell_apart(self, drive: str, reported: int, carried: int) -> None:
        """Finds the machine among the ones with the same DBC; one line when it is unknown, or another than stated."""
        same = _same(reported, carried, self._noted)
        if self._given is None and same is not None:
            self.machine = same
        elif same is None or _machine_hash(str(self.machine)) != carried:
            print(f"salient: {drive} carries {same or f'a machine that is not known here, {carried:08x}'}, not "
                  f"{self.machine}: the same signals, other constants", file=sys.stderr, flush=True)

    def _refusal(self, reported: int) -> str:
        if self._given is None:
            return (f"carries a machine that is not known here, of database {reported:08x}: state its file with "
                    f"{self._option}")
        carried = _first(reported, None)
        what = (f"carries {carried}, of database {reported:08x}" if carried is not None
                else f"carries another machine, of database {reported:08x}")
        return f"{what}, not {self._option} {self._stated}, of {self._given:08x}"
