"""Recordings of the drive's triggered buffer (salient.bench.sampler): arrays with names and units, as a file that other
tools read and as a plot."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from salient.bench.variables import SIGNALS, short_names
from salient.bus.mf4 import names_conversion
from salient.config import either
from salient.errors import UsageError, close_names, optional_package

FORMATS = (".csv", ".mf4", ".parquet")
COLOURS = ("#0072b2", "#d55e00", "#000000", "#56b4e9", "#7711dd", "#996655")
"""Colours of the live page (view/page/palette.js)."""
_MS_PER_S = 1000.0
_DEFLATE = 1


@dataclass(frozen=True)
class Recording:
    """Contents of the buffer. time_s: from the trigger on, whose event is 0; values: by signal, in its unit; names: of
    the values of enumerations."""

    time_s: np.ndarray
    values: Mapping[str, np.ndarray]
    units: Mapping[str, str]
    names: Mapping[str, Mapping[int, str]]

    def __getitem__(self, signal: str) -> np.ndarray:
        if signal not in self.values:
            raise KeyError(f"'{signal}' was not recorded; {close_names(signal, list(self.values))}")
        return self.values[signal]

    def __iter__(self) -> Iterator[str]:
        return iter(self.values)

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """time_s and the signals."""
        return {"time_s": self.time_s, **self.values}

    def write(self, path: str | Path) -> None:
        """A file of one row for each record, by its ending: .csv, .parquet (units as metadata of its fields) or .mf4
        (with the names of enumerations). UsageError: another ending, or a package that is missing."""
        path = Path(path)
        check_ending(path)
        {".csv": self._write_csv, ".mf4": self._write_mf4, ".parquet": self._write_parquet}[path.suffix](path)

    def plot(self, path: Path, title: str) -> None:
        """Each signal over the time from the trigger on."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        figure = Figure(figsize=(10, 1.5 + 1.6 * len(self.values)), layout="constrained")
        FigureCanvasAgg(figure)
        axes = np.atleast_1d(figure.subplots(len(self.values), 1, sharex=True))
        time_ms = self.time_s * _MS_PER_S
        for axis, (name, values), colour in zip(axes, self.values.items(), COLOURS * 2, strict=False):
            axis.step(time_ms, values, where="post", color=colour, linewidth=1)
            axis.axvline(0.0, color="grey", linewidth=0.8)
            label_axes(axis, name if name in SIGNALS else f"{name}, {self.units[name]}".rstrip(", "))
            if name in self.names:
                labels = short_names(self.names[name])
                axis.set_yticks(list(labels), list(labels.values()))
        axes[-1].set_xlabel("time from the trigger, ms")
        figure.suptitle(title)
        figure.savefig(path, dpi=110, metadata={"Software": None})

    def _write_csv(self, path: Path) -> None:
        write_columns(self.columns, path)

    def _write_parquet(self, path: Path) -> None:
        arrow = optional_package("pyarrow", f"{path}: Parquet")
        parquet = optional_package("pyarrow.parquet", f"{path}: Parquet")
        units = {"time_s": "s", **self.units}
        fields = [arrow.field(name, arrow.from_numpy_dtype(values.dtype), metadata={"unit": units[name]})
                  for name, values in self.columns.items()]
        parquet.write_table(arrow.table(list(self.columns.values()), schema=arrow.schema(fields)), path)

    def _write_mf4(self, path: Path) -> None:
        asammdf = optional_package("asammdf", f"{path}: MF4")
        with asammdf.MDF(version="4.10") as file:
            file.append([asammdf.Signal(values, self.time_s, name=name, unit=self.units[name],
                                        conversion=names_conversion(self.names[name]) if name in self.names else None)
                         for name, values in self.values.items()], acq_name="scope", common_timebase=True)
            file.save(path, overwrite=True, compression=_DEFLATE)


def check_ending(path: Path) -> None:
    """UsageError: the ending is not in FORMATS."""
    if path.suffix not in FORMATS:
        raise UsageError(f"{path}: must end with {either(FORMATS)}")


def label_axes(axes: Any, name: str) -> None:
    """Name of the quantity, its values without an offset, a grid."""
    axes.set_ylabel(name, fontsize="small")
    axes.ticklabel_format(useOffset=False)
    axes.grid(alpha=0.3)


def write_columns(of: Mapping[str, np.ndarray], path: Path) -> None:
    """Comma-separated values, a column for each array."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(of)
        writer.writerows([f"{value:.9g}" for value in row] for row in zip(*of.values(), strict=True))
