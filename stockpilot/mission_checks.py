"""What a mission must not say although each value by itself may stand: checked across sections, and told in words."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from companion.config import CompanionConfig

if TYPE_CHECKING:
    from simbridge.config import SimConfig  # the emulated side is an extra: on a vehicle it need not be there

NAME = re.compile(r"(?!\.)[\w][\w .-]*")
LEVEL_DEG = 15.0  # so steep a layer meets the floor 34 m off, flying at 9 m: walls are still seen
BELOW_CEILING_M = 1.5
ABOVE_MATERIAL_M = 1.0
BELOW_TOP_M = 0.5  # what rises by less above the height of flight is too small a target for the level scan

Location = tuple[str | int, ...]


class Teller:
    """Words a fault: file and line, key, value, what is allowed."""

    def __init__(self, source: str, lines: Mapping[Location, int]) -> None:
        self._source = source
        self._lines = lines

    def say(self, location: Location, value: object, allowed: str) -> str:
        where = self._source
        for n in range(len(location), 0, -1):
            if location[:n] in self._lines:
                where = f"{self._source}:{self._lines[location[:n]]}"
                break
        shown = "" if value is None else f" = {_shorten(value)}"
        return f"{where}: {dotted(location)}{shown}: {allowed}"

    def unknown(self, location: Location, value: object, allowed: Sequence[str]) -> str:
        near = difflib.get_close_matches(str(location[-1]), allowed, n=1, cutoff=0.5)
        hint = f" (did you mean {near[0]}?)" if near else ""
        return self.say(location, value, f"unknown key{hint}; allowed here: {', '.join(allowed)}")


def dotted(location: Location) -> str:
    return ".".join(str(part) for part in location) or "(file)"


def _shorten(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def label_checks(raw: dict[str, Any], teller: Teller) -> Iterator[str]:
    name = raw.get("name")
    if name is not None and not (isinstance(name, str | int | float) and NAME.fullmatch(str(name))):
        yield teller.say(("name",), name, "must be letters, digits, spaces and . _ - (it names the results' folder)")
    description = raw.get("description")
    if description is not None and not isinstance(description, str):
        yield teller.say(("description",), description, "must be text")


def truth_values_as_numbers(given: Any, read: Any, teller: Teller, at: Location = ()) -> Iterator[str]:
    """`height_m: true` would be read as 1 m."""
    if isinstance(given, bool) and not isinstance(read, bool):
        yield teller.say(at, given, "must be a number, not true or false (nor yes, no, on, off)")
    elif isinstance(given, dict) and isinstance(read, dict):
        for key in given.keys() & read.keys():
            yield from truth_values_as_numbers(given[key], read[key], teller, (*at, key))
    elif isinstance(given, list) and isinstance(read, list | tuple):
        for n, (one, other) in enumerate(zip(given, read, strict=False)):
            yield from truth_values_as_numbers(one, other, teller, (*at, n))


def companion_checks(companion: CompanionConfig, teller: Teller) -> Iterator[str]:
    nav, guard, lidar = companion.navigator, companion.guard, companion.lidar
    if lidar.min_range_m >= lidar.max_range_m:
        yield teller.say(
            ("lidar", "min_range_m"), lidar.min_range_m, f"must be below max_range_m {lidar.max_range_m:g}"
        )
    if lidar.elevation_min_deg >= lidar.elevation_max_deg:
        yield teller.say(
            ("lidar", "elevation_min_deg"), lidar.elevation_min_deg,
            f"must be below elevation_max_deg {lidar.elevation_max_deg:g}",
        )  # fmt: skip
    if nav.wall_distance_m <= guard.stop_distance_m + 1.0:
        yield teller.say(
            ("navigator", "wall_distance_m"), nav.wall_distance_m,
            f"must exceed guard.stop_distance_m {guard.stop_distance_m:g} by more than 1 m: the guard would stop the lap",
        )  # fmt: skip
    if nav.wall_distance_m >= lidar.max_range_m:
        yield teller.say(
            ("navigator", "wall_distance_m"), nav.wall_distance_m,
            f"must be below lidar.max_range_m {lidar.max_range_m:g}: the wall would not be seen",
        )  # fmt: skip
    if not lidar.elevation_min_deg <= LEVEL_DEG or not lidar.elevation_max_deg >= -LEVEL_DEG:
        yield teller.say(
            ("lidar", "elevation_max_deg"), lidar.elevation_max_deg,
            f"no layer lies within {LEVEL_DEG:g} deg of the horizon: it steers and finds its place by that one",
        )  # fmt: skip
    if max(abs(angle) for angle in lidar.mount_rpy_deg[:2]) > LEVEL_DEG:
        yield teller.say(
            ("lidar", "mount_rpy_deg"), lidar.mount_rpy_deg,
            f"roll and pitch must be within {LEVEL_DEG:g} deg, else the level layer sees floor and ceiling (the yaw is free)",
        )  # fmt: skip
    if nav.height_m >= guard.max_height_m:
        yield teller.say(
            ("navigator", "height_m"), nav.height_m, f"must be below guard.max_height_m {guard.max_height_m:g}"
        )
    if nav.forward_speed_mps > guard.max_speed_mps:
        yield teller.say(
            ("navigator", "forward_speed_mps"), nav.forward_speed_mps,
            f"must be at most guard.max_speed_mps {guard.max_speed_mps:g}",
        )  # fmt: skip


def world_checks(companion: CompanionConfig, sim: SimConfig, teller: Teller) -> Iterator[str]:
    from simbridge import footprint as fp

    nav, world = companion.navigator, sim.world
    low, high = fp.start_floor_z(world, sim.vehicle.start)
    highest = math.floor((world.height_m - BELOW_CEILING_M - high) * 10 + 1e-6) / 10
    if nav.height_m > highest + 1e-9:
        yield teller.say(
            ("navigator", "height_m"), nav.height_m,
            f"must be at most {highest:g}: {BELOW_CEILING_M:g} m below the ceiling at {world.height_m:g} m",
        )  # fmt: skip
    floor = fp.highest_floor_z(world)
    if low + nav.height_m < floor + ABOVE_MATERIAL_M:
        yield teller.say(
            ("navigator", "height_m"), nav.height_m,
            f"must be at least {floor + ABOVE_MATERIAL_M - low:.1f}: the floor rises to {floor - low:.1f} m above the start",
        )  # fmt: skip
    yield from _tops(companion, sim, teller)
    yield from _params(sim, teller)
    widest = fp.largest_wall_distance_m(world.footprint)
    if nav.wall_distance_m >= widest:
        yield teller.say(
            ("navigator", "wall_distance_m"), nav.wall_distance_m,
            f"must be below {math.floor(widest * 10) / 10:g}: half the clear width of the hall, "
            "else no path keeps that distance from every wall",
        )  # fmt: skip


def _params(sim: SimConfig, teller: Teller) -> Iterator[str]:
    from simbridge.autopilot.params import ParamStore

    for name, value in sim.autopilot.params.items():
        try:
            ParamStore({name: value})
        except ValueError as error:
            yield teller.say(("autopilot", "params", name), value, str(error).partition(": ")[2])


def _tops(companion: CompanionConfig, sim: SimConfig, teller: Teller) -> Iterator[str]:
    """What ends about the height of flight is not seen by the level scan that the vehicle avoids things by."""
    from simbridge import footprint as fp

    world, height = sim.store, companion.navigator.height_m
    low, high = fp.start_floor_z(world, sim.vehicle.start)
    tops = [(f"world.piles.{i}", fp.pile_top_z(world, pile)) for i, pile in enumerate(world.piles)]
    tops += [(f"world.{o.name}", o.top_z) for o in fp.obstacles(world)]
    for name, top in tops:
        if low + height - ABOVE_MATERIAL_M < top < high + height + BELOW_TOP_M:
            yield teller.say(
                ("navigator", "height_m"), height,
                f"must be at least {top - low + ABOVE_MATERIAL_M:.1f} to pass over {name}, which reaches to "
                f"{top:.1f} m, or at most {top - high - BELOW_TOP_M:.1f} to see it and fly round it",
            )  # fmt: skip
