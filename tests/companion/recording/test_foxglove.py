"""Foxglove and Lichtblick open a recording as it is: every message is what the schema beside it says."""

from __future__ import annotations

import io
import json
import re
from collections import Counter
from pathlib import Path

import pytest
from mcap.reader import make_reader

from companion.flight import Flight
from companion.recording.log import MCAP_NAME, Recorder
from companion.recording.replay import Replay
from companion.recording.run_files import read_run
from stockpilot.recorded import listen
from stockpilot.replay import recorded_config
from stockpilot.replay_edit import rebuild_scans
from tests.companion.recording.schema_check import faults

SECONDS = 8
ROOT = Path(__file__).resolve().parents[3]
REPLAYS = ROOT / "missions" / "replays"
LAYOUT = ROOT / "docs" / "foxglove_layout.json"

# What the viewers need to draw each schema (Foxglove's documentation of its message schemas), as we fill it.
DRAWN = {
    "foxglove.PoseInFrame": {"timestamp", "frame_id", "pose"},
    "foxglove.FrameTransforms": {"transforms"},
    "foxglove.PointCloud": {"timestamp", "frame_id", "pose", "point_stride", "fields", "data"},
    "foxglove.Log": {"timestamp", "level", "message", "name", "file", "line"},
}


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A recording of a flight core at work, with points, poses, events, requests and frames."""
    folder = tmp_path_factory.mktemp("flown")
    source = read_run(REPLAYS / "corner")
    metadata = source.attachments["lidar.json"].decode()
    flight = Flight(config=recorded_config(source), lidar_metadata_json=metadata)
    recorder = Recorder(folder, metadata=source.metadata["run"], attachments=source.attachments)
    replay = Replay(flight, keep_messages=False)
    listen(recorder, flight)
    until_ns = next(i.t_ns for i in source.inputs if i.kind == "lidar") + SECONDS * 10**9
    for item in rebuild_scans([i for i in source.inputs if i.t_ns < until_ns], metadata):
        replay.feed(item)
    for t_ns, frame in replay.frames:
        recorder.output(t_ns, frame)
    recorder.close({"state": "ended"})
    return (folder / MCAP_NAME).read_bytes()


def test_every_message_is_what_its_schema_says(flown: bytes) -> None:
    found: Counter[str] = Counter()
    for schema, channel, message in make_reader(io.BytesIO(flown), validate_crcs=True).iter_messages():
        found[channel.topic] += 1
        if channel.message_encoding == "json":
            content = json.loads(message.data, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
            assert isinstance(content, dict), channel.topic
            if schema is not None:
                assert schema.encoding == "jsonschema"
                assert not faults(content, json.loads(schema.data)), channel.topic
                assert set(content) == DRAWN[schema.name]
        else:
            assert (channel.message_encoding, schema.name, schema.encoding) == (
                "ros1", "stockpilot/Datagram", "ros1msg"
            )  # fmt: skip
    drawn = {topic for topic in found if topic.startswith("/")}
    assert drawn == {"/pose", "/tf", "/points", "/log"}
    assert found["/points"] > 5
    assert found["odometry/estimate"] > 100


def test_raw_datagrams_are_what_their_ros_message_definition_says(flown: bytes) -> None:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    kind = "stockpilot/msg/Datagram"
    sizes: Counter[str] = Counter()
    for schema, channel, message in make_reader(io.BytesIO(flown)).iter_messages(topics=["in/lidar", "out/mavlink"]):
        if not sizes:
            store.register(get_types_from_msg(schema.data.decode(), kind))
        datagram = store.deserialize_ros1(message.data, kind)
        sizes[channel.topic] += len(datagram.data)
        assert datagram.host == ""
    assert min(sizes.values()) > 10_000
    assert len(sizes) == 2


def test_layout_names_panels_the_viewers_know_and_fields_a_recording_has(flown: bytes) -> None:
    layout = json.loads(LAYOUT.read_text())
    panels = layout["configById"]
    # The viewers' own names of panel types: the log panel is still called after ROS's /rosout.
    assert Counter(name.split("!")[0] for name in panels) == {"3D": 1, "Plot": 2, "RosOut": 1}
    assert sorted(_leaves(layout["layout"])) == sorted(panels)
    frames, newest = set(), {}
    for _, channel, message in make_reader(io.BytesIO(flown)).iter_messages():
        if channel.message_encoding == "json":
            newest[channel.topic] = content = json.loads(message.data)
            for transform in content.get("transforms", ()):
                frames |= {transform["parent_frame_id"], transform["child_frame_id"]}
    scene = panels["3D!stockpilot"]
    assert scene["followTf"] in frames
    assert {*scene["topics"], panels["RosOut!stockpilot"]["topicToRender"]} <= newest.keys()
    assert scene["topics"]["/points"]["colorField"] in {f["name"] for f in newest["/points"]["fields"]}
    for path in (p["value"] for name in panels if name.startswith("Plot") for p in panels[name]["paths"]):
        topic, field, index = re.fullmatch(r"([\w/]+)\.(\w+)(?:\[(\d+)\])?", path).groups()
        value = newest[topic][field]
        assert isinstance(value if index is None else value[int(index)], int | float), path


def _leaves(node: dict | str) -> list[str]:
    return [node] if isinstance(node, str) else _leaves(node["first"]) + _leaves(node["second"])


@pytest.mark.parametrize(
    ("value", "schema", "told"),
    [
        ({"a": "1"}, {"type": "object", "properties": {"a": {"type": "number"}}}, ["$.a: str, expected number"]),
        ({"b": 1}, {"type": "object", "properties": {}}, ["$.b: not in the schema"]),
        ({}, {"type": "object", "properties": {}, "required": ["a"]}, ["$.a: missing"]),
        ([1, 1.5], {"type": "array", "items": {"type": "integer"}}, ["$[1]: float, expected integer"]),
        (True, {"type": "integer"}, ["$: bool, expected integer"]),
        (float("nan"), {"type": "number"}, ["$: nan"]),
        ("?", {"type": "string", "contentEncoding": "base64"}, None),
    ],
)
def test_the_check_itself_finds_what_is_wrong(value: object, schema: dict, told: list[str] | None) -> None:
    found = faults(value, schema)
    assert found
    assert told is None or found == told
