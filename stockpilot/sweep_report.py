"""One table, the box plots of figure 6 and one page for a sweep; and the block of docs/results.md that it fills."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

from companion.errors import ConfigError

Result = dict[str, Any]
WORST_SHOWN = 6
# Colour-blind safe (Okabe and Ito).
OURS, PAPER = "#0072B2", "#D55E00"


def flat_row(result: Result) -> dict[str, Any]:
    """One row of the table: parameters, every key of the report, the paper's under paper_."""
    report = result["report"]
    row: dict[str, Any] = {"run": result["run"]}
    row.update(
        {f"set.{key}" if key != "mission" else "set.mission": _cell(v) for key, v in result["parameters"].items()}
    )
    for key, value in report.items():
        if key == "paper":
            row.update({f"paper_{name}": item for name, item in value.items()})
        elif key in ("events", "warnings"):
            row[key] = len(value)
        elif key == "error_budget_m3":
            row.update({f"sigma_{_slug(name)}_m3": item for name, item in value.items()})
        elif key == "volume_interval_m3":
            low, high = value if value else (None, None)
            row["volume_interval_low_m3"], row["volume_interval_high_m3"] = low, high
        else:
            row[key] = _cell(value)
    return row


def _slug(name: str) -> str:
    return "_".join(name.lower().split())


def _cell(value: Any) -> Any:
    return value if value is None or isinstance(value, bool | int | float | str) else str(value)


def is_confident_and_wrong(report: dict[str, Any]) -> bool:
    """The worst result: the truth outside an interval that was given without a warning."""
    return report.get("volume_m3") is not None and not report.get("truth_in_interval") and not report.get("warnings")


def interval_scores(report: dict[str, Any]) -> dict[str, float]:
    """How wide the interval is and how far the error fills it; nothing where it has no upper end."""
    _, high = report.get("volume_interval_m3") or (None, None)
    volume, truth = report.get("volume_m3"), report.get("truth_volume_m3")
    if high is None or volume is None or not truth or not high > volume:
        return {}
    sigma = (high - volume) / NormalDist().inv_cdf(0.5 + (report.get("volume_interval_level") or 0.95) / 2)
    return {"half_width_percent": 100.0 * (high - volume) / truth, "error_over_sigma": (volume - truth) / sigma}


