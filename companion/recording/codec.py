"""Messages as JSON and back, exact to the last bit: readable in Foxglove, comparable byte by byte in replay.

Floats are written as Python's shortest exact form. What JSON has no word for (inf, nan) becomes a string; arrays of
more than 64 numbers become base64 of their little-endian bytes.
"""

from __future__ import annotations

import base64
import dataclasses
import functools
import json
import math
import types
import typing
from collections.abc import Callable, Iterable
from enum import Enum
from typing import Any, TypeVar

import numpy as np

from companion import messages

MAX_LISTED = 64
Encoder = Callable[[Any], Any]
T = TypeVar("T")

_NAMESPACE = vars(messages)


def encode(message: object) -> bytes:
    """JSON of a message: its fields by name, in their order."""
    try:
        return "".join(_finite_pieces(_fields_of(message), 0)).encode()
    except (TypeError, ValueError):  # an inf or nan somewhere, or keys that are no strings: rare, and spelt out
        return _dump(_encode_fields(message))


def encode_value(value: object) -> bytes:
    """JSON of plain values, messages, arrays and dicts of them; never fails on inf or nan."""
    return _dump(_value(value))


def fields(data: bytes) -> dict[str, Any]:
    """A message's fields as plain values. Raises: ValueError: not the JSON of a message."""
    content = json.loads(data)
    if not isinstance(content, dict):
        raise ValueError("expected an object")
    return content


def decode(kind: type[T], data: bytes) -> T:
    """The message again. Raises: ValueError, KeyError, TypeError: not the JSON of such a message."""
    value: T = _decode(kind, json.loads(data))
    return value


_dump_text = json.JSONEncoder(separators=(",", ":"), allow_nan=False, check_circular=False).encode


def _dump(value: object) -> bytes:
    return _dump_text(value).encode()


@functools.cache
def _field_names(kind: Any) -> tuple[str, ...]:
    return tuple(f.name for f in dataclasses.fields(kind))


def _fields_of(message: Any) -> dict[str, Any]:
    return {name: getattr(message, name) for name in _field_names(message.__class__)}


def _unlisted(value: Any) -> Any:
    """What JSON's encoder asks for: the same as `_value` gives, but arrays are not looked through for inf and nan, which
    it refuses itself."""
    if type(value) is np.ndarray and value.size <= MAX_LISTED and value.size > 0:
        return value.tolist()
    return _fields_of(value) if dataclasses.is_dataclass(value) else _value(value)


def _pieces_of(default: Encoder) -> Callable[[Any, int], Iterable[str]]:
    """What JSONEncoder.iterencode makes anew for each message, made once. Its C code is CPython's own business: where it
    is not there, the encoder's own way gives the same."""
    encoder = json.JSONEncoder(separators=(",", ":"), allow_nan=False, check_circular=False, default=default)
    make = getattr(json.encoder, "c_make_encoder", None)
    if make is None:
        return lambda value, _level: (encoder.encode(value),)
    pieces: Callable[[Any, int], Iterable[str]] = make(
        None, default, json.encoder.encode_basestring_ascii, None, ":", ",", False, False, False
    )
    return pieces


_finite_pieces = _pieces_of(_unlisted)


def _encode_fields(message: Any) -> dict[str, Any]:
    return {name: _value(getattr(message, name)) for name in _field_names(message.__class__)}


def _value(value: Any) -> Any:
    kind = type(value)
    if kind is float:
        return value if math.isfinite(value) else str(value)
    if kind is int or kind is str or kind is bool or value is None:
        return value
    if kind is np.ndarray:
        return _array(value)
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, (tuple, list)):
        return [_value(v) for v in value]
    if isinstance(value, dict):
        return {str(k): _value(v) for k, v in value.items()}
    if isinstance(value, np.generic):
        return _value(value.item())
    if dataclasses.is_dataclass(value):
        return _encode_fields(value)
    return str(value)


def _array(value: np.ndarray[Any, Any]) -> Any:
    if value.size > MAX_LISTED or (value.size == 0 and value.ndim > 1):  # an empty list forgets its shape
        little = np.ascontiguousarray(value, dtype=value.dtype.newbyteorder("<"))
        return {
            "dtype": little.dtype.str,
            "shape": list(value.shape),
            "base64": base64.b64encode(little.tobytes()).decode(),
        }
    listed = value.tolist()
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        return _nested(listed)
    return listed


def _nested(listed: Any) -> Any:
    return [_nested(v) for v in listed] if isinstance(listed, list) else _value(listed)


# ---------------------------------------------------------------------------------------------------------------------


@functools.cache
def _hints(kind: Any) -> dict[str, Any]:
    return typing.get_type_hints(kind, localns=_NAMESPACE)


def _decode(hint: Any, value: Any) -> Any:
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None:
            return None
        return _decode(next(a for a in typing.get_args(hint) if a is not type(None)), value)
    if origin is tuple:
        args = typing.get_args(hint)
        inner = [args[0]] * len(value) if len(args) == 2 and args[1] is Ellipsis else list(args)
        return tuple(_decode(a, v) for a, v in zip(inner, value, strict=True))
    if origin is np.ndarray:
        return _decode_array(value, np.dtype(typing.get_args(typing.get_args(hint)[1])[0]))
    if isinstance(hint, type):
        if issubclass(hint, Enum):
            return hint(value)
        if dataclasses.is_dataclass(hint):
            return hint(**{k: _decode(h, value[k]) for k, h in _hints(hint).items() if k in value})
        if hint is float:
            return float(value)
    return value


def _decode_array(value: Any, dtype: np.dtype[Any]) -> np.ndarray[Any, Any]:
    if isinstance(value, dict):
        flat = np.frombuffer(base64.b64decode(value["base64"]), dtype=value["dtype"])
        return flat.reshape(value["shape"]).astype(dtype)
    return np.array(_floats(value) if dtype.kind == "f" else value, dtype=dtype)


def _floats(value: Any) -> Any:
    return [_floats(v) for v in value] if isinstance(value, list) else float(value)
