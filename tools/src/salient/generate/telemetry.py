"""The cyclic messages of a node in C: a structure of all their signals, a function that packs it, and the schedule.

The schedule comes from the database: GenMsgCycleTime and GenMsgStartDelayTime in ms; GenMsgSendType cyclicIfActive
marks messages that are sent only while their cause lasts; the enumeration TelemetryGroup names the messages that are
queued together; PhasesAbove those that only a machine of more phases sends; TelemetryRate those whose period can be
set, GenMsgCycleTime being its default.
"""

from __future__ import annotations

import math

from cantools.database.can.c_source import camel_to_snake_case
from cantools.database.can.database import Database
from cantools.database.can.message import Message
from cantools.database.can.signal import Signal

from salient.dbc import attributes, phases_above
from salient.generate.error import CodecError
from salient.generate.ranges import raw_range


def telemetry(database: Database, prefix: str, dbc_name: str, node: str) -> tuple[str, str]:
    """Texts of <prefix>_telemetry.h and <prefix>_telemetry.c: what `node` sends cyclically."""
    messages = [m for m in database.messages if node in m.senders and m.cycle_time]
    if not messages:
        raise CodecError(f"node {node} sends no cyclic message: GenMsgCycleTime is required")
    for signal in (signal for message in messages for signal in message.signals):
        if signal.is_float or signal.length > 32 or signal.byte_order != "little_endian":
            raise CodecError(f"signal {signal.name}: cyclic messages have little-endian integers of at most 32 bits")
    assert database.dbc is not None  # as every DBC has
    groups, rates = (list(database.dbc.attribute_definitions[name].choices)
                     for name in ("TelemetryGroup", "TelemetryRate"))
    messages.sort(key=lambda m: (groups.index(_group(m, groups)), m.frame_id))
    cycle_ms = math.gcd(*map(_period_ms, messages), *map(_delay_ms, messages))
    return _header(messages, groups, rates, prefix, dbc_name, cycle_ms), _source(messages, prefix, dbc_name, cycle_ms)


def short_name(message: Message, prefix: str) -> str:
    """Name of a message within its node: DRIVE_STATUS is status."""
    return camel_to_snake_case(message.name).removeprefix(f"{prefix}_")


def _group(message: Message, groups: list[str]) -> str:
    return groups[_group_number(message)]


def _group_number(message: Message) -> int:
    return int(attributes(message).get("TelemetryGroup", 0))


def _rate_number(message: Message) -> int:
    return int(attributes(message).get("TelemetryRate", 0))


def _period_ms(message: Message) -> int:
    assert message.cycle_time is not None  # cyclic
    return message.cycle_time


def _delay_ms(message: Message) -> int:
    return int(attributes(message).get("GenMsgStartDelayTime", 0))


def is_bit_field(message: Message) -> bool:
    """True for a message of one-bit signals only, which is one 64-bit member: bit n of it is bit n of the frame."""
    return len(message.signals) > 1 and all(s.length == 1 and not s.is_signed for s in message.signals)


def _member_type(signal: Signal) -> str:
    return f"{'' if signal.is_signed else 'u'}int32_t"


def _header(messages: list[Message], groups: list[str], rates: list[str], prefix: str, dbc_name: str,
            cycle_ms: int) -> str:
    guard, upper = f"{prefix.upper()}_TELEMETRY_H", prefix.upper()
    members = []
    for message in messages:
        name = short_name(message, prefix)
        if is_bit_field(message):
            members.append(f"    uint64_t {name}; /* {message.name}: bit n is the signal at bit n */")
            continue
        members.append("    struct {")
        for signal in message.signals:
            lsb = f"LSB {signal.scale} {signal.unit or ''}".rstrip()
            members.append(f"        {_member_type(signal)} {camel_to_snake_case(signal.name)}; /* {lsb} */")
        members.append(f"    }} {name}; /* {message.name} */")
    indices = [f"    {upper}_TELEMETRY_{short_name(m, prefix).upper()}," for m in messages]
    group_names = [f"    {upper}_TELEMETRY_GROUP_{group.upper()}," for group in groups]
    rate_names = [f"    {upper}_TELEMETRY_RATE_{rate.upper()}," for rate in rates]
    return f"""/* Cyclic messages of {dbc_name}; generated. */
#ifndef {guard}
#define {guard}

#include <stdbool.h>
#include <stdint.h>

/* Greatest common divisor of all cycle and delay times. */
#define {upper}_TELEMETRY_CYCLE_MS {cycle_ms}

/* All signals of the cyclic messages in the LSBs of the bus. A member is wider than its signal wherever a value can be
 * out of the signal's range: {prefix}_telemetry_pack() saturates. */
typedef struct {{
{chr(10).join(members)}
}} {prefix}_telemetry_t;

/* Messages that are queued together. */
typedef enum {{
{chr(10).join(group_names)}
}} {prefix}_telemetry_group_t;

/* Messages whose common period can be set, all but the first. */
typedef enum {{
{chr(10).join(rate_names)}
    {upper}_TELEMETRY_RATES
}} {prefix}_telemetry_rate_t;

/* Messages in the order of transmission: by group, within a group by identifier. */
enum {{
{chr(10).join(indices)}
    {upper}_TELEMETRY_MESSAGES
}};

typedef struct {{
    uint32_t identifier;
    uint8_t length;
    uint8_t group;   /* {prefix}_telemetry_group_t */
    uint8_t rate;    /* {prefix}_telemetry_rate_t */
    bool if_active;  /* sent only while its cause lasts (cyclicIfActive) */
    uint8_t phases_above; /* only a machine of more phases sends it (PhasesAbove) */
    uint16_t period; /* {upper}_TELEMETRY_CYCLE_MS; of a rate that can be set the default */
    uint16_t delay;  /* of the first frame after start, {upper}_TELEMETRY_CYCLE_MS */
}} {prefix}_telemetry_message_t;

extern const {prefix}_telemetry_message_t {prefix}_telemetry_messages[{upper}_TELEMETRY_MESSAGES];

/* Packs the signals of a message, an index of {prefix}_telemetry_messages, saturated to their ranges, into the bytes of
 * its frame. */
void {prefix}_telemetry_pack(unsigned message, const {prefix}_telemetry_t *telemetry, uint8_t data[8]);

#endif
"""


