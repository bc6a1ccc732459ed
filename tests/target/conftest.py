"""Says in the end how many control periods were found equal."""

from __future__ import annotations

import pytest

from salient.simulator import TARGET_BUILDS

_PROPERTY = "control_periods"


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    compared = sum(value for report in terminalreporter.stats.get("passed", [])
                   for name, value in report.user_properties if name == _PROPERTY)
    if compared:
        terminalreporter.write_line(f"control periods of {', '.join(TARGET_BUILDS)} equal to the host's: {compared:,}")
