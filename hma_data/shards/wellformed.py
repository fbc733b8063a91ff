"""Check that the values of a manifest or footer have the form of docs/format.md, whoever wrote them.

Each check raises ValueError with what is wrong; the caller turns it into one clear error.
"""

import math
from collections.abc import Callable
from dataclasses import fields
from typing import Any

from hma_data.registry.embodiment import Embodiment
from hma_data.tokenizers.base import TokenizerSpec

DTYPES = {"discrete": ("uint16", "uint32"), "continuous": ("float16", "uint8")}
FRAMES = ("all", "strided")
LARGEST = 2**20  # upper limit of the cells, pixels and channels of a tokenizer


def is_count(value: Any, least: int = 0) -> bool:
    """Check whether a value is a whole number of at least `least` that int64 holds."""
    return type(value) is int and least <= value < 2**63


def is_number(value: Any) -> bool:
    """Check whether a value is a finite number; a whole number must fit int64."""
    return (type(value) is float and math.isfinite(value)) or (type(value) is int and abs(value) < 2**63)


_KINDS: dict[Any, Callable[[Any], bool]] = {
    int: is_count,
    float: is_number,
    str: lambda value: type(value) is str,
    bool | None: lambda value: value is None or type(value) is bool,
}


def check_fields(item: Any) -> None:
    """Check that a dataclass's values have the types it declares; whole numbers are not negative."""
    for field in fields(item):
        value = getattr(item, field.name)
        if not _KINDS[field.type](value):
            raise ValueError(f"{field.name} is {str(value)[:40]!r}")


def check_numbers(stats: dict[str, Any]) -> None:
    """Check the statistics of one vector in a footer."""
    width = len(stats["mean"])
    for name in ("mean", "m2", "min", "max"):
        if len(stats[name]) != width or not all(map(is_number, stats[name])):
            raise ValueError(f"{name} is not {width} numbers")
    sketch = stats["sketch"]
    levels = [*sketch["rows"], *sketch["odd"]]
    if not is_count(stats["count"]) or not all(map(is_count, levels)) or len(sketch["rows"]) > 64:
        raise ValueError("counts are not whole numbers")
    if len(sketch["odd"]) != len(sketch["rows"]) or sketch["width"] not in (width, 0):
        raise ValueError("a sketch does not fit its vector")
    weight = sum(rows << level for level, rows in enumerate(sketch["rows"]))
    if weight != stats["count"] or (weight and sketch["width"] != width):
        raise ValueError(f"a sketch of {weight} rows stands beside a count of {stats['count']}")


def check_spec(spec: TokenizerSpec) -> None:
    """Check a tokenizer's spec."""
    sizes = [*spec.grid, spec.image_size, *(() if spec.channels is None else (spec.channels,))]
    if len(spec.grid) != 2 or not all(is_count(size, 1) and size <= LARGEST for size in sizes):
        raise ValueError(f"the tokenizer's sizes are {sizes}")
    if spec.kind not in DTYPES or spec.dtype not in DTYPES[spec.kind]:
        raise ValueError(f"the tokenizer is of kind {spec.kind!r} and dtype {spec.dtype!r}")
    if spec.kind == "discrete" and not is_count(spec.vocab_size, 1):
        raise ValueError(f"the tokenizer's vocab_size is {spec.vocab_size!r}")
    if type(spec.name) is not str or type(spec.weights_sha256) is not str:
        raise ValueError("the tokenizer's name and weights_sha256 must be text")


def check_plan(plan: dict[str, Any]) -> None:
    """Check the facts of a plan that a reader uses."""
    if type(plan["hash"]) is not str or not is_count(plan["frame_stride"], 1):
        raise ValueError("its plan has no hash, or a frame_stride that is no whole number above 0")
    cameras = plan["cameras"]
    if not isinstance(cameras, list) or not cameras or not all(type(name) is str for name in cameras):
        raise ValueError("its plan names no cameras")
    if plan.get("frames", "all") not in FRAMES:
        raise ValueError(f"its plan's frames are {plan['frames']!r}")
    settings, extends = plan.get("settings", {}), plan.get("extends", [])
    if not isinstance(settings, dict) or not isinstance(extends, list):
        raise ValueError("its plan's settings are not a mapping, or extends not a list")
    if not all(type(item) is str for item in extends):
        raise ValueError("its plan's extends are not hashes")


def check_splits(splits: dict[str, Any]) -> None:
    """Check the counts of both splits."""
    for split in ("train", "val"):
        counts = [splits[split][name] for name in ("episodes", "frames", "rows", "shards")]
        if not all(is_count(count) for count in counts):
            raise ValueError(f"the counts of split {split} are not whole numbers")


def check_stats(stats: dict[str, Any], robot: Embodiment) -> None:
    """Check that the summaries have a number for each value of the embodiment's vectors."""
    widths = {"action": robot.action_dim} | ({"state": robot.state.dims} if robot.state else {})
    for name, width in widths.items():
        said = stats[name]
        if not is_count(said["count"]):
            raise ValueError(f"the statistics of {name} count {said['count']!r}")
        numbers = [said[key] for key in ("mean", "std", "min", "max")] + list(said["quantiles"].values())
        for values in numbers:
            if not isinstance(values, list) or len(values) != width:
                raise ValueError(f"the statistics of {name} are not {width} numbers each")
            if not all(type(value) is float or is_count(abs(value)) for value in values):
                raise ValueError(f"the statistics of {name} are not numbers")
