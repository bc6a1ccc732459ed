"""Reports at the end the number of control periods found equal, and the flash and RAM use of the builds."""

from __future__ import annotations

import pytest

from salient.config import TARGET_BUILDS
from salient.target.baseline import size_table

_PROPERTY = "control_periods"
_SIZE = "size"


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    reports = [report for outcome in ("passed", "failed") for report in terminalreporter.stats.get(outcome, [])]
    made = dict(value for report in reports for name, value in report.user_properties if name == _SIZE)
    if made:
        terminalreporter.write_line(f"\n{size_table(made)}\n")
    compared = sum(value for report in terminalreporter.stats.get("passed", [])
                   for name, value in report.user_properties if name == _PROPERTY)
    if compared:
        terminalreporter.write_line(f"control periods of {', '.join(TARGET_BUILDS)} equal to the host's: {compared:,}")
