"""JSON of the results, for programs of every language: a number that there is not is null, as JSON has no NaN."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any


def json_text(content: Any, *, indent: int = 2, sort_keys: bool = False) -> str:
    """The text of a file; floats that are not finite are null."""
    return json.dumps(_finite(content), indent=indent, sort_keys=sort_keys, allow_nan=False) + "\n"


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _finite(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return value
