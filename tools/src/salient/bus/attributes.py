"""Attributes (BA_) of the messages and signals of a CAN database."""

from __future__ import annotations

from typing import Any

from cantools.database.can.message import Message
from cantools.database.can.signal import Signal


def attributes(owner: Message | Signal) -> dict[str, Any]:
    """Values of the attributes that the database sets, by name; of an enumeration the number or the text as written."""
    if owner.dbc is None:
        return {}
    return {name: attribute.value for name, attribute in owner.dbc.attributes.items()}
