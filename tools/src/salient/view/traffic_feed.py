"""The traffic of a bus as a page shows it."""

from __future__ import annotations

from collections import deque
from typing import Any

import can

from salient.bus.traffic import MessageReport, Report, Traffic

_PERIOD_NS = 500_000_000
_EVENTS_KEPT = 100
_UNKNOWN_SHOWN = 50
_MS_NS = 1e6


class TrafficFeed:
    """Takes frames, and keeps what a page shows: each half second of the bus, or of all time once it is finished."""

    def __init__(self, traffic: Traffic, *, of_all_time: bool = False) -> None:
        self._traffic = traffic
        self._of_all_time = of_all_time
        self._due_ns: int | None = None
        self._events: deque[tuple[int, str]] = deque(maxlen=_EVENTS_KEPT)
        self.state: dict[str, Any] | None = None
        """Traffic of page/source.js; None before the first."""

    def add(self, time_ns: int, message: can.Message) -> None:
        """Takes a frame."""
        self._traffic.add(time_ns, message)
        if self._of_all_time:
            return
        if self._due_ns is None or time_ns < self._due_ns - _PERIOD_NS:
            self._due_ns = time_ns + _PERIOD_NS
        elif time_ns >= self._due_ns:
            self._due_ns = time_ns + _PERIOD_NS
            self._show(self._traffic.report())

    def finish(self) -> None:
        """There are no more frames."""
        self._show(self._traffic.total())

    def _show(self, report: Report) -> None:
        self._events += ((event.time_ns, event.text) for event in self._traffic.take_events())
        self.state = {
            "load": report.load, "peak": report.peak, "frames": report.frames, "errors": report.errors,
            "duration_s": report.duration_ns * 1e-9,
            "nodes": [{"name": node.name, "share": node.share, "silent": node.is_silent,
                       "messages": [_message(message) for message in node.messages]} for node in report.nodes],
            "unknown": [_message(message) for message in report.unknown[:_UNKNOWN_SHOWN]],
            "unknown_count": len(report.unknown),
            "events": [{"time_ns": time_ns, "text": text} for time_ns, text in self._events],
        }


def _message(message: MessageReport) -> dict[str, Any]:
    return {"id": message.identifier, "name": message.name, "frames": message.frames, "state": message.state,
            "cycle_ms": None if message.cycle_ns is None else message.cycle_ns / _MS_NS,
            "expected_ms": message.expected_ns / _MS_NS or None,
            "shortest_ms": message.shortest_ns / _MS_NS, "longest_ms": message.longest_ns / _MS_NS}
