"""Mission files: what to fly, and in which emulated store. One YAML file holds the sections of both sides."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError

from companion.config import CompanionConfig, LidarConfig
from companion.errors import ConfigError

if TYPE_CHECKING:  # the emulated side is an extra: on a vehicle it need not be there
    from simbridge.config import SimConfig

LABELS = ("name", "description")
SIM_SECTIONS = ("seed", "world", "vehicle", "autopilot", "faults")
COMPANION_SECTIONS = tuple(k for k in CompanionConfig.model_fields if k != "lidar")
SECTIONS = (*LABELS, *SIM_SECTIONS, "lidar", *COMPANION_SECTIONS)

Location = tuple[str | int, ...]
Model = TypeVar("Model", bound=BaseModel)


@dataclass(frozen=True, slots=True, kw_only=True)
class Mission:
    """A mission file, resolved and checked. sim is None where the file describes no world (a real vehicle)."""

    name: str
    description: str
    path: str
    companion: CompanionConfig
    sim: SimConfig | None

    @property
    def seed(self) -> int:
        return self.sim.seed if self.sim is not None else 0

    def resolved(self) -> dict[str, Any]:
        """Every key with its value, defaults included: enough to write the same mission again."""
        out: dict[str, Any] = {"name": self.name, "description": self.description}
        flies = self.companion.model_dump(mode="json")
        lidar = flies.pop("lidar")
        if self.sim is not None:
            world = self.sim.model_dump(mode="json")
            lidar = {**world.pop("lidar"), **lidar}
            out.update(world)
        return {**out, "lidar": lidar, **flies}


def load_mission(
    path: Path | str, settings: Sequence[str] = (), *, seed: int | None = None, with_world: bool = True
) -> Mission:
    """Read, set, and check a mission file.

    Args:
        with_world: read the sections of the emulated side too; a vehicle has no use for them, and not the code.
        settings: "key=value" with dotted keys, as given by --set; values are YAML.
    Raises: ConfigError: every fault found, one a line: file and line, key, value, what is allowed.
    """
    path = Path(path)
    raw, lines = _read_yaml(path)
    for setting in settings:
        _apply_setting(raw, setting)
    if seed is not None:
        raw["seed"] = seed
    return build_mission(raw, source=str(path), lines=lines, name=path.stem, with_world=with_world)


def build_mission(
    raw: dict[str, Any],
    *,
    source: str,
    lines: Mapping[Location, int] | None = None,
    name: str = "mission",
    with_world: bool = True,
) -> Mission:
    """A mission from its parsed sections. Raises: ConfigError."""
    problems: list[str] = []
    teller = _Teller(source, lines or {})
    for key in raw:
        if key not in SECTIONS:
            problems.append(teller.unknown((key,), raw[key], SECTIONS))
    lidar = raw.get("lidar") or {}
    if not isinstance(lidar, dict):
        problems.append(teller.say(("lidar",), lidar, "must be a section of keys and values"))
        lidar = {}
    flies = {k: raw[k] for k in COMPANION_SECTIONS if raw.get(k) is not None}
    flies["lidar"] = {k: v for k, v in lidar.items() if k in LidarConfig.model_fields}
    companion = _validate(CompanionConfig, flies, raw, teller, problems)
    if companion is not None:
        problems += _companion_checks(companion, teller)
    sim = _emulated_side(raw, lidar, companion, teller, problems) if with_world else None
    if problems or companion is None:
        raise ConfigError("\n".join(dict.fromkeys(problems)))
    return Mission(
        name=str(raw.get("name") or name), description=str(raw.get("description") or ""), path=source,
        companion=companion, sim=sim,
    )  # fmt: skip


def _emulated_side(
    raw: dict[str, Any],
    lidar: dict[str, Any],
    companion: CompanionConfig | None,
    teller: _Teller,
    problems: list[str],
) -> SimConfig | None:
    """The sections of simbridge, checked also against those that fly; None where the mission has no world."""
    from simbridge.config import LidarSimConfig, SimConfig

    keys = {*LidarConfig.model_fields, *LidarSimConfig.model_fields}
    problems += [teller.unknown(("lidar", k), v, sorted(keys)) for k, v in lidar.items() if k not in keys]
    if raw.get("world") is None:
        if any(raw.get(k) is not None for k in ("vehicle", "faults")):
            problems.append(teller.say(("world",), None, "is missing: a vehicle or faults to emulate need a world"))
        return None
    if any(": lidar" in problem for problem in problems):
        return None  # the emulated side would only say the same again
    emulated = {k: raw[k] for k in SIM_SECTIONS if raw.get(k) is not None}
    shared = companion.lidar.model_dump() if companion is not None else {}
    # the same sensor on both sides, defaults included
    emulated["lidar"] = {k: v for k, v in {**shared, **lidar}.items() if k in LidarSimConfig.model_fields}
    sim = _validate(SimConfig, emulated, raw, teller, problems)
    if companion is not None and sim is not None and not problems:
        problems += _world_checks(companion, sim, teller)
    return sim


def _companion_checks(companion: CompanionConfig, teller: _Teller) -> Iterator[str]:
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
    if nav.height_m >= guard.max_height_m:
        yield teller.say(
            ("navigator", "height_m"), nav.height_m, f"must be below guard.max_height_m {guard.max_height_m:g}"
        )
    if nav.forward_speed_mps > guard.max_speed_mps:
        yield teller.say(
            ("navigator", "forward_speed_mps"), nav.forward_speed_mps,
            f"must be at most guard.max_speed_mps {guard.max_speed_mps:g}",
        )  # fmt: skip


def _world_checks(companion: CompanionConfig, sim: SimConfig, teller: _Teller) -> Iterator[str]:
    nav = companion.navigator
    if nav.height_m > sim.world.height_m - 1.5:
        yield teller.say(
            ("navigator", "height_m"), nav.height_m,
            f"must be at most {sim.world.height_m - 1.5:g}: 1.5 m below the ceiling at {sim.world.height_m:g} m",
        )  # fmt: skip
    from simbridge.world import widest_wall_distance_m

    widest = widest_wall_distance_m(sim.world)
    if nav.wall_distance_m >= widest:
        yield teller.say(
            ("navigator", "wall_distance_m"), nav.wall_distance_m,
            f"must be below {math.floor(widest * 10) / 10:g}: half the clear width of the hall, "
            "else no path keeps that distance from every wall",
        )  # fmt: skip


# ---------------------------------------------------------------------------------------------------------------------


class _Teller:
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
        return f"{where}: {_dotted(location)}{shown}: {allowed}"

    def unknown(self, location: Location, value: object, allowed: Sequence[str]) -> str:
        near = difflib.get_close_matches(str(location[-1]), allowed, n=1, cutoff=0.5)
        hint = f" (did you mean {near[0]}?)" if near else ""
        return self.say(location, value, f"unknown key{hint}; allowed here: {', '.join(allowed)}")


def _validate(
    model: type[Model], data: dict[str, Any], raw: dict[str, Any], teller: _Teller, problems: list[str]
) -> Model | None:
    try:
        return model.model_validate(data)
    except ValidationError as error:
        for fault in error.errors():
            location = _real_location(tuple(fault["loc"]), raw)
            if fault["type"] == "extra_forbidden":
                problems.append(
                    teller.unknown(location, fault["input"], _allowed_keys(model, tuple(fault["loc"])[:-1]))
                )
            else:
                shown = None if fault["type"] == "missing" else fault["input"]
                problems.append(teller.say(location, shown, _plain(fault["msg"])))
        return None


def _plain(message: str) -> str:
    message = message.removeprefix("Value error, ").removeprefix("Assertion failed, ")
    return message.replace("Input should be", "must be").replace("Field required", "is missing")


def _real_location(location: Location, raw: object) -> Location:
    """The location without pydantic's union tags, which stand in no file."""
    out: list[str | int] = []
    here: Any = raw
    for n, part in enumerate(location):
        last = n == len(location) - 1
        if (isinstance(here, dict) and part in here) or (
            isinstance(here, list) and isinstance(part, int) and part < len(here)
        ):
            here = here[part]  # type: ignore[index]
            out.append(part)
        elif last and not (isinstance(part, str) and ("[" in part or not isinstance(here, dict))):
            out.append(part)
    return tuple(out)


