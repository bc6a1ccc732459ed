"""The traffic of a bus as text."""

from __future__ import annotations

from collections.abc import Iterator

from salient.bus.traffic import Event, MessageReport, Report

_UNKNOWN_SHOWN = 20
_MS_NS = 1_000_000


def event_line(event: Event) -> str:
    """A line of monitor."""
    return f"{event.time_ns * 1e-9:10.4f} s  {event.text}"


def load_text(report: Report) -> str:
    """Load, and what is not as it should be, for the end of a line."""
    text = f"bus {100.0 * report.load:5.1f} %"
    missing = sum(message.state == "missing" for node in report.nodes for message in node.messages)
    if missing:
        text += f", {missing} missing"
    if report.unknown:
        text += f", {len(report.unknown)} unknown"
    return text


def report_lines(report: Report) -> Iterator[str]:
    """The table of a span of time: the bus, its nodes with their messages, and what is of no database."""
    begin_ns = report.time_ns - report.duration_ns
    yield (f"bus {begin_ns * 1e-9:.4f} to {report.time_ns * 1e-9:.4f} s: load {100.0 * report.load:.2f} % (of 100 ms "
           f"at most {100.0 * report.peak:.1f} %), {report.frames} frames, {report.errors} error frames")
    names = [f"{message.name}" for node in report.nodes for message in node.messages]
    width = max(map(len, names), default=0)
    for node in report.nodes:
        yield f"  {node.name}: {100.0 * node.share:.2f} %{', silent' if node.is_silent else ''}"
        for message in node.messages:
            yield f"    {message.identifier:>8} {message.name:<{width}} {_figures(message)}"
    if report.unknown:
        further = f", and {report.further_unknown} frames of further ones" if report.further_unknown else ""
        yield f"  unknown: {len(report.unknown)} identifiers{further}"
        for message in report.unknown[:_UNKNOWN_SHOWN]:
            yield f"    {message.identifier:>8} {'':<{width}} {_figures(message)}"
        if len(report.unknown) > _UNKNOWN_SHOWN:
            yield f"    and {len(report.unknown) - _UNKNOWN_SHOWN} more"


def _figures(message: MessageReport) -> str:
    cycle = "-" if message.cycle_ns is None else f"{message.cycle_ns / _MS_NS:.3f}"
    text = f"{message.frames:>7} frames  cycle {cycle:>9} ms"
    if message.expected_ns:
        text += f", expected {message.expected_ns / _MS_NS:>5g} ms"
    if message.cycle_ns is not None:
        text += f", {message.shortest_ns / _MS_NS:.3f} to {message.longest_ns / _MS_NS:.3f} ms"
    return text + (f"  {message.state}" if message.state else "")
