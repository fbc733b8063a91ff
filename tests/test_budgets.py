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
    "hma_data": (761, 4_308, 8),
    "hma_data/cli": (1_549, 11_018, 8),
    "hma_data/conversion": (4_101, 30_387, 15),
    "hma_data/episodes": (1_805, 15_509, 9),
    "hma_data/hub": (516, 3_847, 3),
    "hma_data/inspection": (2_104, 19_886, 8),
    "hma_data/lab": (3_293, 29_136, 16),
    "hma_data/loading": (1_278, 10_705, 6),
    "hma_data/registry": (1_262, 8_216, 6),
    "hma_data/shards": (2_482, 18_820, 11),
    "hma_data/sources": (12_251, 100_210, 51),
    "hma_data/storage": (1_697, 11_105, 11),
    "hma_data/tokenizers": (3_401, 24_708, 18),
    "hma_model": (570, 3_424, 4),
    "hma_model/benchmark": (836, 7_066, 5),
    "hma_model/checkpoint": (949, 7_299, 5),
    "hma_model/cli": (1_742, 11_211, 12),
    "hma_model/demo": (476, 4_000, 4),
    "hma_model/evaluation": (4_528, 35_813, 24),
    "hma_model/export": (1_168, 9_350, 9),
    "hma_model/generation": (1_590, 12_424, 9),
    "hma_model/hub": (1_044, 7_935, 6),
    "hma_model/lerobot_env": (610, 4_647, 3),
    "hma_model/network": (3_511, 30_661, 19),
    "hma_model/play": (1_603, 11_813, 8),
    "hma_model/policies": (2_843, 20_324, 14),
    "hma_model/released": (799, 6_783, 4),
    "hma_model/synthetic": (1_205, 9_254, 5),
    "hma_model/training": (3_683, 30_250, 20),
    "hma_model/worlds": (1_473, 10_918, 6),
}
PRODUCT_LINES, PRODUCT_NODES = 65_130, 511_027
TEST_LINES = 46_627
DOC_WORDS = 41_969


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
