"""A reader's check of a JSON message against the schema that a recording carries: type, properties, items, required.

The part of JSON Schema that Foxglove's own schemas use, by hand: the library is no dependency of this project.
"""

from __future__ import annotations

import base64
import binascii
import math
from typing import Any

_TYPES: dict[str, tuple[type, ...]] = {
    "object": (dict,),
    "array": (list,),
    "string": (str,),
    "number": (int, float),
    "integer": (int,),
    "boolean": (bool,),
}


def faults(value: Any, schema: dict[str, Any], at: str = "$") -> list[str]:
    """What in value is not as the schema says, each with its place; a field that the schema does not know is one too."""
    kind = schema.get("type")
    if kind is not None and (
        not isinstance(value, _TYPES[kind]) or (isinstance(value, bool) and kind not in ("boolean",))
    ):
        return [f"{at}: {type(value).__name__}, expected {kind}"]
    if isinstance(value, float) and not math.isfinite(value):
        return [f"{at}: {value}"]
    found: list[str] = []
    if isinstance(value, dict):
        properties: dict[str, Any] = schema.get("properties", {})
        found += [f"{at}.{name}: missing" for name in schema.get("required", []) if name not in value]
        found += [f"{at}.{name}: not in the schema" for name in value if name not in properties]
        for name, inner in properties.items():
            if name in value:
                found += faults(value[name], inner, f"{at}.{name}")
    elif isinstance(value, list):
        for n, item in enumerate(value):
            found += faults(item, schema.get("items", {}), f"{at}[{n}]")
    elif schema.get("contentEncoding") == "base64":
        try:
            base64.b64decode(value, validate=True)
        except binascii.Error as error:
            found.append(f"{at}: {error}")
    return found
