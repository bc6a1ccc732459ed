"""A loop over torque commands in the form of Gymnasium: reset() and step(action), in lock-step with virtual time.

The agent sees speed and reference and commands a torque every 2 ms; here it is a PI controller. Gymnasium itself is not
needed: a class with its spaces wraps this one.

    python torque_loop.py
"""

import tempfile

from salient.bench.bench import Bench
from salient.config import BenchConfig

STEP_S = 0.002
TORQUE_MAX_NM = 15.0


class SpeedTask:
    """Reach 300 r/min and hold it against a load that begins at 0.2 s."""

    def __init__(self, folder: str) -> None:
        self._address = f"unix:{folder}/can.sock"
        self._bench: Bench | None = None

    def reset(self, seed: int = 1) -> tuple[tuple[float, float], dict[str, float]]:
        """A new drive; returns observation and information."""
        self.close()
        self._bench = Bench(BenchConfig(seed=seed), self._address)
        self._bench.at(0.2).load_torque_Nm = 4
        self._bench.drive.torque_reference_Nm = 0
        self._bench.run_until(lambda: self._bench.drive.state == "run", timeout=0.05)
        return self._observation(), {}

    def step(self, torque_Nm: float) -> tuple[tuple[float, float], float, bool, bool, dict[str, float]]:
        """One action; returns observation, reward, terminated, truncated and information."""
        self._bench.drive.torque_reference_Nm = max(-TORQUE_MAX_NM, min(TORQUE_MAX_NM, torque_Nm))
        self._bench.run_for(STEP_S)
        speed_rpm, reference_rpm = self._observation()
        reward = -abs(speed_rpm - reference_rpm) / reference_rpm
        terminated = self._bench.drive.state == "fault"
        return (speed_rpm, reference_rpm), reward, terminated, self._bench.time_s >= 0.4, {}

    def close(self) -> None:
        """Ends the drive."""
        if self._bench is not None:
            self._bench.close()
            self._bench = None

    def _observation(self) -> tuple[float, float]:
        return self._bench.telemetry["DRIVE_MOTION.speed_rpm"].last, 300.0


def main() -> None:
    """One episode."""
    with tempfile.TemporaryDirectory() as folder:
        run_episode(SpeedTask(folder))


def run_episode(task: SpeedTask) -> None:
    """Until the task is terminated or truncated."""
    (speed_rpm, reference_rpm), _ = task.reset()
    integral_Nm, total = 0.0, 0.0
    ended = False
    while not ended:
        error_rpm = reference_rpm - speed_rpm
        integral_Nm = max(-5.0, min(5.0, integral_Nm + 0.005 * error_rpm))
        (speed_rpm, reference_rpm), reward, terminated, truncated, _ = task.step(0.06 * error_rpm + integral_Nm)
        total += reward
        ended = terminated or truncated
    task.close()
    print(f"return {total:.1f}, speed {speed_rpm:.0f} r/min")


main()
