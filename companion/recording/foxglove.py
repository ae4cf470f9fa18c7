"""What Foxglove and Lichtblick draw: pose, transforms, points and log in their own schemas, encoded as JSON.

Schema names and fields: Foxglove's documentation of message schemas (PoseInFrame, FrameTransforms, PointCloud, Log).
"""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np

from companion.messages import Array, Event, LevelledScan, OdometryEstimate, Severity
from companion.recording.mcap_write import Schema

_LOG_LEVELS = {Severity.DEBUG: 1, Severity.INFO: 2, Severity.NOTICE: 2, Severity.WARNING: 3, Severity.ERROR: 4}
_FATAL = 5
_FLOAT32 = 7  # foxglove.PackedElementField.NumericType


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_NUMBER, _INTEGER, _TEXT = {"type": "number"}, {"type": "integer"}, {"type": "string"}
_BYTES = {"type": "string", "contentEncoding": "base64"}
_TIME = _object(sec=_INTEGER, nsec=_INTEGER)
_VECTOR = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER)
_QUATERNION = _object(x=_NUMBER, y=_NUMBER, z=_NUMBER, w=_NUMBER)
_POSE = _object(position=_VECTOR, orientation=_QUATERNION)
_TRANSFORM = _object(
    timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT, translation=_VECTOR, rotation=_QUATERNION
)
_FIELDS = {"type": "array", "items": _object(name=_TEXT, offset=_INTEGER, type=_INTEGER)}

_SCHEMAS: dict[str, dict[str, Any]] = {
    "foxglove.PoseInFrame": _object(timestamp=_TIME, frame_id=_TEXT, pose=_POSE),
    "foxglove.FrameTransforms": _object(transforms={"type": "array", "items": _TRANSFORM}),
    "foxglove.PointCloud": _object(
        timestamp=_TIME, frame_id=_TEXT, pose=_POSE, point_stride=_INTEGER, fields=_FIELDS, data=_BYTES
    ),
    "foxglove.Log": _object(timestamp=_TIME, level=_INTEGER, message=_TEXT, name=_TEXT, file=_TEXT, line=_INTEGER),
}


def schemas(first_id: int) -> list[Schema]:
    """The four schemas, numbered from first_id, in a fixed order."""
    return [
        Schema(first_id + n, name, "jsonschema", json.dumps({"title": name, **body}, separators=(",", ":")).encode())
        for n, (name, body) in enumerate(_SCHEMAS.items())
    ]


def _time(t_ns: int) -> dict[str, int]:
    return {"sec": t_ns // 1_000_000_000, "nsec": t_ns % 1_000_000_000}


def _vector(v: Array) -> dict[str, float]:
    return {"x": float(v[0]), "y": float(v[1]), "z": float(v[2])}


def _quaternion(q_wxyz: Array) -> dict[str, float]:
    return {"x": float(q_wxyz[1]), "y": float(q_wxyz[2]), "z": float(q_wxyz[3]), "w": float(q_wxyz[0])}


def _dump(value: object) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode()


def pose_in_frame(estimate: OdometryEstimate) -> bytes:
    pose = {"position": _vector(estimate.position_map_m), "orientation": _quaternion(estimate.q_map_body_wxyz)}
    return _dump({"timestamp": _time(estimate.t_ns), "frame_id": "map", "pose": pose})


def frame_transforms(estimate: OdometryEstimate) -> bytes:
    transform = {
        "timestamp": _time(estimate.t_ns),
        "parent_frame_id": "map",
        "child_frame_id": "body",
        "translation": _vector(estimate.position_map_m),
        "rotation": _quaternion(estimate.q_map_body_wxyz),
    }
    return _dump({"transforms": [transform]})


def point_cloud(points_map: Array, t_ns: int) -> bytes:
    """points_map: (N, 3)."""
    packed = np.ascontiguousarray(points_map, dtype="<f4")
    fields = [{"name": n, "offset": 4 * k, "type": _FLOAT32} for k, n in enumerate("xyz")]
    origin = {"position": _vector(np.zeros(3)), "orientation": _quaternion(np.array([1.0, 0.0, 0.0, 0.0]))}
    return _dump(
        {
            "timestamp": _time(t_ns),
            "frame_id": "map",
            "pose": origin,
            "point_stride": 12,
            "fields": fields,
            "data": base64.b64encode(packed.tobytes()).decode(),
        }
    )


def points_in_map(levelled: LevelledScan, yaw_rad: float, position_map_m: Array) -> Array:
    """(N, 3) points of a levelled scan, turned to the map's heading and put in their place."""
    c, s = float(np.cos(yaw_rad)), float(np.sin(yaw_rad))
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    placed: Array = levelled.points_level @ rotation.T + position_map_m
    return placed


def log(event: Event) -> bytes:
    level = _LOG_LEVELS.get(event.severity, _FATAL)
    return _dump(
        {
            "timestamp": _time(event.t_ns),
            "level": level,
            "message": event.text,
            "name": event.name,
            "file": "",
            "line": 0,
        }
    )
