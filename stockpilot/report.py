"""What a survey engineer reads after a flight: one page that needs nothing beside it, and a summary for the terminal.

Both take the dict of report.json; a key that is missing leaves its line out, so a cloud's report fits as well.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping
from datetime import date
from html import escape
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from stockpilot.report_page import PAGE, STYLE

CAPTIONS = {
    "trajectory": "Flown path and estimates in the plan of the hall.",
    "map": "The map as flown, from above and from the side, coloured by height.",
    "surface": "The surface above the floor, and its contours with what was seen, interpolated and unseen.",
}
PARTS = {
    "returns": "noise of single returns",
    "poses": "errors of the poses, as stretches of the flight differ",
    "turns": "turns that round walls do not show",
    "scale": "walls that lie elsewhere when seen from afar",
    "range": "offset of the sensor's range",
    "floor": "the floor under the pile",
    "walls": "where the pile meets the walls",
    "contact": "how high it meets them",
    "interpolated": "interpolated gaps",
    "unseen": "floor not seen",
    "obstacles": "obstacles standing in the pile",
    "doubt": "signs that the map is degraded",
}
Row = tuple[str, str]


def text_summary(report: Mapping[str, Any]) -> RenderableType:
    """For the terminal (rich): the number with its interval first, then how it was come by."""
    head = Text()
    head.append(f"{_volume(report)}\n", style="bold")
    head.append(_interval_text(report))
    mass = _mass(report)
    if mass:
        head.append(f"\n{mass}")
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_column(style="dim")
    table.add_column()
    for name, value in [*_floor_rows(report), *_flight_rows(report), *_truth_rows(report), *_paper_rows(report)]:
        table.add_row(name, value)
    parts: list[RenderableType] = [Panel(head, title=_title(report), title_align="left", expand=False), table]
    for warning in report.get("warnings") or []:
        parts.append(Text(f"warning: {warning}", style="yellow"))
    return Group(*parts)


def write_report_page(
    path: Path, report: Mapping[str, Any], pictures: Mapping[str, Path], *, bulk_density_t_m3: float | None = None
) -> Path:
    """Write the page, pictures embedded. pictures: name (trajectory, map, surface) -> PNG; missing files are left out.

    bulk_density_t_m3: of the material, for its mass; default: the report's own `bulk_density_t_m3`, if any.
    """
    if bulk_density_t_m3 is not None:
        report = {**report, "bulk_density_t_m3": bulk_density_t_m3}
    sections = [
        _banner(report),
        _hero(report),
        _warnings(report),
        _pictures(pictures, ("surface", "trajectory", "map")),
        _table("How the volume was come by", [*_floor_rows(report), *_budget_rows(report)]),
        _table("Flight", _flight_rows(report)),
        _table("Against the truth (known in the emulated store only)", _truth_rows(report)),
        _comparison(report),
    ]
    page = PAGE.format(
        title=escape(_title(report)), style=STYLE, body="\n".join(s for s in sections if s), made=_made(report)
    )
    part = path.with_name(f".{path.name}.part")
    part.write_text(page, encoding="utf-8")
    part.replace(path)
    return path


def _title(report: Mapping[str, Any]) -> str:
    name = str(report.get("mission") or report.get("cloud") or "stockpile")
    seed = report.get("seed")
    return f"{name}, seed {seed}" if seed is not None else name


def _made(report: Mapping[str, Any]) -> str:
    when = report.get("date") or date.today().isoformat()
    return f"stockpilot, {escape(str(when))}"


def _number(value: Any, digits: int = 1, unit: str = "") -> str | None:
    """None for what is not known."""
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        return None
    text = f"{value:,.{digits}f}"
    if float(text.replace(",", "")) == 0.0:
        text = text.lstrip("-")
    return f"{text} {unit}".strip()


def _volume(report: Mapping[str, Any]) -> str:
    return _number(report.get("volume_m3"), 1, "m³") or "volume not known"


def _bounds(report: Mapping[str, Any]) -> tuple[float, float] | None:
    pair = report.get("volume_interval_m3")
    if isinstance(pair, (list, tuple)) and len(pair) == 2 and all(_number(v) is not None for v in pair):
        return float(pair[0]), float(pair[1])
    return None


def _interval_text(report: Mapping[str, Any]) -> str:
    bounds = _bounds(report)
    level = 100 * float(report.get("volume_interval_level") or 0.95)
    if bounds is None and report.get("volume_m3") is not None and (pair := report.get("volume_interval_m3")):
        return (
            f"at least {_number(pair[0], 1, 'm³')} ({level:g} % confidence): nobody knows how much lies beyond the map"
        )
    if bounds is None:
        return "no interval: the map does not tell how wrong the number may be"
    low, high = bounds
    volume = report.get("volume_m3")
    share = ""
    if isinstance(volume, (int, float)) and volume > 0:
        share = f", ± {50 * (high - low) / volume:.2f} %"
    return f"{low:,.1f} to {high:,.1f} m³ with {level:g} % confidence{share}"


def _mass(report: Mapping[str, Any]) -> str | None:
    density, bounds, volume = report.get("bulk_density_t_m3"), _bounds(report), report.get("volume_m3")
    if not isinstance(density, (int, float)) or not isinstance(volume, (int, float)) or not math.isfinite(volume):
        return None
    mass = f"{volume * density:,.0f} t"
    span = f" ({bounds[0] * density:,.0f} to {bounds[1] * density:,.0f} t)" if bounds else ""
    return f"{mass}{span} at a bulk density of {density:g} t/m³, taken as exact"


def _rows(report: Mapping[str, Any], wanted: list[tuple[str, str, int, str, float]]) -> list[Row]:
    """(label, key, digits, unit, factor) of every key that has a number."""
    out = []
    for label, key, digits, unit, factor in wanted:
        value = report.get(key)
        text = _number(value * factor, digits, unit) if isinstance(value, (int, float)) else None
        if text is not None and not isinstance(value, bool):
            out.append((label, text))
    return out


def _floor_rows(report: Mapping[str, Any]) -> list[Row]:
    return _rows(
        report,
        [
            ("floor seen", "seen_ratio", 1, "%", 100.0),
            ("floor interpolated", "interpolated_ratio", 1, "%", 100.0),
            ("floor unseen", "unseen_ratio", 1, "%", 100.0),
            ("floor area within the walls", "floor_area_m2", 1, "m²", 1.0),
            ("area of the pile", "pile_area_m2", 1, "m²", 1.0),
        ],
    )


def _budget_rows(report: Mapping[str, Any]) -> list[Row]:
    budget = report.get("error_budget_m3") or {}
    parts = sorted(dict(budget).items(), key=lambda p: -p[1])
    return [(f"1σ from {PARTS.get(n, n)}", f"{v:,.2f} m³") for n, v in parts if v >= 0.005]


def _flight_rows(report: Mapping[str, Any]) -> list[Row]:
    rows: list[Row] = []
    if report.get("state") is not None:
        reason = report.get("reason")
        rows.append(("flight", f"{report['state']}{f' ({reason})' if reason else ''}"))
    if report.get("autopilot"):
        rows.append(("flight controller", str(report["autopilot"])))
    rows += _rows(
        report,
        [
            ("forward speed", "forward_speed_mps", 2, "m/s", 1.0),
            ("height", "height_m", 1, "m", 1.0),
            ("distance kept from the walls", "wall_distance_m", 1, "m", 1.0),
            ("RMS of the distance kept less the one wanted", "wall_distance_rms_m", 2, "m", 1.0),
            ("least clearance", "min_clearance_m", 2, "m", 1.0),
            ("landed from the start", "landed_from_start_m", 2, "m", 1.0),
            ("flight time", "flight_time_s", 0, "s", 1.0),
            ("computed in", "wall_time_s", 1, "s", 1.0),
            ("times real time", "real_time_factor", 1, "", 1.0),
            ("scans", "scans", 0, "", 1.0),
            ("keyframes", "keyframes", 0, "", 1.0),
            ("scan period", "scan_period_s", 1, "s", 1.0),
            ("longest gap in odometry", "odometry_max_gap_s", 3, "s", 1.0),
            ("LiDAR turned about the vertical beyond its mount", "lidar_turned_deg", 1, "deg", 1.0),
            ("1σ of that", "lidar_turned_sigma_deg", 1, "deg", 1.0),
            ("points in the cloud", "points", 0, "", 1.0),
        ],
    )
    for label, key, yes, no in (
        ("lap", "lap_closed", "closed", "NOT closed"),
        ("collision", "collision", "YES", "none"),
    ):
        if isinstance(report.get(key), bool):
            rows.append((label, yes if report[key] else no))
    return rows


def _truth_rows(report: Mapping[str, Any]) -> list[Row]:
    rows = _rows(
        report,
        [
            ("true volume", "truth_volume_m3", 1, "m³", 1.0),
            ("error of the volume", "e_v_percent", 2, "%", 1.0),
            ("the same with perfect poses", "e_v_percent_perfect_poses", 2, "%", 1.0),
            ("RMS error of position", "e_p_m", 3, "m", 1.0),
            ("least RMS that one scan allows (Cramér-Rao)", "cramer_rao_bound_m", 3, "m", 1.0),
            ("RMS error of heading", "e_yaw_deg", 3, "deg", 1.0),
            ("iterations of registration, in all", "c_c", 0, "", 1.0),
        ],
    )
    if isinstance(report.get("truth_in_interval"), bool) and report.get("truth_volume_m3") is not None:
        rows.append(("truth within the interval", "yes" if report["truth_in_interval"] else "NO"))
    return rows


def _paper_pairs(report: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """(label, ours, the paper's) where the paper's pipeline has a number."""
    paper = report.get("paper") or {}
    out = []
    for label, key, digits, unit in (
        ("volume", "volume_m3", 1, "m³"),
        ("error of the volume", "e_v_percent", 2, "%"),
        ("RMS error of position", "e_p_m", 3, "m"),
        ("RMS error of heading", "e_yaw_deg", 3, "deg"),
        ("iterations of registration, in all", "c_c", 0, ""),
    ):
        theirs = _number(paper.get(key), digits, unit)
        if theirs is not None:
            out.append((label, _number(report.get(key), digits, unit) or "-", theirs))
    return out


def _paper_rows(report: Mapping[str, Any]) -> list[Row]:
    return [(f"the paper's pipeline: {label}", theirs) for label, _, theirs in _paper_pairs(report)]


def _banner(report: Mapping[str, Any]) -> str:
    state = report.get("state")
    kind = "ok" if state in (None, "completed") else "bad"
    badge = f'<span class="badge {kind}">{escape(str(state))}</span>' if state is not None else ""
    return f"<header><p>Stockpile report</p><h1>{escape(_title(report))} {badge}</h1></header>"


def _hero(report: Mapping[str, Any]) -> str:
    mass = _mass(report)
    return (
        '<section class="hero"><div>'
        f'<p class="volume">{escape(_volume(report))}</p><p>{escape(_interval_text(report))}</p>'
        f"{f'<p>{escape(mass)}</p>' if mass else ''}{_interval_picture(report)}</div>"
        f"<div>{_ratio_picture(report)}</div></section>"
    )


def _interval_picture(report: Mapping[str, Any]) -> str:
    """A number line: the interval, the estimate, the truth where it is known."""
    bounds, volume, truth = _bounds(report), report.get("volume_m3"), report.get("truth_volume_m3")
    if bounds is None or _number(volume) is None or bounds[1] <= bounds[0]:
        return ""
    marks = [*bounds, float(str(volume)), *([float(str(truth))] if _number(truth) else [])]
    low, high = min(marks), max(marks)
    pad = 0.12 * (high - low)
    low, high = low - pad, high + pad

    def at(value: float) -> float:
        return round(420 * (value - low) / (high - low), 1)

    a, b, v = at(bounds[0]), at(bounds[1]), at(float(str(volume)))
    parts = [
        '<line x1="0" x2="420" y1="30" y2="30" class="axis"/>',
        f'<rect x="{a}" y="24" width="{round(b - a, 1)}" height="12" rx="2" class="interval"/>',
        f'<circle cx="{v}" cy="30" r="6" class="estimate"/>',
        f'<text x="{a}" y="56" class="mark">{bounds[0]:,.1f}</text>',
        f'<text x="{b}" y="56" class="mark">{bounds[1]:,.1f}</text>',
    ]
    if _number(truth) is not None:
        t = at(float(str(truth)))
        parts += [
            f'<path d="M{t} 20 l-6 -9 h12 z" class="truth"/>',
            f'<text x="{t}" y="8" class="mark">truth {float(str(truth)):,.1f}</text>',
        ]
    return f'<svg viewBox="-30 -6 480 68" role="img" aria-label="interval of the volume">{"".join(parts)}</svg>'


def _ratio_picture(report: Mapping[str, Any]) -> str:
    names = (("seen", "seen_ratio"), ("interpolated", "interpolated_ratio"), ("unseen", "unseen_ratio"))
    shares = [(name, report.get(key)) for name, key in names]
    known = [(name, float(v)) for name, v in shares if isinstance(v, (int, float)) and math.isfinite(v)]
    if len(known) < 3:
        return ""
    bars = "".join(f'<i class="{name}" style="flex:{max(v, 0.0):.4f}"></i>' for name, v in known if v > 0)
    legend = "".join(f'<li><b class="{name}"></b>{name} <em>{100 * v:.1f} %</em></li>' for name, v in known)
    return f'<p class="label">Of the floor within the walls</p><div class="bar">{bars}</div><ul class="legend">{legend}</ul>'


def _warnings(report: Mapping[str, Any]) -> str:
    warnings = report.get("warnings") or []
    if not warnings:
        return ""
    items = "".join(f"<li>{escape(str(w))}</li>" for w in warnings)
    return f'<section class="warnings"><h2>Read this before you use the number</h2><ul>{items}</ul></section>'


def _pictures(pictures: Mapping[str, Path], order: tuple[str, ...]) -> str:
    out = []
    for name in [*order, *(n for n in pictures if n not in order)]:
        file = pictures.get(name)
        if file is None or not Path(file).is_file():
            continue
        data = base64.b64encode(Path(file).read_bytes()).decode("ascii")
        caption = escape(CAPTIONS.get(name, name))
        out.append(
            f'<figure><img alt="{caption}" src="data:image/png;base64,{data}"><figcaption>{caption}</figcaption></figure>'
        )
    return f'<section class="pictures">{"".join(out)}</section>' if out else ""


def _table(title: str, rows: list[Row]) -> str:
    if not rows:
        return ""
    body = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows)
    return f'<section class="facts"><h2>{escape(title)}</h2><table>{body}</table></section>'


def _comparison(report: Mapping[str, Any]) -> str:
    pairs = _paper_pairs(report)
    if not pairs:
        return ""
    body = "".join(f"<tr><th>{escape(n)}</th><td>{escape(a)}</td><td>{escape(b)}</td></tr>" for n, a, b in pairs)
    return (
        '<section class="facts"><h2>Beside the paper\'s pipeline on the same scans</h2>'
        f"<table><tr><th></th><td><b>ours</b></td><td><b>the paper's</b></td></tr>{body}</table></section>"
    )
