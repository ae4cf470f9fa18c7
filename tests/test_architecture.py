"""The structure holds by itself: sizes, generated documents, no test mode in flight code."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

from stockpilot.dataflow import DOCUMENT, with_table

ROOT = Path(__file__).resolve().parents[1]
FLIGHT_CODE = sorted((ROOT / "companion").rglob("*.py"))
ALL_CODE = [p for folder in ("companion", "simbridge", "stockpilot") for p in sorted((ROOT / folder).rglob("*.py"))]


def test_app_reads_on_one_page() -> None:
    assert len((ROOT / "companion" / "app.py").read_text(encoding="utf-8").splitlines()) <= 180


@pytest.mark.parametrize("path", ALL_CODE, ids=lambda p: str(p.relative_to(ROOT)))
def test_no_file_outgrows_its_job(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 600


@pytest.mark.parametrize("path", FLIGHT_CODE, ids=lambda p: str(p.relative_to(ROOT)))
def test_flight_code_has_no_test_mode_and_reads_no_environment(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    attributes = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    suspicious = re.compile(r"^(is_)?(sim|simulated|simulation|testing|test_mode|replay_mode)$")
    assert not [name for name in names | attributes if suspicious.match(name)]
    assert "environ" not in attributes
    assert "getenv" not in attributes


WALL_CLOCK_LABELS = {"companion/telemetry/mqtt.py", "companion/mavlink/keys.py"}  # age of commands, signing's epoch


@pytest.mark.parametrize("path", FLIGHT_CODE, ids=lambda p: str(p.relative_to(ROOT)))
def test_control_never_reads_the_wall_clock(path: Path) -> None:
    """A clock that steps can then change nothing but labels (docs/safety.md, 10)."""
    reads = re.search(r"time\.time(_ns)?\b|datetime\.", path.read_text(encoding="utf-8"))
    assert reads is None or str(path.relative_to(ROOT)) in WALL_CLOCK_LABELS


def test_dataflow_table_is_generated_from_the_topics() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    assert with_table(text) == text, "docs/dataflow.md is stale: run `make docs`"


def test_no_committed_lock_names_a_download_address() -> None:
    for lock in ("requirements.lock", "requirements-flight.lock"):
        assert "://" not in (ROOT / lock).read_text(encoding="utf-8")


def test_what_flies_needs_nothing_of_the_emulated_side() -> None:
    """On a vehicle the extra `sim` need not be installed: `stockpilot fly` must load and read a mission without it."""
    program = (
        "import sys\n"
        "class Absent:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] in ('simbridge', 'mujoco', 'shapely', 'trimesh', 'matplotlib', 'dask', 'pandas'):\n"
        "            raise ImportError(name)\n"
        "sys.meta_path.insert(0, Absent())\n"
        "import stockpilot.fly, stockpilot.report\n"
        "from stockpilot.mission import load_mission\n"
        "assert load_mission('missions/cement_store.yaml', with_world=False).sim is None\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
