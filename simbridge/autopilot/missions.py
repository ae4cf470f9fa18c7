"""The mission protocol: upload, download, clear. Items are kept, never flown: the companion flies offboard."""

from __future__ import annotations

from typing import Any

from simbridge.autopilot.server import Link

ACCEPTED, DENIED = 0, 14  # MAV_MISSION_RESULT
_ITEM_FIELDS = (
    "frame",
    "command",
    "autocontinue",
    "param1",
    "param2",
    "param3",
    "param4",
    "x",
    "y",
    "z",
    "mission_type",
)


class Missions:
    """One transfer at a time; mission_type 0 is kept, fence and rally lists are empty."""

    def __init__(self) -> None:
        self.items: list[dict[str, Any]] = []
        self._incoming: list[dict[str, Any]] = []
        self._expected = 0
        self._peer: tuple[int, int] | None = None
        self._downloading: tuple[int, int] | None = None

    def receive(self, name: str, f: dict[str, Any], sender: tuple[int, int], link: Link) -> None:
        """Handle one message of the protocol; what does not fit the transfer under way is not answered."""
        handler = {
            "MISSION_COUNT": self._count,
            "MISSION_ITEM_INT": self._item,
            "MISSION_REQUEST_LIST": self._list,
            "MISSION_REQUEST_INT": self._request,
            "MISSION_REQUEST": self._request,
            "MISSION_ACK": self._ack,
            "MISSION_CLEAR_ALL": self._clear,
        }.get(name)
        if handler is not None:
            handler(f, sender, link)

    def _answer(self, link: Link, sender: tuple[int, int], name: str, **fields: Any) -> None:
        link.send(name, target_system=sender[0], target_component=sender[1], **fields)

    def _count(self, f: dict[str, Any], sender: tuple[int, int], link: Link) -> None:
        self._incoming, self._expected, self._peer = [], f["count"], sender
        if self._expected == 0:
            self._finish(f["mission_type"], sender, link)
        else:
            self._answer(link, sender, "MISSION_REQUEST_INT", seq=0, mission_type=f["mission_type"])

    def _item(self, f: dict[str, Any], sender: tuple[int, int], link: Link) -> None:
        if sender != self._peer or f["seq"] != len(self._incoming):
            return
        self._incoming.append({key: f[key] for key in _ITEM_FIELDS})
        if len(self._incoming) < self._expected:
            self._answer(link, sender, "MISSION_REQUEST_INT", seq=len(self._incoming), mission_type=f["mission_type"])
        else:
            self._finish(f["mission_type"], sender, link)

    def _finish(self, mission_type: int, sender: tuple[int, int], link: Link) -> None:
        if mission_type == 0:
            self.items = self._incoming
        self._peer = None
        self._answer(link, sender, "MISSION_ACK", type=ACCEPTED, mission_type=mission_type)

    def _list(self, f: dict[str, Any], sender: tuple[int, int], link: Link) -> None:
        count = len(self.items) if f["mission_type"] == 0 else 0
        self._downloading = sender if count else None
        self._answer(link, sender, "MISSION_COUNT", count=count, mission_type=f["mission_type"])

    def _request(self, f: dict[str, Any], sender: tuple[int, int], link: Link) -> None:
        if sender != self._downloading or not 0 <= f["seq"] < len(self.items):
            return
        item = self.items[f["seq"]]
        self._answer(link, sender, "MISSION_ITEM_INT", seq=f["seq"], current=1 if f["seq"] == 0 else 0, **item)

    def _ack(self, f: dict[str, Any], sender: tuple[int, int], link: Link) -> None:
        self._downloading = None

    def _clear(self, f: dict[str, Any], sender: tuple[int, int], link: Link) -> None:
        if f["mission_type"] in (0, 255):
            self.items = []
        self._answer(link, sender, "MISSION_ACK", type=ACCEPTED, mission_type=f["mission_type"])
