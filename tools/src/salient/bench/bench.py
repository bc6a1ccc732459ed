"""A drive and its test bench on a bus for them alone, in lock-step: the value of the pytest fixture `bench`.

    bench.drive.speed_reference_rpm = 600
    bench.at(0.13).load_torque_Nm = 8
    bench.run_for(0.2)
    assert bench.truth["speed_rpm"].last == pytest.approx(600, abs=3)
"""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path

from salient.bench.emulator import EmulatorProcess, parameter_table
from salient.bench.session import Session
from salient.bus.log import write_logs
from salient.config import BenchConfig

LAST_MOMENTS_S = 0.05
TELEMETRY_PERIOD_MS = 1
"""Of a bench, unless its configuration states one; a bus with one drive alone has room for it."""


class Bench(Session):
    """A session with an emulator that it starts and ends.

    config: its pace is not used, a bench is in lock-step; its telemetry_period_ms is 1 unless stated,
    with several drives that of the parameter. can: "unix:PATH" or "socketcan:INTERFACE", one bench at
    a time on an interface. options: the configuration. simulator: the process.
    """

    options: BenchConfig
    simulator: EmulatorProcess

    def __init__(self, config: BenchConfig, can: str) -> None:
        period_ms = config.telemetry_period_ms or (TELEMETRY_PERIOD_MS if config.drives == 1 else None)
        self.options = replace(config, pace="lockstep", telemetry_period_ms=period_ms)
        self.simulator = EmulatorProcess(self.options, can)
        try:
            super().__init__(can, parameter_table=lambda: parameter_table(config),
                             is_alive=lambda: self.simulator.is_alive, machine=config.machine, node=config.node,
                             drives=config.drives)
        except BaseException:
            self.simulator.close()
            raise

    def close(self) -> None:
        """Ends session and emulator; EmulatorError when the exit code of the emulator is not 0."""
        try:
            super().close()
        finally:
            self.simulator.close()

    def save(self, folder: Path, replay: str) -> None:
        """Writes the evidence of a failure: log (BLF and candump text), plot of the last moments, seed and command
        line, the commands that show and replay it, and a page of all that."""
        from salient.pages import Plot, write_page

        folder.mkdir(parents=True, exist_ok=True)
        write_logs(self.log, folder / "can.blf", folder / "can.log")
        notes = {
            "virtual_time_s": self.time_s,
            "seed": self.options.seed,
            "machine": self.options.machine,
            "node": self.options.node,
            "simulator": shlex.join(self.simulator.command),
            "replay": replay,
            "view": f"tools/salient view --replay {shlex.quote(str(folder))}",
            "stderr": self.simulator.errors,
        }
        (folder / "bench.json").write_text(json.dumps(notes, indent=2) + "\n", encoding="utf-8")
        plot_last_moments(self, folder / "last_moments.png")
        plot = Plot("", f"The last {LAST_MOMENTS_S * 1e3:g} ms", (folder / "last_moments.png").read_bytes())
        write_page(folder / "failure.html", "failure.html", {**notes, "plot": plot})


def plot_last_moments(session: Session, path: Path) -> None:
    """Speed, torque and phase currents, true and in the telemetry, over the last LAST_MOMENTS_S."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = (
        [("telemetry", "DRIVE_MOTION.speed_reference_rpm"), ("telemetry", "speed_rpm"), ("truth", "speed_rpm")],
        [("telemetry", "torque_reference_Nm"), ("telemetry", "torque_estimate_Nm"), ("truth", "torque_Nm"),
         ("truth", "load_torque_Nm")],
        [("truth", f"current_{phase}_A") for phase in "abcd"],
    )  # fmt: skip
    figure = Figure(figsize=(10, 9), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, panel in zip(figure.subplots(len(panels), 1, sharex=True), panels, strict=True):
        for source, name in panel:
            signal = getattr(session, source)[name].between(session.time_s - LAST_MOMENTS_S, session.time_s + 1e-9)
            axes.plot(signal.time_s, signal.value, label=f"{source} {signal.name}", marker=".", markersize=3)
            axes.set_ylabel(signal.unit)
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize="small")
        axes.grid(alpha=0.3)
    axes.set_xlabel("virtual time, s")
    figure.savefig(path, dpi=90)
