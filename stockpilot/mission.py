"""Mission files: what to fly, and in which emulated store. One YAML file holds the sections of both sides."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ValidationError

from companion.config import CompanionConfig, LidarConfig
from companion.errors import ConfigError
from stockpilot.mission_checks import (
    Location,
    Teller,
    companion_checks,
    dotted,
    label_checks,
    truth_values_as_numbers,
    world_checks,
)

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

    from simbridge.config import SimConfig  # the emulated side is an extra: on a vehicle it need not be there

LABELS = ("name", "description")
SIM_SECTIONS = ("seed", "world", "vehicle", "autopilot", "faults")
COMPANION_SECTIONS = tuple(k for k in CompanionConfig.model_fields if k != "lidar")
SECTIONS = (*LABELS, *SIM_SECTIONS, "lidar", *COMPANION_SECTIONS)
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

    @property
    def autopilot(self) -> str:
        """The flight controller that flies the emulated vehicle: emulated, px4 or ardupilot."""
        return self.sim.autopilot.kind if self.sim is not None else "emulated"

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
    teller = Teller(source, lines or {})
    for key in raw:
        if key not in SECTIONS:
            problems.append(teller.unknown((key,), raw[key], SECTIONS))
    problems += label_checks(raw, teller)
    lidar = raw.get("lidar") or {}
    if not isinstance(lidar, dict):
        problems.append(teller.say(("lidar",), lidar, "must be a section of keys and values"))
        lidar = {}
    flies = {k: raw[k] for k in COMPANION_SECTIONS if raw.get(k) is not None}
    flies["lidar"] = {k: v for k, v in lidar.items() if k in LidarConfig.model_fields}
    companion = _validate(CompanionConfig, flies, raw, teller, problems)
    if companion is not None:
        problems += companion_checks(companion, teller)
        problems += truth_values_as_numbers(raw, companion.model_dump(), teller)
    sim = _emulated_side(raw, lidar, companion, teller, problems) if with_world else None
    if sim is not None:
        problems += truth_values_as_numbers(raw, sim.model_dump(), teller)
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
    teller: Teller,
    problems: list[str],
) -> SimConfig | None:
    """The sections of simbridge, checked also against those that fly; None where the mission has no world."""
    from simbridge.config import LidarSimConfig, SimConfig

    keys = {*LidarConfig.model_fields, *LidarSimConfig.model_fields}
    problems += [teller.unknown(("lidar", k), v, sorted(keys)) for k, v in lidar.items() if k not in keys]
    if raw.get("world") is None:
        if any(raw.get(k) is not None for k in ("vehicle", "faults")):
            problems.append(teller.say(("world",), None, "is missing: a vehicle or faults to emulate need a world"))
        seed = raw.get("seed")
        if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int) or seed < 0):
            problems.append(teller.say(("seed",), seed, "must be a whole number, 0 or greater"))
        return None
    if any(": lidar" in problem for problem in problems):
        return None  # the emulated side would only say the same again
    emulated = {k: raw[k] for k in SIM_SECTIONS if raw.get(k) is not None}
    shared = companion.lidar.model_dump() if companion is not None else {}
    # the same sensor on both sides, defaults included
    emulated["lidar"] = {k: v for k, v in {**shared, **lidar}.items() if k in LidarSimConfig.model_fields}
    sim = _validate(SimConfig, emulated, raw, teller, problems)
    if companion is not None and sim is not None and not problems:
        problems += world_checks(companion, sim, teller)
    return sim


def _validate(
    model: type[Model], data: dict[str, Any], raw: dict[str, Any], teller: Teller, problems: list[str]
) -> Model | None:
    try:
        return model.model_validate(data)
    except ValidationError as error:
        faults = error.errors()
        places = [tuple(fault["loc"]) for fault in faults]
        for fault, place in zip(faults, places, strict=True):
            if fault["type"] == "too_short" and any(len(p) > len(place) and p[: len(place)] == place for p in places):
                continue  # too short only because an entry is at fault, which is told by itself
            location = _real_location(place, raw)
            if fault["type"] == "extra_forbidden":
                problems.append(teller.unknown(location, fault["input"], _allowed_keys(model, place[:-1])))
            else:
                problems.append(_worded(fault, location, teller))
        return None


def _worded(fault: ErrorDetails, location: Location, teller: Teller) -> str:
    context = fault.get("ctx", {})
    match fault["type"]:
        case "missing":
            return teller.say(location, None, "is missing")
        case "union_tag_not_found":
            return teller.say(
                (*location, "kind"), None, "is missing; allowed are cone, ridge, gaussians, function, mesh"
            )
        case "union_tag_invalid":
            return teller.say((*location, "kind"), context["tag"], f"must be one of {context['expected_tags']}")
        case "too_short" | "too_long":
            least = "at least" if fault["type"] == "too_short" else "at most"
            count = context.get("min_length", context.get("max_length"))
            return teller.say(
                location, fault["input"], f"must be a list of {least} {count}, not {context['actual_length']}"
            )
        case "tuple_type" | "list_type":
            return teller.say(location, fault["input"], "must be a list")
        case "model_type" | "model_attributes_type" | "dict_type":
            return teller.say(location, fault["input"], "must be a section of keys and values")
        case _:
            return teller.say(location, fault["input"], _plain(fault["msg"]))


def _plain(message: str) -> str:
    message = message.removeprefix("Value error, ").removeprefix("Assertion failed, ")
    return message.replace("Input should be", "must be")


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
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # a date that is none; brackets thousands deep
        raise ConfigError(f"{path}: is not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(raw, dict):
        raise ConfigError(f"{path}: expected sections ({', '.join(SECTIONS)}), got {type(raw).__name__}")
    lines: dict[Location, int] = {}
    try:
        _collect_lines(node, (), lines, path)
    except RecursionError:
        raise ConfigError(f"{path}: holds itself: an alias (*) stands within its own anchor (&)") from None
    return raw, lines


def _collect_lines(node: yaml.Node | None, location: Location, lines: dict[Location, int], path: Path) -> None:
    if isinstance(node, yaml.MappingNode):
        seen: set[str] = set()
        for key, value in node.value:
            here = (*location, str(key.value))
            if str(key.value) in seen:
                raise ConfigError(f"{path}:{key.start_mark.line + 1}: {dotted(here)}: given twice")
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
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"--set {setting}: the value is not YAML: {' '.join(str(error).split())}") from None
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
            raise ConfigError(f"--set {setting}: {dotted(location[: n + 1])} is not in the mission")
    last: Any = location[-1]
    if isinstance(here, dict) or (isinstance(here, list) and isinstance(last, int) and last < len(here)):
        here[last] = value
    else:
        raise ConfigError(f"--set {setting}: {dotted(location[:-1])} is not a section that has keys")
