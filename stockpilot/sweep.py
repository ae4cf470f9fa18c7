"""Many flights over a grid of mission keys, on Dask: resumable, one table, box plots, one page."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
import yaml
from pydantic import Field, ValidationError
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from companion.config import Section
from companion.errors import ConfigError
from companion.mapping.export import load_point_map, save_point_map
from companion.odometry.tilt import LEANS_EVENT, mount_warnings
from companion.odometry.turned import TurnedBy
from stockpilot.files import write_json
from stockpilot.mission import load_mission

POINT_MAP = "point_map"  # in what comes from a worker, not in the result's file
Job = Callable[[], dict[str, Any]]


class SweepFile(Section):
    """A sweep: missions x grid x seeds, each combination one closed-loop flight."""

    name: str | None = None
    description: str = ""
    missions: list[str] = Field(min_length=1, description="mission files, relative to the sweep file")
    set: dict[str, Any] = Field(default_factory=dict, description="mission keys set in every flight")
    grid: dict[str, list[Any]] = Field(default_factory=dict, description="mission key: values to go through")
    seeds: list[int] = Field(default=[0], min_length=1)
    perfect_poses: bool = Field(False, description="also measure each volume with the true poses, for comparison")


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepRun:
    """One flight of a sweep, named by its parameters and seed."""

    name: str
    mission: str
    settings: tuple[str, ...]
    parameters: tuple[tuple[str, Any], ...]
    seed: int
    perfect_poses: bool

    def __hash__(self) -> int:
        return hash(self.name)  # values of a grid may be lists


def load_sweep(path: Path) -> tuple[SweepFile, list[SweepRun]]:
    """The sweep and its runs, every mission validated before anything flies. Raises: ConfigError."""
    try:
        raw = yaml.safe_load(path.read_text(encoding="utf-8"))
        sweep = SweepFile.model_validate(raw)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such sweep file") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is not YAML: {error}") from None
    except ValidationError as error:
        allowed = ", ".join(SweepFile.model_fields)
        faults = (
            f"{path}: {'.'.join(map(str, e['loc'])) or '(file)'}: {e['msg']}; keys: {allowed}" for e in error.errors()
        )
        raise ConfigError("\n".join(faults)) from None
    if not all(sweep.grid.values()):
        raise ConfigError(f"{path}: grid: each key needs at least one value")
    runs = list(_runs(path, sweep))
    checked: set[tuple[str, tuple[str, ...]]] = set()
    for run in runs:
        if (run.mission, run.settings) not in checked:
            checked.add((run.mission, run.settings))
            load_mission(run.mission, run.settings, seed=run.seed)
    return sweep, runs


def _runs(path: Path, sweep: SweepFile) -> Iterator[SweepRun]:
    fixed = tuple(f"{key}={json.dumps(value)}" for key, value in sweep.set.items())
    for mission in sweep.missions:
        mission_path = (path.parent / mission).resolve()
        for values in itertools.product(*sweep.grid.values()):
            parameters = tuple(zip(sweep.grid.keys(), values, strict=True))
            varied = tuple(f"{key}={json.dumps(value)}" for key, value in parameters)
            for seed in sweep.seeds:
                shown = (Path(mission).stem, *(f"{key.split('.')[-1]}={_slug(value)}" for key, value in parameters))
                identity = json.dumps([Path(mission).name, fixed, varied, seed, sweep.perfect_poses])
                tag = hashlib.sha256(identity.encode()).hexdigest()[:8]
                yield SweepRun(
                    name="_".join((*shown, f"seed={seed}", tag)),
                    mission=str(mission_path),
                    settings=(*fixed, *varied),
                    parameters=(("mission", Path(mission).stem), *parameters),
                    seed=seed,
                    perfect_poses=sweep.perfect_poses,
                )


def _slug(value: object) -> str:
    return re.sub(r"[^A-Za-z0-9.+-]+", "-", json.dumps(value)).strip("-")[:40]


def fly_run(run: SweepRun, *, keep_map: bool = False) -> dict[str, Any]:
    """One flight, anywhere: its report, its parameters, its path in plan, its point map if asked. Runs in a worker."""
    from stockpilot.run import fly_lockstep

    mission = load_mission(run.mission, run.settings, seed=run.seed)
    flown = fly_lockstep(mission, with_perfect_poses=run.perfect_poses)
    truth = flown.outcome.truth.position_world_m[::25]
    return {
        **({POINT_MAP: flown.scored.point_map} if keep_map else {}),
        "run": run.name,
        "parameters": dict(run.parameters),
        "report": flown.scored.report,
        "path_world_m": [[round(float(x), 3), round(float(y), 3)] for x, y in truth[:, :2]],
        "outlines_world_m": [[[float(x), float(y)] for x, y in ring] for ring in flown.world.outlines()],
    }


def measure_run(run: SweepRun, *, result: dict[str, Any], map_file: Path) -> dict[str, Any]:
    """The result of a flight with its volume measured anew from the map it left. Runs in a worker.

    What the true poses would give is left out: it needs the flight.
    """
    from companion.volume import estimate_volume
    from stockpilot.results import volume_scores

    mission = load_mission(run.mission, run.settings, seed=run.seed)
    report = {key: value for key, value in result["report"].items() if key != "e_v_percent_perfect_poses"}
    volume = estimate_volume(
        load_point_map(map_file), mission.companion.volume, is_cut_short=not report.get("lap_closed")
    )
    turned_by = TurnedBy(
        *(math.radians(report.get(key, math.inf)) for key in ("lidar_turned_deg", "lidar_turned_sigma_deg"))
    )
    leans = any(event["name"] == LEANS_EVENT for event in report.get("events", ()))
    volume = replace(volume, warnings=(*volume.warnings, *mount_warnings(turned_by, leans=leans)))
    return {**result, "report": {**report, **volume_scores(volume, report["truth_volume_m3"])}}


def sweep_command(
    sweep_file: Annotated[
        Path, typer.Argument(help="sweep file (YAML), e.g. missions/paper_sweep.yaml", show_default=False)
    ],
    out: Annotated[Path | None, typer.Option(help="folder for results; default runs/<sweep>")] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="tcp://HOST:8786 of a Dask scheduler; default: this machine")
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="processes on this machine; default: one a core")] = None,
    docs: Annotated[
        Path | None, typer.Option(help="fill this document's block of the sweep, e.g. docs/results.md")
    ] = None,
    limit: Annotated[
        int | None,
        typer.Option(min=0, help="fly so many of the missing ones now, spread evenly; 0: only tell what is there"),
    ] = None,
    keep_maps: Annotated[
        bool, typer.Option(help="keep each flight's point map beside its result (.ply, some 50 MB each)")
    ] = False,
    remeasure: Annotated[
        bool,
        typer.Option(help="fly none: measure the volume again, with this version, in the maps that were kept"),
    ] = False,
    list_only: Annotated[bool, typer.Option("--list", help="name the flights, fly none")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="print the summary as JSON on stdout")] = False,
) -> None:
    """Fly a grid of missions, skip what is there already, and put all results in one table and one page.

    A sweep that was stopped goes on where it was: start the same command again. To try the volume's own code or its
    interval on all flights of a sweep without flying them again: --keep-maps while flying, then --remeasure.
    """
    from stockpilot.sweep_report import fill_document, summarise, write_sweep_report

    if remeasure and (keep_maps or limit is not None):
        raise ConfigError(
            "--remeasure measures all flights that are there again: --limit and --keep-maps do not go with it"
        )
    sweep, runs = load_sweep(sweep_file)
    name = sweep.name or sweep_file.stem
    folder = out or Path("runs") / name
    if list_only:
        for run in runs:
            typer.echo(run.name)
        return
    folder.mkdir(parents=True, exist_ok=True)
    done = read_results(folder, runs)
    console = Console(stderr=True)
    if done:
        console.print(f"{len(done)} of {len(runs)} flights are there already")
    if remeasure:
        jobs = _to_measure(folder, [run for run in runs if run.name in done], done)
    else:
        missing = spread([run for run in runs if run.name not in done], limit)
        jobs = {run: partial(fly_run, run, keep_map=keep_maps) for run in missing}
    failed: dict[str, str] = {}
    for run, result in _compute_all(jobs, scheduler, workers, console) if jobs else ():
        if isinstance(result, dict):
            point_map = result.pop(POINT_MAP, None)
            if point_map is not None:
                save_point_map(point_map, _map_file(folder, run))
            write_json(folder / f"{run.name}.json", result)
            done[run.name] = result
        else:
            failed[run.name] = str(result)
            console.print(f"[red]{run.name}: {result}[/]")
    results = [done[run.name] for run in runs if run.name in done]
    if not results:
        raise ConfigError(f"{sweep_file}: no flight gave a result: {next(iter(failed.values()), 'nothing to fly')}")
    page = write_sweep_report(folder, name, sweep.description, results)
    summary = {**summarise(results), "failed": failed, "page": str(page), "table": str(folder / "results.parquet")}
    if docs is not None:
        fill_document(docs, name, results, command=f"stockpilot sweep {sweep_file}")
    if as_json:
        typer.echo(json.dumps(summary, indent=2))
    else:
        for key, value in summary.items():
            typer.echo(f"{key:28} {value}")
    if failed or len(results) < len(runs):
        raise typer.Exit(1)


def spread(runs: Sequence[SweepRun], limit: int | None) -> list[SweepRun]:
    """At most `limit` of them, evenly spaced, so that a part of a sweep speaks for all of it."""
    if limit is None or limit >= len(runs):
        return list(runs)
    return [runs[n * len(runs) // limit] for n in range(limit)]


def read_results(folder: Path, runs: Iterable[SweepRun]) -> dict[str, dict[str, Any]]:
    """Results that are there and whole, by run name."""
    found = {run.name: read_result(folder / f"{run.name}.json") for run in runs}
    return {name: result for name, result in found.items() if result is not None}


def read_result(path: Path) -> dict[str, Any] | None:
    """A flight's result; None where it is missing, is not whole (told), or is something else."""
    if not path.exists():
        return None
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError):
        print(f"{path}: not whole: it does not count", file=sys.stderr)
        return None
    return result if isinstance(result, dict) and "report" in result else None


