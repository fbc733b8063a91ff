"""The packages in the order of the road: a module imports only from its own package and from those before it.

No modules import each other in a circle, inside a package either.
"""

import ast
import importlib
import importlib.util
import re
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = (
    "hma_data.errors", "hma_data.plugins", "hma_data.console", "hma_data.tables", "hma_data.cpu",
    "hma_data.arrays", "hma_data.storage",
    "hma_data.hub", "hma_data.registry", "hma_data.episodes", "hma_data.sources", "hma_data.tokenizers",
    "hma_data.shards", "hma_data.tokenizers.training", "hma_data.inspection", "hma_data.conversion",
    "hma_data.loading", "hma_data.loader", "hma_data.lab", "hma_data.cli", "hma_data",
    "hma_model.arrays", "hma_model.config", "hma_model.checkpoint.folder", "hma_model.network",
    "hma_model.checkpoint", "hma_model.generation",
    "hma_model.evaluation", "hma_model.released", "hma_model.hub", "hma_model.worlds",
    "hma_model.simulate", "hma_model.play", "hma_model.export", "hma_model.policies", "hma_model.benchmark",
    "hma_model.lerobot_env",
    "hma_model.synthetic", "hma_model.training", "hma_model.demo", "hma_model.cli", "hma_model",
)  # fmt: skip
DOORS = {  # HMA.generate; HMA.from_pretrained and push_to_hub: imported when they are called
    ("hma_model.network.model", "hma_model.generation.commands"),
    ("hma_model.network.model", "hma_model.generation.rollout"),
    ("hma_model.network.model", "hma_model.hub.publish"),
}
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for package in ("hma_data", "hma_model")
    for path in (ROOT / package).rglob("*.py")
}


@cache
def tree(module: str) -> ast.Module:
    return ast.parse(MODULES[module].read_text())


@cache
def imports(module: str) -> list[str]:
    """Return the modules of ours that one imports, anywhere in it, TYPE_CHECKING included."""
    found = []
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: imports are absolute"
            base = node.module or ""
            found += [f"{base}.{a.name}" if f"{base}.{a.name}" in MODULES else base for a in node.names]
    return [name for name in found if name in MODULES]


def room(module: str) -> str:
    """Return the room of a module: the longest name that it begins with."""
    parts = module.split(".")
    for size in range(len(parts), 1, -1):
        if ".".join(parts[:size]) in ROOMS:
            return ".".join(parts[:size])
    return module


def test_every_module_is_in_a_room() -> None:
    assert not [module for module in MODULES if room(module) not in ROOMS]


def test_modules_import_only_from_rooms_before_their_own() -> None:
    order = {module: ROOMS.index(room(module)) for module in MODULES}
    edges = [(module, name) for module in MODULES for name in imports(module)]
    wrong = [(module, name) for module, name in edges if order[name] > order[module]]
    wrong = sorted(set(wrong) - DOORS)
    assert not wrong


def test_no_modules_import_each_other_in_a_circle() -> None:
    graph = {
        module: [name for name in imports(module) if name != module and (module, name) not in DOORS]
        for module in MODULES
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as fault:
        pytest.fail(" <- ".join(fault.args[1]))


def test_the_architecture_page_lists_the_rooms_in_their_order() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text()
    rooms = [name for name in ROOMS if MODULES[name].name == "__init__.py" and "." in name]
    assert re.findall(r"^\| `(hma_[\w.]+)` \|", page, re.MULTILINE) == rooms


def test_a_room_says_what_it_is_for() -> None:
    silent = [name for name in MODULES if not ast.get_docstring(tree(name))]
    assert not silent


def test_every_name_that_a_recipe_imports_exists() -> None:
    """Most recipes run only by hand, so a name that moved would be found late."""
    missing = []
    for path in sorted((ROOT / "recipes").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(("hma_data", "hma_model")):
                module = importlib.import_module(str(node.module))
                for name in (alias.name for alias in node.names):
                    if (
                        not hasattr(module, name)
                        and importlib.util.find_spec(f"{node.module}.{name}") is None
                    ):
                        missing.append(f"{path.name}:{node.lineno} {node.module}.{name}")
    assert not missing
