"""Checked values out of a message body: what SPEC section 4 promises, or DataError."""

import math
import struct
import sys
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import msgpack

from rig_protocol.errors import DataError
from rig_protocol.security import Cipher

Fields = Mapping[str, Any]
T = TypeVar("T")


def unpack_map(body: bytes) -> Fields:
    """The one MessagePack map with string keys that fills `body`."""
    try:
        values = msgpack.unpackb(body, raw=False, strict_map_key=True)
    except (ValueError, TypeError, RecursionError) as error:
        raise DataError(f"the body is no MessagePack map: {error!r}") from error
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        raise DataError("the body is no MessagePack map with string keys")
    return values


def unpack_fixed(layout: struct.Struct, body: bytes) -> tuple[Any, ...]:
    """The fields of a body of exactly the layout's size."""
    if len(body) != layout.size:
        raise DataError(f"a body of {len(body)} bytes where {layout.size} are due")
    return layout.unpack(body)


def integer(values: Fields, key: str, lowest: int, highest: int) -> int:
    """An integer in [lowest, highest]; a boolean is none."""
    value = values.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or not lowest <= value <= highest:
        raise DataError(f"{key} must be an integer from {lowest} to {highest}")
    return value


def number(values: Fields, key: str, lowest: float = -math.inf, highest: float = math.inf) -> float:
    """A finite number in [lowest, highest]."""
    value = values.get(key)
    if isinstance(value, int | float) and not isinstance(value, bool):
        # An integer of JSON may be too large for a float.
        finite = math.isfinite(value) if isinstance(value, float) else abs(value) <= sys.float_info.max
        if finite and lowest <= value <= highest:
            return float(value)
    raise DataError(f"{key} must be a finite number from {lowest} to {highest}")


def text(values: Fields, key: str, longest: int, shortest: int = 1) -> str:
    """Printable text of [shortest, longest] bytes in UTF-8."""
    value = values.get(key)
    if (
        not isinstance(value, str)
        or not value.isprintable()
        or not shortest <= len(value.encode()) <= longest
    ):
        raise DataError(f"{key} must be printable text of {shortest} to {longest} bytes")
    return value


def flag(values: Fields, key: str, optional: bool = True) -> bool:
    """A boolean; an optional one is false where it is absent."""
    value = values.get(key, False if optional else None)
    if not isinstance(value, bool):
        raise DataError(f"{key} must be true or false")
    return value


def control_value(values: Fields, key: str, longest: int) -> bool | float | str:
    """What a control is set to: a boolean, a finite number or a word."""
    value = values.get(key)
    if isinstance(value, bool):
        return value
    return text(values, key, longest) if isinstance(value, str) else number(values, key)


def optional(read: Callable[..., T], values: Fields, key: str, *limits: int) -> T | None:
    """What `read` yields, or None where the value is nil; an absent key is an error."""
    if key in values and values[key] is None:
        return None
    return read(values, key, *limits)


def codec_ids(values: Fields, key: str, most: int) -> tuple[int, ...]:
    """At most `most` codec ids from 1 to 255."""
    ids = values.get(key)
    if not isinstance(ids, list) or len(ids) > most:
        raise DataError(f"{key} must be a list of at most {most} codec ids")
    return tuple(integer({key: item}, key, 1, 255) for item in ids)


def cipher(value: Any) -> Cipher:
    """A cipher that this version knows."""
    try:
        return Cipher(value)
    except ValueError as error:
        raise DataError("cipher must be one that this version knows") from error


def ciphers(values: Fields, key: str) -> tuple[Cipher, ...]:
    """The known ones of the ciphers offered, in their order; at least one."""
    known = {int(one): one for one in Cipher}
    found = tuple(known[id_] for id_ in codec_ids(values, key, len(known) + 6) if id_ in known)
    if not found:
        raise DataError(f"{key} offers no cipher that this version knows")
    return found


def gauges(values: Fields, key: str, most: int, longest_name: int) -> dict[str, float]:
    """At most `most` numbers by name."""
    items = values.get(key)
    if not isinstance(items, dict) or len(items) > most:
        raise DataError(f"{key} must be a map of at most {most} numbers")
    return {text({key: name}, key, longest_name): number(items, name) for name in items}
