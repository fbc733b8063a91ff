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
    "hma_data": (880, 5_400, 8),
    "hma_data/cli": (1_480, 10_500, 8),
    "hma_data/conversion": (3_310, 24_100, 12),
    "hma_data/episodes": (1_530, 13_400, 8),
    "hma_data/hub": (520, 3_800, 3),
    "hma_data/inspection": (2_170, 20_300, 9),
    "hma_data/lab": (3_350, 31_600, 16),
    "hma_data/loading": (1_330, 11_200, 6),
    "hma_data/registry": (1_280, 8_200, 6),
    "hma_data/shards": (2_690, 21_000, 11),
    "hma_data/sources": (12_880, 108_900, 53),
    "hma_data/storage": (1_680, 11_000, 11),
    "hma_data/tokenizers": (3_280, 23_900, 17),
    "hma_model": (490, 2_900, 3),
    "hma_model/checkpoint": (860, 6_400, 5),
    "hma_model/cli": (1_500, 9_400, 11),
    "hma_model/demo": (480, 3_900, 4),
    "hma_model/evaluation": (4_050, 32_200, 23),
    "hma_model/generation": (1_700, 13_900, 10),
    "hma_model/hub": (1_050, 8_100, 6),
    "hma_model/lerobot_env": (400, 3_200, 2),
    "hma_model/network": (2_920, 24_500, 15),
    "hma_model/play": (1_640, 11_500, 9),
    "hma_model/policies": (2_040, 14_500, 12),
    "hma_model/released": (860, 7_500, 4),
    "hma_model/synthetic": (1_210, 8_900, 5),
    "hma_model/training": (3_400, 27_900, 17),
    "hma_model/worlds": (1_540, 11_500, 6),
}
PRODUCT_LINES, PRODUCT_NODES = 59_600, 471_500
TEST_LINES = 45_450
DOC_WORDS = 38_000


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


@pytest.mark.parametrize("package", sizes())
def test_a_package_keeps_to_its_budget(package: str) -> None:
    assert package in BUDGETS, f"{package} is new: give it a budget"
    for what, own, most in zip(("lines", "syntax nodes", "modules"), sizes()[package], BUDGETS[package]):
        assert own <= most, f"{package} has {own:,} {what}, its budget is {most:,}"


def test_product_tests_and_docs_keep_to_their_budgets() -> None:
    lines, nodes, _ = (sum(column) for column in zip(*sizes().values(), strict=True))
    tests = sum(len(path.read_text().splitlines()) for path in (ROOT / "tests").rglob("*.py"))
    words = sum(len(path.read_text().split()) for path in (ROOT / "docs").rglob("*.md"))
    assert lines <= PRODUCT_LINES and nodes <= PRODUCT_NODES
    assert tests <= TEST_LINES
    assert words <= DOC_WORDS