def _allowed_keys(model: type[BaseModel], location: Location) -> list[str]:
    """The keys of the section at that location, as far as the annotations tell."""
    found: list[type[BaseModel]] = [model]
    for part in location:
        following: list[type[BaseModel]] = []
        for candidate in found:
            if isinstance(part, str) and part in candidate.model_fields:
                following += _models_in(candidate.model_fields[part].annotation)
            elif isinstance(part, int) or any(part in _tags(candidate) for _ in (0,)):
                following.append(candidate)
        if isinstance(part, str) and not following:
            following = found
        found = following or found
    return sorted({key for candidate in found for key in candidate.model_fields})


def _tags(model: type[BaseModel]) -> tuple[object, ...]:
    field = model.model_fields.get("kind")
    return get_args(field.annotation) if field is not None else ()


def _models_in(annotation: object) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for argument in get_args(annotation) for model in _models_in(argument)]


def _dotted(location: Location) -> str:
    return ".".join(str(part) for part in location) or "(file)"


def _shorten(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


def _read_yaml(path: Path) -> tuple[dict[str, Any], dict[Location, int]]:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        near = difflib.get_close_matches(path.name, [p.name for p in path.parent.glob("*.yaml")], n=1)
        hint = f"; did you mean {path.parent / near[0]}?" if near else ""
        raise ConfigError(f"{path}: no such mission file{hint}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    try:
        raw = yaml.safe_load(text)
        node = yaml.compose(text, Loader=yaml.SafeLoader)
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: is not YAML: {error}") from None
    if not isinstance(raw, dict):
        raise ConfigError(f"{path}: expected sections ({', '.join(SECTIONS)}), got {type(raw).__name__}")
    lines: dict[Location, int] = {}
    _collect_lines(node, (), lines, path)
    return raw, lines


def _collect_lines(node: yaml.Node | None, location: Location, lines: dict[Location, int], path: Path) -> None:
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key, value in node.value:
            here = (*location, str(key.value))
            if str(key.value) in seen:
                raise ConfigError(f"{path}:{key.start_mark.line + 1}: {_dotted(here)}: given twice")
            seen.add(str(key.value))
            lines[here] = key.start_mark.line + 1
            _collect_lines(value, here, lines, path)
    elif isinstance(node, yaml.SequenceNode):
        for n, value in enumerate(node.value):
            lines[(*location, n)] = value.start_mark.line + 1
            _collect_lines(value, (*location, n), lines, path)


def parse_setting(setting: str) -> tuple[Location, Any]:
    """("a.b.0", "value as YAML") from "a.b.0=value". Raises: ConfigError."""
    key, separator, text = setting.partition("=")
    if not separator or not key.strip():
        raise ConfigError(f"--set {setting}: expected key=value, for example --set navigator.height_m=8")
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"--set {setting}: the value is not YAML: {error}") from None
    location = tuple(int(part) if part.isdigit() else part for part in key.strip().split("."))
    return location, value


def _apply_setting(raw: dict[str, Any], setting: str) -> None:
    location, value = parse_setting(setting)
    here: Any = raw
    for n, part in enumerate(location[:-1]):
        if isinstance(here, list) and isinstance(part, int) and part < len(here):
            here = here[part]
        elif isinstance(here, dict):
            if here.get(part) is None:
                here[part] = {}
            here = here[part]
        else:
            raise ConfigError(f"--set {setting}: {_dotted(location[: n + 1])} is not in the mission")
    last: Any = location[-1]
    if isinstance(here, dict) or (isinstance(here, list) and isinstance(last, int) and last < len(here)):
        here[last] = value
    else:
        raise ConfigError(f"--set {setting}: {_dotted(location[:-1])} is not a section that has keys")