def _map_file(folder: Path, run: SweepRun) -> Path:
    return folder / f"{run.name}.ply"


def _to_measure(folder: Path, flown: Sequence[SweepRun], done: Mapping[str, dict[str, Any]]) -> dict[SweepRun, Job]:
    """Raises: ConfigError: a flight left no map: a table of two versions would be worse than none."""
    without = [run.name for run in flown if not _map_file(folder, run).is_file()]
    if without or not flown:
        raise ConfigError(
            f"{folder}: {len(without)} of {len(flown)} flights left no point map, {next(iter(without), 'nothing flown')}: "
            "fly them with --keep-maps first"
        )
    return {
        run: partial(measure_run, run, result=done[run.name], map_file=_map_file(folder, run).resolve())
        for run in flown
    }


def _compute_all(
    jobs: Mapping[SweepRun, Job], scheduler: str | None, workers: int | None, console: Console
) -> Iterator[tuple[SweepRun, dict[str, Any] | Exception]]:
    from dask.distributed import Client, LocalCluster, as_completed

    columns = (
        TextColumn("[progress.description]{task.description}"), BarColumn(), MofNCompleteColumn(),
        TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(),
    )  # fmt: skip
    cluster = None
    if scheduler is None:
        count = min(workers or os.cpu_count() or 1, len(jobs))
        cluster = LocalCluster(
            n_workers=count, threads_per_worker=1, processes=True, dashboard_address="127.0.0.1:0", host="127.0.0.1",
            memory_limit=0, silence_logs=40,
        )  # fmt: skip
    try:
        with (
            Client(cluster if cluster is not None else scheduler) as client,
            Progress(*columns, console=console, refresh_per_second=1) as bar,
        ):
            task = bar.add_task("flights", total=len(jobs))
            futures = {client.submit(job, key=run.name, pure=False, retries=2): run for run, job in jobs.items()}
            for future in as_completed(list(futures)):
                run = futures.pop(future)
                error = future.exception()
                yield run, (error if error is not None else future.result())
                future.release()
                bar.advance(task)
    finally:
        if cluster is not None:
            cluster.close()
