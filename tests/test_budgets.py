"""Budgets of size: lines, syntax nodes and modules of each package, lines of tests, words of docs.

A capability pays for its code by what it replaces. Where it cannot, the number in the table is raised in the
same commit, whose message says why. Nodes are counted beside lines, so that packing lines saves nothing.
"""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
BUDGETS = {  # package: lines, syntax nodes, modules; a package's own modules stand under its name alone
    "hma_data": (766, 4_346, 8),
    "hma_data/cli": (1_549, 11_018, 8),
    "hma_data/conversion": (4_103, 30_408, 15),
    "hma_data/episodes": (1_811, 15_803, 9),
    "hma_data/hub": (517, 3_857, 3),
    "hma_data/inspection": (2_106, 19_984, 8),
    "hma_data/lab": (3_300, 29_290, 16),
    "hma_data/loading": (1_280, 10_769, 6),
    "hma_data/registry": (1_268, 8_248, 6),
    "hma_data/shards": (2_494, 19_183, 11),
    "hma_data/sources": (12_476, 102_450, 51),
    "hma_data/storage": (1_697, 11_105, 11),
    "hma_data/tokenizers": (3_459, 25_242, 18),
    "hma_model": (570, 3_424, 4),
    "hma_model/benchmark": (857, 7_235, 5),
    "hma_model/checkpoint": (949, 7_299, 5),
    "hma_model/cli": (1_762, 11_439, 12),
    "hma_model/demo": (476, 4_001, 4),
    "hma_model/evaluation": (4_541, 36_027, 24),
    "hma_model/export": (1_162, 9_242, 9),
    "hma_model/generation": (1_632, 13_122, 9),
    "hma_model/hub": (1_058, 8_091, 6),
    "hma_model/lerobot_env": (628, 4_854, 3),
    "hma_model/network": (3_474, 30_262, 19),
    "hma_model/play": (1_607, 11_842, 8),
    "hma_model/policies": (2_855, 20_420, 14),
    "hma_model/released": (807, 6_817, 4),
    "hma_model/synthetic": (1_207, 9_282, 5),
    "hma_model/training": (3_684, 30_303, 20),
    "hma_model/worlds": (1_495, 11_213, 6),
}
PRODUCT_LINES, PRODUCT_NODES = 65_590, 516_576
TEST_LINES = 48_586
DOC_WORDS = 41_996


@cache
def sizes() -> dict[str, tuple[int, int, int]]:
    """Return package -> lines, syntax nodes and modules."""
    found = dict.fromkeys(BUDGETS, (0, 0, 0))
    for path in modules():
        parts = path.relative_to(ROOT).parts
        package = "/".join(parts[:2]) if len(parts) > 2 else parts[0]
        text = path.read_text(encoding="utf-8")
        own = len(text.splitlines()), sum(1 for _ in ast.walk(ast.parse(text))), 1
        before = found.get(package, (0, 0, 0))
        found[package] = tuple(a + b for a, b in zip(before, own, strict=True))
    return found


def modules() -> Iterator[Path]:
    for package in ("hma_data", "hma_model"):
        yield from (ROOT / package).rglob("*.py")


def test_every_package_has_a_budget() -> None:
    assert sizes().keys() == BUDGETS.keys()


@pytest.mark.parametrize("package", BUDGETS)
def test_a_package_keeps_to_its_budget(package: str) -> None:
    for what, own, most in zip(("lines", "syntax nodes", "modules"), sizes()[package], BUDGETS[package]):
        assert own <= most, f"{package} has {own:,} {what}, its budget is {most:,}"


def test_product_tests_and_docs_keep_to_their_budgets() -> None:
    lines, nodes, _ = (sum(column) for column in zip(*sizes().values(), strict=True))
    tests = sum(len(path.read_text().splitlines()) for path in (ROOT / "tests").rglob("*.py"))
    words = sum(len(path.read_text().split()) for path in (ROOT / "docs").rglob("*.md"))
    assert lines <= PRODUCT_LINES and nodes <= PRODUCT_NODES
    assert tests <= TEST_LINES
    assert words <= DOC_WORDS