def rms(values: np.ndarray[Any, np.dtype[np.float64]]) -> float | None:
    """Root of the mean square; None of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def summarise(results: Sequence[Result]) -> dict[str, Any]:
    """The figures that the targets speak of, over all flights."""
    reports = [result["report"] for result in results]
    e_p = _numbers(reports, "e_p_m")
    e_v = np.abs(_numbers(reports, "e_v_percent"))
    keyframes = _numbers(reports, "keyframes")
    c_c = _numbers(reports, "c_c")
    paper = [report.get("paper") or {} for report in reports]
    intervals = [interval_scores(report) for report in reports]
    return {
        "flights": len(reports),
        "completed": sum(report["state"] == "completed" for report in reports),
        "collisions": sum(bool(report["collision"]) for report in reports),
        "lap_closed": sum(bool(report.get("lap_closed")) for report in reports),
        "min_clearance_m_min": _min(_numbers(reports, "min_clearance_m")),
        "wall_distance_rms_m_max": _max(_numbers(reports, "wall_distance_rms_m")),
        "landed_from_start_m_max": _max(_numbers(reports, "landed_from_start_m")),
        "odometry_max_gap_s_max": _max(_numbers(reports, "odometry_max_gap_s")),
        "e_p_m_median": _median(e_p),
        "e_p_m_max": _max(e_p),
        "e_p_xy_m_median": _median(_numbers(reports, "e_p_xy_m")),
        "e_yaw_deg_max": _max(_numbers(reports, "e_yaw_deg")),
        "cramer_rao_bound_m_median": _median(_numbers(reports, "cramer_rao_bound_m")),
        "abs_e_v_percent_median": _median(e_v),
        "abs_e_v_percent_max": _max(e_v),
        "abs_e_v_percent_perfect_poses_median": _median(np.abs(_numbers(reports, "e_v_percent_perfect_poses"))),
        "truth_in_interval_ratio": float(np.mean([bool(r.get("truth_in_interval")) for r in reports])),
        "interval_half_width_percent_median": _median(_numbers(intervals, "half_width_percent")),
        "error_over_sigma_rms": rms(_numbers(intervals, "error_over_sigma")),
        "outside_without_warning": sum(is_confident_and_wrong(report) for report in reports),
        "c_c_per_keyframe": float(c_c.sum() / keyframes.sum()) if keyframes.sum() else None,
        "paper_e_p_m_median": _median(_numbers(paper, "e_p_m")),
        "paper_abs_e_v_percent_median": _median(np.abs(_numbers(paper, "e_v_percent"))),
        "paper_c_c_per_keyframe": float(_numbers(paper, "c_c").sum() / keyframes.sum()) if keyframes.sum() else None,
        "real_time_factor_median": _median(_numbers(reports, "real_time_factor")),
    }


def trends(results: Sequence[Result]) -> list[dict[str, Any]]:
    """The paper's claim on its own pipeline: more scans, higher c_c, e_p and |e_v|. Spearman's rank correlation with
    the number of keyframes, told as it is, for both pipelines."""
    from scipy.stats import spearmanr

    reports = [result["report"] for result in results]
    scans = _numbers(reports, "keyframes")
    out: list[dict[str, Any]] = []
    for name, sources in (("paper", [r.get("paper") or {} for r in reports]), ("ours", reports)):
        for key in ("c_c", "e_p_m", "e_v_percent"):
            values = np.abs(_numbers(sources, key, keep=True))
            used = np.isfinite(values)
            rank = math.nan
            if used.sum() >= 4 and np.ptp(values[used]) > 0 and np.ptp(scans[used]) > 0:
                rank = float(spearmanr(scans[used], values[used]).statistic)
            holds = bool(rank > 0.3) if math.isfinite(rank) else None
            out.append({"pipeline": name, "metric": key, "rank_correlation": rank, "rises_with_scans": holds})
    return out


def write_sweep_report(folder: Path, name: str, description: str, results: Sequence[Result]) -> Path:
    """results.parquet, results.csv, figure6.png, index.html in `folder`; returns the page."""
    import pandas as pd

    table = pd.DataFrame([flat_row(result) for result in results])
    table.to_csv(folder / "results.csv", index=False)
    table.to_parquet(folder / "results.parquet", index=False)
    picture = _box_plots(results)
    (folder / "figure6.png").write_bytes(picture)
    worst = sorted(results, key=lambda r: -abs(r["report"].get("e_p_m") or math.inf))[:WORST_SHOWN]
    plans = [(r, _plan(r)) for r in worst]
    page = folder / "index.html"
    page.write_text(_page(name, description, results, picture, plans), encoding="utf-8")
    return page


def results_block(name: str, results: Sequence[Result], command: str) -> str:
    """Markdown for docs/results.md."""
    figures = summarise(results)
    lines = [f"`{command}`", "", "| figure | value |", "|---|---|"]
    lines += [f"| {key} | {_short(value)} |" for key, value in figures.items()]
    lines += [
        "",
        "| by | flights | e_p median, m | e_p max, m | abs e_v median, % | abs e_v max, % | in interval | unsure | paper e_p, m |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for label, group in _groups(results):
        reports = [r["report"] for r in group]
        paper = [r.get("paper") or {} for r in reports]
        e_v = np.abs(_numbers(reports, "e_v_percent"))
        cells = [
            label, len(group), _median(_numbers(reports, "e_p_m")), _max(_numbers(reports, "e_p_m")), _median(e_v), _max(e_v),
            f"{sum(bool(r.get('truth_in_interval')) for r in reports)} of {len(group)}",
            sum(bool(r.get("warnings")) for r in reports), _median(_numbers(paper, "e_p_m")),
        ]  # fmt: skip
        lines.append("| " + " | ".join(_short(cell) for cell in cells) + " |")
    lines += [
        "",
        "| pipeline | metric | rank correlation with the number of keyframes | rises with scans |",
        "|---|---|---|---|",
    ]
    for trend in trends(results):
        told = {True: "yes", False: "no", None: "cannot be told"}[trend["rises_with_scans"]]
        lines.append(f"| {trend['pipeline']} | {trend['metric']} | {_short(trend['rank_correlation'])} | {told} |")
    return "\n".join(lines)


def fill_document(path: Path, name: str, results: Sequence[Result], *, command: str) -> None:
    """Put the sweep's block between its markers. Raises: ConfigError: the document has none."""
    fill_block(path, f"sweep {name}", results_block(name, results, command))


