"""Analyses a CAN log with pandas: how closely the drive followed its speed reference.

    python analyse_log.py FILE.blf drive.dbc
"""

import sys

import can
import cantools
import pandas as pd


def read_log(log: str, dbc: str) -> pd.DataFrame:
    """The signals of the drive, a column each, over virtual time in seconds."""
    database = cantools.database.load_file(dbc)
    rows = []
    with can.LogReader(log) as frames:
        for frame in frames:
            try:
                message = database.get_message_by_frame_id(frame.arbitration_id)
            except KeyError:
                continue  # of the test bench
            if "DRIVE" in message.senders and len(frame.data) == message.length:
                values = message.decode(bytes(frame.data), decode_choices=False)
                rows.append({"time_s": frame.timestamp,
                             **{f"{message.name}.{name}": value for name, value in values.items()}})
    return pd.DataFrame(rows).set_index("time_s")


def main() -> None:
    """Prints speed error and torque in each tenth of a second."""
    signals = read_log(*sys.argv[1:3])
    motion = signals.filter(like="DRIVE_MOTION.").dropna(how="all").rename(columns=lambda name: name.split(".")[1])
    motion["error_rpm"] = motion["speed_rpm"] - motion["speed_reference_rpm"]
    tenths = motion.groupby((motion.index * 10).astype(int) / 10)["error_rpm"]
    print(tenths.agg(["count", "mean", "std", "max"]).to_string(float_format=lambda value: f"{value:.3f}"))


main()
