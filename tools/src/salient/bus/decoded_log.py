"""Common parts of logs of decoded signals: the frames that wait, and the machine that decodes them."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import can
from cantools.database.can import Database

from salient.bus.file_log import FileLog
from salient.bus.identity import Carrier, OtherDatabase
from salient.bus.signals import BusSignals, SignalTable, drive_database, rig_database


class DecodedLog(FileLog):
    """Frames that no database defines are left out: other identifiers and lengths, remote and error frames, and of
    drive and test bench all frames of a flexible data rate. others: databases of other nodes (load_databases).

    write raises OtherDatabase, as Carrier does: with the first report of another machine than the one that is stated,
    or of an unknown one, and then there is no file; or when the drive becomes another one, and the file ends there.
    """

    def __init__(self, path: Path, carrier: Carrier, node: int, source: str, others: Sequence[Database] = ()) -> None:
        super().__init__(path)
        self._others = tuple(others)
        self._carrier, self._node, self._source = carrier, node, source
        self._tables = self._new_tables()
        self._refused = self._closed = False

    def _databases(self, machine: str | None) -> tuple[Database, ...]:
        return drive_database(machine, self._node), rig_database(self._node), *self._others

    def _new_tables(self) -> tuple[SignalTable, ...]:
        drive, rig, *others = self._databases(None)
        return SignalTable(drive), SignalTable(rig), *map(BusSignals, others)

    def _take(self, time_ns: int, message: can.Message) -> bool:
        """Keeps a frame; True once the machine is known. OtherDatabase."""
        try:
            known = self._carrier.take(message)
        except OtherDatabase:
            if self._carrier.machine is None:
                self.path.unlink(missing_ok=True)
                self._refused = True
            raise
        for table in self._tables:
            table.add(time_ns, message)
        return known

    @property
    def _waiting(self) -> int:
        """Frames that are kept."""
        return sum([table.frames for table in self._tables])

    @property
    def _waiting_bytes(self) -> int:
        """Their memory."""
        return sum([table.memory_bytes for table in self._tables])

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        if not self._refused:
            if self._carrier.machine is None and len(self._tables[0]["DRIVE_STATUS.state"]):
                print(f"salient: {self._source}: no DRIVE_IDENTITY: {self.path} has the signals of "
                      f"{self._carrier.likely}; --machine states another", file=sys.stderr)
            self._write_kept()
        self._finish()

    def _write_kept(self) -> None:
        """Writes the frames that are kept, as frames of the likely machine."""
        raise NotImplementedError

    def _finish(self) -> None:
        """Closes the file."""
        raise NotImplementedError
