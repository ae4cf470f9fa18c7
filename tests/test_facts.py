"""docs/facts.md and docs/safety.md name tests: each must be there, and say what it stands for."""

from __future__ import annotations

import ast
import re
from typing import get_args

import pytest
import yaml

from simbridge.config import FaultConfig
from tests.named_tests import ROOT, claims_something, functions_of, letters, named_in, rows
from tests.shared_data import shared_data

FACTS = (ROOT / "docs" / "facts.md").read_text(encoding="utf-8")
SAFETY = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
SHEETS = ("AUTOPILOTS.md", "PX4.md")


def facts_of(sheet: str) -> list[tuple[str, list[tuple[str, str]]]]:
    """(words of the sheet, tests that stand for them)."""
    section = FACTS.split(f"\n## {sheet}\n")[1].split("\n## ")[0]
    files = letters(FACTS)
    return [(cells[0].strip('"'), named_in(cells[1], files)) for cells in rows(section)[1:]]


ALL_FACTS = [(sheet, words, tests) for sheet in SHEETS for words, tests in facts_of(sheet)]


def plain(text: str) -> str:
    return re.sub(r"\s+", " ", re.sub(r"[`\\]", "", text))


def test_there_are_facts_to_hold() -> None:
    assert len(facts_of("AUTOPILOTS.md")) > 45
    assert len(facts_of("PX4.md")) > 55


@pytest.mark.parametrize(("sheet", "words", "tests"), ALL_FACTS, ids=lambda v: v[:40] if isinstance(v, str) else "")
def test_each_fact_has_a_test_that_names_its_sheet(sheet: str, words: str, tests: list[tuple[str, str]]) -> None:
    """Issue 4: every line of AUTOPILOTS.md and PX4.md that is about our side has a test that names it."""
    assert tests, words
    for path, name in tests:
        assert name in functions_of(path), f"{path} has no {name}"
        test = functions_of(path)[name]
        assert sheet in (ast.get_docstring(test) or ""), f"{path}::{name} does not name {sheet}"
        assert claims_something(test), f"{path}::{name} claims nothing"


@pytest.mark.parametrize("sheet", SHEETS)
def test_the_sheets_say_so(sheet: str) -> None:
    text = plain((shared_data().parent / sheet).read_text(encoding="utf-8"))
    assert [words for words, _ in facts_of(sheet) if plain(words) not in text] == []


def faults() -> dict[int, list[tuple[str, str]]]:
    table = SAFETY.split("\n## The faults\n")[1].split("\n## ")[0]
    files = letters(SAFETY)
    out: dict[int, list[tuple[str, str]]] = {}
    for cells in rows(table)[1:]:
        out.setdefault(int(cells[0]), []).extend(named_in(cells[-1], files))
    return out


def test_every_fault_of_the_list_is_there() -> None:
    assert list(faults()) == list(range(1, 33))


@pytest.mark.parametrize("number", range(1, 33))
def test_each_fault_has_a_test(number: int) -> None:
    tests = faults()[number]
    assert tests, number
    for path, name in tests:
        assert name in functions_of(path), f"{path} has no {name}"
        assert claims_something(functions_of(path)[name]), f"{path}::{name} claims nothing"


def test_each_fault_that_the_page_makes_happen_is_one_that_simbridge_knows() -> None:
    table = SAFETY.split("\n## Made to happen\n")[1]
    snippets = [s for cells in rows(table)[1:] for s in re.findall(r"`(\{target: [^`]*\})`", cells[1])]
    made = [FaultConfig.model_validate(yaml.safe_load(snippet)) for snippet in snippets]
    assert {fault.kind for fault in made} == {*get_args(FaultConfig.model_fields["kind"].annotation)}
    targets = {*get_args(FaultConfig.model_fields["target"].annotation)}
    assert targets - {fault.target for fault in made} <= {"baro"}
    numbers = [int(cells[0]) for cells in rows(table)[1:]]
    assert numbers == sorted(set(numbers))
    assert set(numbers) < set(faults())