def fill_block(path: Path, name: str, block: str) -> None:
    """Put text between a document's markers of that name. Raises: ConfigError: the document has none."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    text = path.read_text(encoding="utf-8")
    before, found, rest = text.partition(begin)
    _, found_end, after = rest.partition(end)
    if not found or not found_end:
        raise ConfigError(f"{path}: expected the lines {begin} and {end} where the table belongs")
    path.write_text(f"{before}{begin}\n{block}\n{end}{after}", encoding="utf-8")


# ---------------------------------------------------------------------------------------------------------------------


def _numbers(
    rows: Sequence[Mapping[str, Any]], key: str, *, keep: bool = False
) -> np.ndarray[Any, np.dtype[np.float64]]:
    values = [row.get(key) for row in rows]
    if keep:
        return np.array([math.nan if v is None else float(v) for v in values])
    return np.array([float(v) for v in values if v is not None])


def _median(values: np.ndarray[Any, np.dtype[np.float64]]) -> float | None:
    return float(np.median(values)) if len(values) else None


def _min(values: np.ndarray[Any, np.dtype[np.float64]]) -> float | None:
    return float(np.min(values)) if len(values) else None


def _max(values: np.ndarray[Any, np.dtype[np.float64]]) -> float | None:
    return float(np.max(values)) if len(values) else None


def _short(value: Any) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _groups(results: Sequence[Result]) -> list[tuple[str, list[Result]]]:
    """Flights by the values of their parameters, in the order flown."""
    groups: dict[str, list[Result]] = {}
    for result in results:
        label = ", ".join(
            f"{key.split('.')[-1]} {value}" if key != "mission" else str(value)
            for key, value in result["parameters"].items()
        )
        groups.setdefault(label, []).append(result)
    return list(groups.items())


def _ticks(results: Sequence[Result], groups: Sequence[tuple[str, list[Result]]]) -> tuple[list[str], str]:
    """Under each box the values of what varies in the sweep, each in a line of its own; and what those are."""
    names = list(results[0]["parameters"])
    varied = [name for name in names if len({str(r["parameters"].get(name)) for r in results}) > 1] or names[:1]
    labels = ["\n".join(str(group[0]["parameters"].get(name)) for name in varied) for _, group in groups]
    return labels, ", ".join(name.split(".")[-1] for name in varied)


def _box_plots(results: Sequence[Result]) -> bytes:
    from matplotlib.figure import Figure

    panels = (
        ("c_c", "c_c: total ICP iterations"), ("e_p_m", "e_p: position error, m"),
        ("e_v_percent", "|e_v|: volume error, %"), ("keyframes", "scans recorded"),
    )  # fmt: skip
    groups = _groups(results)
    labels, varied = _ticks(results, groups)
    figure = Figure(figsize=(max(9.0, 0.75 * len(groups) + 4), 12), layout="constrained")
    axes = figure.subplots(len(panels), 1, sharex=True)
    for axis, (key, title) in zip(axes, panels, strict=True):
        ours = [np.abs(_numbers([r["report"] for r in group], key)) for _, group in groups]
        paper = [np.abs(_numbers([r["report"].get("paper") or {} for r in group], key)) for _, group in groups]
        for values, offset, colour, label in (
            (ours, -0.17, OURS, "stockpilot"),
            (paper, 0.17, PAPER, "the paper's method"),
        ):
            if key == "keyframes" and offset > 0:
                continue
            drawn = axis.boxplot(
                values, positions=[n + offset for n in range(len(groups))], widths=0.28, patch_artist=True,
                medianprops={"color": "black"}, showfliers=False,
            )  # fmt: skip
            for box in drawn["boxes"]:
                box.set(facecolor=colour, alpha=0.5)
            for n, each in enumerate(values):  # every flight: a box of one would be but a dash
                axis.plot(np.full(len(each), n + offset), each, ".", color=colour, markersize=5, zorder=3)
            axis.plot([], [], "s", color=colour, label=label)
        axis.set_ylabel(title)
        if key in ("e_p_m", "e_v_percent"):
            axis.set_yscale("log")
        axis.grid(axis="y", alpha=0.3)
    axes[0].legend(loc="upper right")
    axes[-1].set_xticks(range(len(groups)), labels, fontsize=9)
    axes[-1].set_xlabel(f"by {varied}")
    figure.suptitle(f"Both pipelines on the same {len(results)} flights, as figure 6 of the paper")
    return _png(figure)


def _plan(result: Result) -> bytes:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2, 3.2), layout="constrained")
    axis = figure.subplots()
    for ring in result["outlines_world_m"]:
        closed = np.array([*ring, ring[0]])
        axis.plot(closed[:, 0], closed[:, 1], color="black", linewidth=1)
    path = np.array(result["path_world_m"]).reshape(-1, 2)
    axis.plot(path[:, 0], path[:, 1], color=OURS, linewidth=1)
    if len(path):
        axis.plot(*path[0], "o", color=PAPER, markersize=5)
    axis.set_aspect("equal")
    axis.set_xlabel("x, m")
    axis.set_ylabel("y, m")
    return _png(figure)


def _png(figure: Any) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)
    return buffer.getvalue()


def _image(png: bytes, alt: str) -> str:
    return f'<img alt="{html.escape(alt)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'


STYLE = """
body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:1200px;padding:0 1rem;color:#1a1a1a}
table{border-collapse:collapse;font-size:13px}td,th{border-bottom:1px solid #ddd;padding:.25rem .6rem;text-align:right}
td:first-child,th:first-child{text-align:left}img{max-width:100%;height:auto}.scroll{overflow-x:auto}
.plans{display:flex;flex-wrap:wrap;gap:1rem}figure{margin:0;max-width:380px}figcaption{font-size:13px}.bad{color:#b00020}
"""


def _page(
    name: str, description: str, results: Sequence[Result], picture: bytes, plans: Sequence[tuple[Result, bytes]]
) -> str:
    rows = [flat_row(result) for result in results]
    shown = [
        "run", "state", "forward_speed_mps", "scan_period_s", "keyframes", "e_p_m", "e_yaw_deg", "volume_m3",
        "truth_volume_m3", "e_v_percent", "volume_interval_low_m3", "volume_interval_high_m3", "truth_in_interval",
        "unseen_ratio", "wall_distance_rms_m", "min_clearance_m", "paper_e_p_m", "paper_e_v_percent", "paper_c_c",
    ]  # fmt: skip
    head = "".join(f"<th>{html.escape(key)}</th>" for key in shown)
    body = "".join(
        f"<tr{'' if row.get('state') == 'completed' else ' class=bad'}>"
        + "".join(f"<td>{html.escape(_short(row.get(key)))}</td>" for key in shown) + "</tr>"
        for row in rows
    )  # fmt: skip
    figures = "".join(f"<tr><td>{key}</td><td>{_short(v)}</td></tr>" for key, v in summarise(results).items())
    trend_rows = "".join(
        f"<tr><td>{t['pipeline']}: {t['metric']}</td><td>{_short(t['rank_correlation'])}</td></tr>"
        for t in trends(results)
    )
    drawn = "".join(
        f"<figure>{_image(png, 'plan of ' + r['run'])}<figcaption>{html.escape(r['run'])}: e_p "
        f"{_short(r['report'].get('e_p_m'))} m, e_v {_short(r['report'].get('e_v_percent'))} %, {r['report']['state']}"
        "</figcaption></figure>"
        for r, png in plans
    )  # fmt: skip
    return (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{html.escape(name)}</title><style>{STYLE}</style>"
        f"<h1>{html.escape(name)}</h1><p>{html.escape(description)}</p><h2>All flights</h2><table>{figures}</table>"
        f"<h2>Figure 6</h2>{_image(picture, 'box plots of c_c, e_p, e_v and scans')}"
        f"<h2>Trends: rank correlation with the number of keyframes</h2><table>{trend_rows}</table>"
        f"<h2>The worst flights by e_p</h2><div class=plans>{drawn}</div>"
        f"<h2>Every flight</h2><div class=scroll><table><tr>{head}</tr>{body}</table></div></html>"
    )
