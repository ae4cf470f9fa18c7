"""Physics for real autopilots: PX4 in software in the loop over TCP, ArduCopter in software in the loop over UDP."""

from __future__ import annotations


class SitlError(Exception):
    """A real autopilot did not start, connect or answer: what was awaited, for how long, and what to do about it."""
