"""The emulated flight controller: PX4 1.18 as seen from outside."""

from simbridge.autopilot.autopilot import Autopilot, warm_up

__all__ = ["Autopilot", "warm_up"]
