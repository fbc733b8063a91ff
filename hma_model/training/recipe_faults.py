"""Describe the faults of a recipe's values: the key, the allowed values, the value, and a likely correction.

The network's fields are checked here too, before any shard is opened. The fields that depend on the shards
(grid, vocabulary, latents) have values for this check that allow everything.
"""

import math
from collections.abc import Mapping
from dataclasses import fields
from difflib import get_close_matches
from typing import Any, get_type_hints

from hma_data.errors import RecipeError
from hma_model.config import HMAConfig

DERIVED = {"kind", "grid", "factored", "channels", "latent_scale", "frames", "objectives", "tokenizer"}
# far above any existing network: a typing error must not allocate all of a machine's memory
MOST = {"layers": 2048, "width": 131_072, "heads": 4096, "mlp_ratio": 256, "action_tokens": 4096}
MOST_OTHER = 1_000_000
_PLAIN = {
    "int_type": "must be a whole number (an integer)",
    "int_parsing": "must be a whole number (an integer)",
    "int_from_float": "must be a whole number (an integer)",
    "int_parsing_size": "must be a whole number (an integer) of fewer digits",
    "float_type": "must be a number",
    "float_parsing": "must be a number",
    "bool_type": "must be true or false (a boolean)",
    "bool_parsing": "must be true or false (a boolean)",
    "string_type": "must be a text (a string)",
    "tuple_type": "must be a list",
    "dict_type": "must be a mapping of keys to values (a dictionary)",
    "model_type": "must be a mapping of keys to values (a dictionary)",
    "invalid_key": "keys must be words",
    "string_pattern_mismatch": "must be auto, cpu, mps, cuda or cuda:N",  # only `device` has a pattern
}


def network_values(values: Any, objectives: Any, found: list[str]) -> dict[str, Any]:
    """Return a recipe's `model` with its values converted to numbers, and add its faults to `found`.

    Args:
        values: the value of the key `model`.
        objectives: the value of the key `objectives`.
        found: the faults so far.
    """
    if not isinstance(values, dict):
        return {}
    own, types = [f.name for f in fields(HMAConfig) if f.name not in DERIVED], get_type_hints(HMAConfig)
    plain, before = {}, len(found)
    for key, value in values.items():
        if key in DERIVED:
            found.append(f"model.{key}: follows from the shards and the recipe, and cannot be given")
        elif key not in own:
            found.append(unknown(f"model.{key}", own))
        else:
            plain[key] = _typed(key, value, types[key], found)
    if len(found) == before:
        found += _refusals(plain, objectives)
    return plain


def problem(item: Any, known: Mapping[str, list[str]]) -> str:
    """Describe one of pydantic's errors; `known` has the keys of each mapping by its path."""
    path = ".".join(str(part) for part in item["loc"] if part != "[key]")
    if item["type"] == "extra_forbidden":
        return unknown(path, known[path.rpartition(".")[0]], known)
    if item["type"] == "too_long":
        text = f"must be a list of {item['ctx']['max_length']}"
    elif item["type"] == "missing":
        return f"{path}: must be a list of more values"
    else:
        text = _PLAIN.get(item["type"], item["msg"].removeprefix("Value error, "))
    near = ""
    if item["type"] == "literal_error":
        allowed = item["ctx"]["expected"].replace(" or ", ", ").replace("'", "").split(", ")
        near = _meant(str(item["input"]), allowed)
    return f"{path}: {text.replace('Input should be', 'must be')}{near} (is {_short(item['input'])})"


def unknown(path: str, known: list[str], others: Mapping[str, list[str]] | None = None) -> str:
    """Describe an unknown key, and suggest one of `known`, or a key of another mapping."""
    home, _, key = path.rpartition(".")
    if not home and key == "extends":
        return "extends: cannot be an override: write it in the recipe's file"
    near = _meant(key, known)
    for name, keys in (others or {}).items():
        if not near and name and not home and key in keys:
            near = f", did you mean {f'{name}.{key}'!r}?"
    return f"{_short(path, quote=False)}: unknown key{near}"


def _meant(word: str, known: list[str]) -> str:
    near = get_close_matches(word.lower(), known, n=1)
    return f", did you mean {near[0]!r}?" if near else ""


def _short(value: Any, quote: bool = True) -> str:
    text = repr(value) if quote else str(value)
    return text if len(text) <= 80 else f"{text[:77]}…"


def _typed(key: str, value: Any, kind: Any, found: list[str]) -> Any:
    """Convert a value to the type of its field; YAML reads 1e-3 as a text."""
    path, is_number = f"model.{key}", isinstance(value, int | float) and not isinstance(value, bool)
    if kind is bool:
        if not isinstance(value, bool):
            found.append(f"{path}: must be true or false (is {_short(value)})")
    elif kind is str:
        if not isinstance(value, str):
            found.append(f"{path}: must be a word (is {_short(value)})")
    elif kind in (int, float):
        if isinstance(value, str):
            value, is_number = _number(value)
        if not is_number or not math.isfinite(value) or (kind is int and value != int(value)):
            found.append(f"{path}: must be a {'whole ' * (kind is int)}number (is {_short(value)})")
        elif abs(value) > (most := MOST.get(key, MOST_OTHER)):
            found.append(f"{path}: must be at most {most:,} (is {_short(value)})")
        else:
            value = kind(value)
    elif not (isinstance(value, str) or (isinstance(value, list) and all(isinstance(v, str) for v in value))):
        found.append(f"{path}: must be a word or a list of words (is {_short(value)})")
    return value


def _number(text: str) -> tuple[Any, bool]:
    try:
        return float(text), True
    except ValueError:
        return text, False


def _refusals(plain: dict[str, Any], objectives: Any) -> list[str]:
    given = {"objectives": objectives} if _are_weights(objectives) else {}
    try:
        HMAConfig(**{"patch": 1, **plain, **given, "grid": (plain.get("patch", 1) or 1,) * 2})
    except RecipeError as fault:
        where = fault.where if not fault.where.endswith(".objectives") else "objectives"
        return [f"{where}: {fault.fault}: {fault.remedy}"]
    return []


def _are_weights(objectives: Any) -> bool:
    return isinstance(objectives, dict) and all(
        isinstance(key, str) and isinstance(value, int | float) for key, value in objectives.items()
    )
