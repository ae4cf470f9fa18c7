"""Tests that documents name: read from their tables, and looked up in the code."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_LETTER = re.compile(r"\b([A-Z]):\s+`(tests/[\w/]+\.py)`")
_TOKEN = re.compile(r"(?:\b([A-Z]) )?`([^`]+)`")


def letters(text: str) -> dict[str, str]:
    """`X: path` of a document: the letters that stand for its test files."""
    return dict(_LETTER.findall(text))


def rows(text: str) -> list[list[str]]:
    """Cells of every table row but the heads; an escaped bar is no border."""
    out = []
    for line in text.splitlines():
        if line.startswith("|") and not re.match(r"\|\s*-", line):
            out.append([cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip())[1:-1]])
    return out


def named_in(cell: str, files: dict[str, str]) -> list[tuple[str, str]]:
    """(path, test) of each test in a cell: `path::test`, `::test` of the same path, or `test` of the letter's file."""
    out: list[tuple[str, str]] = []
    path = ""
    for letter, token in _TOKEN.findall(cell):
        path = files.get(letter, path) if letter else path
        if "::" in token:
            before, _, name = token.partition("::")
            path = before or path
            out.append((path, name))
        elif token.startswith("test_"):
            out.append((path, token))
    return out


@cache
def functions_of(path: str) -> dict[str, ast.FunctionDef | ast.AsyncFunctionDef]:
    """Test functions of a file, by name."""
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    functions = (ast.FunctionDef, ast.AsyncFunctionDef)
    return {node.name: node for node in tree.body if isinstance(node, functions) and node.name.startswith("test_")}


def claims_something(test: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    """It has an assertion, or awaits an exception, by itself or in what it calls by a name of its own file."""
    for node in ast.walk(test):
        if isinstance(node, ast.Assert):
            return True
        if isinstance(node, ast.Attribute) and node.attr in ("raises", "allclose", "assert_allclose"):
            return True
    return False
