"""`stockpilot run`: one flight in the emulated store, scored, written and told."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

import typer
from rich.console import Console
from rich.progress import Progress, TextColumn, TimeElapsedColumn

from companion.errors import ConfigError
from companion.flight import Flight
from companion.garbage import collected_seldom
from companion.warm_up import warm_up
from simbridge.autopilot import Autopilot
from simbridge.config import SimConfig
from simbridge.loop import Simulation
from simbridge.world import World
from stockpilot.files import begin_folder
from stockpilot.lockstep import Lockstep, Outcome, Wire
from stockpilot.mission import Mission, load_mission
from stockpilot.results import Scored, score_flight
from stockpilot.wires import OFFBOARD, EmulatedWire, emulated_autopilot

SECONDS_BEYOND_FLIGHT = 300.0  # on the ground: time sync, vision, arming


@dataclass(slots=True)
class Flown:
    """A finished flight and all that is known of it."""

    mission: Mission
    flight: Flight
    world: World
    outcome: Outcome
    scored: Scored


@dataclass(slots=True)
class Prepared:
    """Both sides, built and joined, before the first step."""

    mission: Mission
    simulation: Simulation
    wire: Wire
    flight: Flight
    autopilot: str
    closing: ExitStack = field(default_factory=ExitStack)


def emulated(cfg: SimConfig, links: tuple[str, ...] = (OFFBOARD,)) -> tuple[Simulation, Autopilot]:
    """The world with the emulated flight controller. Raises: ConfigError: an unknown parameter."""
    try:
        controller = emulated_autopilot(cfg, links)
    except ValueError as error:
        raise ConfigError(f"autopilot.params: {error}") from None
    return Simulation(cfg, controller), controller


def prepare(mission: Mission, *, autopilot: str = "emulated", binary: Path | None = None) -> Prepared:
    """Build the world, the flight controller and the companion. Raises: ConfigError: no world; no such autopilot."""
    if mission.sim is None:
        raise ConfigError(f"{mission.path}: world: is missing: only `stockpilot fly` can fly a mission without a world")
    if autopilot == "emulated":
        simulation, controller = emulated(mission.sim)
        wire: Wire = EmulatedWire(controller, mission.sim, lambda: simulation.liftoff_ns)
        closing = ExitStack()
    else:
        from stockpilot.real_autopilot import prepare_real

        simulation, wire, closing = prepare_real(mission.sim, autopilot, binary)
    flight = Flight(config=mission.companion, lidar_metadata_json=simulation.lidar_metadata_json())
    return Prepared(
        mission=mission, simulation=simulation, wire=wire, flight=flight, autopilot=autopilot, closing=closing
    )


def fly_lockstep(
    mission: Mission, *, autopilot: str = "emulated", binary: Path | None = None, with_perfect_poses: bool = False,
    progress: Callable[[Lockstep], None] | None = None,
    attach: Callable[[Lockstep], None] | None = None,
) -> Flown:  # fmt: skip
    """Fly a mission to its end and score it. `attach` may hang a recorder on the runner before the first step."""
    prepared = prepare(mission, autopilot=autopilot, binary=binary)
    with prepared.closing:
        runner = Lockstep(
            simulation=prepared.simulation, wire=prepared.wire, flight=prepared.flight,
            max_simulated_s=mission.companion.navigator.max_flight_time_s + SECONDS_BEYOND_FLIGHT,
        )  # fmt: skip
        if attach is not None:
            attach(runner)
        with collected_seldom():
            outcome = runner.run(progress)
    scored = score_flight(
        mission, prepared.flight, prepared.simulation.world, outcome, autopilot=autopilot,
        min_clearance_m=prepared.simulation.min_clearance_m, collision=prepared.simulation.collision,
        with_perfect_poses=with_perfect_poses,
    )  # fmt: skip
    return Flown(
        mission=mission, flight=prepared.flight, world=prepared.simulation.world, outcome=outcome, scored=scored
    )


def run_command(
    path: Path, *, seed: int | None, out: Path | None, settings: list[str], autopilot: str | None, binary: Path | None,
    record: bool, as_json: bool,
) -> int:  # fmt: skip
    """Exit code: 0 completed, 1 not."""
    from stockpilot.leave import write_results

    mission = load_mission(path, settings, seed=seed)
    autopilot = autopilot or mission.autopilot
    folder = begin_folder(out or Path("runs") / f"{mission.name}-{mission.seed}")
    console = Console(stderr=True)
    console.print("warming up (a minute the first time on a computer) ...", style="dim")
    warm_up(mission.companion)
    with ExitStack() as stack:
        show = stack.enter_context(_progress(console))
        recorder = None
        if record:
            from stockpilot.recorded import LockstepRecorder

            recorder = stack.enter_context(LockstepRecorder(folder, mission, autopilot))

        def attach(runner: Lockstep) -> None:
            if recorder is not None:
                recorder.attach(runner)
            stack.enter_context(_signals_abort(runner, console))

        flown = fly_lockstep(mission, autopilot=autopilot, binary=binary, progress=show, attach=attach)
        if recorder is not None:
            recorder.volume(flown.scored.volume)
    console.print("measuring and drawing ...", style="dim")
    write_results(folder, flown)
    if as_json:
        typer.echo((folder / "report.json").read_text(encoding="utf-8").rstrip())
    else:
        from stockpilot.report import text_summary

        Console().print(text_summary(flown.scored.report))
        typer.echo(f"results in {folder}")
    return 0 if flown.outcome.state == "completed" else 1


@contextmanager
def _progress(console: Console) -> Iterator[Callable[[Lockstep], None]]:
    """A line that lives: simulated time, speed, what the vehicle does."""
    columns = (TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, refresh_per_second=4) as bar:
        task = bar.add_task("starting", total=None)
        printed = ""

        def show(runner: Lockstep) -> None:
            nonlocal printed
            navigation = runner.flight.navigation
            phase = navigation.state.value if navigation is not None else "start"
            bar.update(task, description=f"{runner.simulation.t_ns * 1e-9:7.1f} s  {phase:12}")
            if phase != printed:
                printed = phase
                console.print(f"[dim]{runner.simulation.t_ns * 1e-9:7.1f} s[/]  {phase}", highlight=False)

        yield show


@contextmanager
def _signals_abort(runner: Lockstep, console: Console) -> Iterator[None]:
    """SIGINT and SIGTERM land the vehicle; a second one ends the program."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def handle(number: int, _frame: FrameType | None) -> None:
        runner.abort(signal.Signals(number).name.lower())
        console.print(f"[bold yellow]{signal.Signals(number).name}: landing; once more ends at once[/]")
        signal.signal(number, signal.SIG_DFL if number == signal.SIGTERM else signal.default_int_handler)

    for number in before:
        signal.signal(number, handle)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
