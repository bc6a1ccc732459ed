"""Reads TOML files of users: bounded in size and time, checked by a model, every mistake one line. Writes such tables.

A model is a subclass of Table. Its fields are tables or annotated with a check made here:

    speed_rpm: Annotated[float, number(0.0, 3000.0)]
"""

from __future__ import annotations

import json
import math
import re
import stat
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError, WrapValidator
from pydantic_core import PydanticCustomError

from salient import config
from salient.config import OPTIONS, either
from salient.errors import SHOWN_MAX, close_names, shown

TOML_BYTES_MAX = 1_000_000


class TextFileError(Exception):
    """A file that cannot be used; the text is the rest of a line that begins with its path."""


def read_text(path: Path, bytes_max: int) -> str:
    """The whole file, UTF-8 with or without a byte order mark."""
    try:
        return read_bytes(path, bytes_max).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise TextFileError(f"not UTF-8 at byte {error.start + 1}") from None


def read_bytes(path: Path, bytes_max: int) -> bytes:
    """The whole file."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise TextFileError("not a file")  # a pipe may block, a device may have no end
        if status.st_size > bytes_max:
            raise TextFileError(f"larger than {bytes_max // 1_000_000} MB")
        return path.read_bytes()
    except FileNotFoundError:
        raise TextFileError("no such file") from None
    except OSError as error:
        raise TextFileError(f"cannot be read: {error.strerror}") from None


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file of at most TOML_BYTES_MAX."""
    try:
        return tomllib.loads(read_text(path, TOML_BYTES_MAX))
    except tomllib.TOMLDecodeError as error:
        raise TextFileError(f"not TOML: {error}") from None
    except (ValueError, RecursionError):  # of tomllib itself
        raise TextFileError("not TOML: a number too long or tables too deep") from None


def toml_text(data: Mapping[str, Any], table: str = "") -> str:
    """Numbers, strings and tables, as read_toml gives them, as the text of a TOML file. table: of the values."""
    lines = [f"{key} = {toml_value(value)}" for key, value in data.items() if not isinstance(value, Mapping)]
    parts = ["\n".join([f"[{table}]", *lines] if table else lines)] if lines or table else []
    parts += [toml_text(value, f"{table}.{key}".lstrip(".")).rstrip("\n") for key, value in data.items()
              if isinstance(value, Mapping)]
    return "\n\n".join(parts) + "\n"


def toml_value(value: bool | int | float | str) -> str:
    """A number or string in TOML, exact."""
    if isinstance(value, bool):
        return str(value).lower()
    return json.dumps(value) if isinstance(value, str) else repr(value)


# --- checks ---------------------------------------------------------------------------------------------------------

class Table(BaseModel):
    """A table of a file: no other keys than its fields, no conversions."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


def number(low: float, high: float) -> WrapValidator:
    """float: a number from low to high, an integer or not."""
    return checked(f"a number from {low:g} to {high:g}", lambda value: low <= value <= high)


def any_number() -> WrapValidator:
    """float: a finite number."""
    return checked("a number", math.isfinite)


def whole(low: int, high: int) -> WrapValidator:
    """int: from low to high."""
    return checked(f"a whole number from {low} to {high}", lambda value: low <= value <= high)


def one_of(choices: tuple[str, ...]) -> WrapValidator:
    """str: one of some words."""
    return checked(either(choices), lambda value: value in choices)


def option(name: str) -> WrapValidator:
    """An option of the test bench, of the type of its field; 17.0 and true are not integers."""
    record = OPTIONS[name]
    if record.choices:
        return checked(record.allowed, lambda value: value in record.choices)
    if record.kind == config.INTEGER:
        return whole(int(record.minimum), int(record.maximum))
    if record.kind == config.NUMBER:
        return number(record.minimum, record.maximum)
    return checked(record.allowed)


def checked(allowed: str, accepts: Callable[[Any], bool] = lambda value: True) -> WrapValidator:
    """A check of a field; its mistakes, a wrong type included, all have the text "must be" and the values allowed."""

    def check(value: Any, validate: Any) -> Any:
        try:
            result = validate(value)
            if accepts(result):
                return result
        except ValidationError:
            pass
        raise PydanticCustomError("must_be", "{text}", {"text": f"must be {allowed}"})

    return WrapValidator(check)


# --- validation -----------------------------------------------------------------------------------------------------

_Model = TypeVar("_Model", bound=Table)


def validate(model: type[_Model], data: object, section: str = "") -> _Model:
    """The data as a model; TextFileError: key, value and what is allowed. section: the key of the data in the file."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise TextFileError(_one_line(error, model, section)) from None


def shown_key(name: str) -> str:
    """A wrong key in a message, as it stands unless it is long or needs quotes."""
    return name if re.fullmatch(r"\w+", name, re.ASCII) and len(name) <= SHOWN_MAX else shown(name)


def _one_line(error: ValidationError, model: type[Table], section: str) -> str:
    """The first mistake; an unknown key before others, because a misspelt key is missing as well."""
    found = min(error.errors(include_url=False), key=lambda each: each["type"] != "extra_forbidden")
    place = [part for part in found["loc"] if isinstance(part, str)]
    *parents, last = [*([section] if section else []), *place] or [""]
    key = ".".join([*parents, shown_key(last)])
    if found["type"] == "missing":
        return f"{key}: missing"
    if found["type"] == "extra_forbidden":
        return f"{key}: unknown key; {close_names(last, _keys(model, place[:-1]))}"
    if found["type"] == "string_type":
        return f"{key}: {shown(found['input'])}: must be a text"
    if found["type"] == "must_be":
        return f"{key}: {shown(found['input'])}: {found['msg']}"
    if found["type"] in ("model_type", "dict_type"):
        in_array = bool(found["loc"]) and isinstance(found["loc"][-1], int)
        return f"{key}: must be {f'tables [[{key}]]' if in_array else f'a table [{key}]'}"
    if found["type"] == "list_type":
        tables = _table_in(_annotation(model, place)) is not None
        return f"{key}: must be {f'tables [[{key}]]' if tables else 'an array'}"
    return f"{key}: {shown(found['input'])}: {found['msg']}"


def _annotation(model: Any, place: list[str]) -> Any:
    """The type at a place of a model."""
    for part in place:
        model = _table_in(model).model_fields[part].annotation
    return model


def _keys(model: Any, place: list[str]) -> list[str]:
    """The keys of the table at a place of a model."""
    return list(_table_in(_annotation(model, place)).model_fields)


def _table_in(annotation: Any) -> Any:
    """The Table of an annotation such as list[Table] or Table | None."""
    if get_origin(annotation) in (list, tuple, Union, UnionType):
        return next((found for part in get_args(annotation) if (found := _table_in(part)) is not None), None)
    return annotation if isinstance(annotation, type) and issubclass(annotation, Table) else None