def _source(messages: list[Message], prefix: str, dbc_name: str, cycle_ms: int) -> str:
    upper = prefix.upper()
    ranges: dict[str, int] = {}  # row of the table: its index
    rows: list[str] = []
    signals: list[str] = []
    layouts: list[str] = []
    bit_fields: list[str] = []
    for message in messages:
        name = short_name(message, prefix)
        members = [] if is_bit_field(message) else message.signals
        if is_bit_field(message):
            mask = sum(1 << s.start for s in message.signals)
            bit_fields.append(f"    if (message == {upper}_TELEMETRY_{name.upper()}) {{")
            bit_fields.append(f"        frame = telemetry->{name} & {mask:#x}u;\n    }}")
        layouts.append(f"    {{offsetof({prefix}_telemetry_t, {name}), {len(signals)}u, {len(members)}u}},")
        for signal in members:
            low, high = raw_range(signal)
            # An unsigned value has no bits that need to be cut off.
            bits = signal.length if signal.is_signed else 32
            row = f"    {{{low}, {high & 0xFFFFFFFF}u, {bits}u, {str(signal.is_signed).lower()}}},"
            index = ranges.setdefault(row, len(ranges))
            signals.append(f"    {{{signal.start}u, {index}u}}, /* {message.name}.{signal.name} */")
        delay, period = _delay_ms(message) // cycle_ms, _period_ms(message) // cycle_ms
        group = _group_number(message)
        active = str(message.send_type == "cyclicIfActive").lower()
        rows.append(
            f"    {{{message.frame_id:#x}u, {message.length}u, {group}u, {_rate_number(message)}u, {active}, "
            f"{phases_above(message)}u, {period}u, {delay}u}},"
        )
    new_line = "\n"
    return f"""/* Cyclic messages of {dbc_name}; generated. */
#include "{prefix}_telemetry.h"

#include <stddef.h>

const {prefix}_telemetry_message_t {prefix}_telemetry_messages[{upper}_TELEMETRY_MESSAGES] = {{
{new_line.join(rows)}
}};

/* Values that a signal can have. */
typedef struct {{
    int32_t low;
    uint32_t high;
    uint8_t bits; /* kept of a value within the range */
    bool is_signed;
}} range_t;

static const range_t ranges[] = {{
{new_line.join(ranges)}
}};

/* Signal in its frame, in the order of the members of {prefix}_telemetry_t. */
typedef struct {{
    uint8_t start; /* bit */
    uint8_t range;
}} signal_t;

static const signal_t signals[] = {{
{new_line.join(signals)}
}};

/* Members and signals of a message. A message of one-bit signals has none: its member is the frame. */
typedef struct {{
    uint16_t offset;
    uint8_t first_signal;
    uint8_t signals;
}} layout_t;

static const layout_t layouts[{upper}_TELEMETRY_MESSAGES] = {{
{new_line.join(layouts)}
}};

static uint32_t saturate(uint32_t member, const range_t *range)
{{
    const int64_t value = range->is_signed ? (int64_t)(int32_t)member : (int64_t)member;
    const int64_t high = range->is_signed ? (int64_t)(int32_t)range->high : (int64_t)range->high;
    const int64_t saturated = value < range->low ? range->low : value > high ? high : value;
    return (uint32_t)saturated << (32u - range->bits) >> (32u - range->bits);
}}

void {prefix}_telemetry_pack(unsigned message, const {prefix}_telemetry_t *telemetry, uint8_t data[8])
{{
    const layout_t *layout = &layouts[message];
    const uint32_t *member = (const uint32_t *)((const char *)telemetry + layout->offset);
    uint64_t frame = 0;
{new_line.join(bit_fields)}
    for (unsigned i = 0; i < layout->signals; i++) {{
        const signal_t *signal = &signals[layout->first_signal + i];
        frame |= (uint64_t)saturate(member[i], &ranges[signal->range]) << signal->start;
    }}
    for (unsigned i = 0; i < {prefix}_telemetry_messages[message].length; i++) {{
        data[i] = (uint8_t)(frame >> 8 * i);
    }}
}}
"""


def message_c_name(message: Message, prefix: str) -> str:
    """Name of a message in C: the prefix of the database once, whether or not the message's name has it."""
    return f"{prefix}_{short_name(message, prefix)}"
