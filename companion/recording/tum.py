"""Trajectories as text for evo: `t x y z qx qy qz qw`, s and m, every digit that a double has."""

from __future__ import annotations

from companion.messages import OdometryEstimate


def seconds(t_ns: int) -> str:
    """Nanoseconds as decimal seconds, exact."""
    sign = "-" if t_ns < 0 else ""
    return f"{sign}{abs(t_ns) // 1_000_000_000}.{abs(t_ns) % 1_000_000_000:09d}"


def tum_line(estimate: OdometryEstimate) -> str:
    w, x, y, z = (repr(float(v)) for v in estimate.q_map_body_wxyz)
    place = " ".join(repr(float(v)) for v in estimate.position_map_m)
    return f"{seconds(estimate.t_ns)} {place} {x} {y} {z} {w}\n"
