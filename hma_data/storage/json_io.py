"""Parse JSON of files that strangers may have written; refuse an object that gives a key twice."""

import json
from collections import Counter
from typing import Any


def parse_json(content: bytes | str) -> Any:
    """Return the plain values of a JSON text.

    A key may not be given twice: readers differ in which of the two values they take, so the same text would
    mean one thing here and another elsewhere.

    Raises:
        ValueError: it is not JSON, or an object gives a key twice.
        RecursionError: it is nested too deeply.
    """
    return json.loads(content, object_pairs_hook=_unambiguous)


def _unambiguous(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    values = dict(pairs)
    if len(values) != len(pairs):
        (twice, _), *_ = Counter(key for key, _ in pairs).most_common(1)
        raise ValueError(f"key {twice[:60]!r} is given twice")
    return values
