"""Types of the fixture `bench`, for annotations in a suite: its names are completed in an editor.

    from salient.suite import Bench

    def test_load_step(bench: Bench) -> None: ...
"""

from salient.bench.bench import Bench
from salient.bench.drive import Drive, Parameters
from salient.bench.rig import Fault, Rig
from salient.bus.signals import Signal

__all__ = ["Bench", "Drive", "Fault", "Parameters", "Rig", "Signal"]
