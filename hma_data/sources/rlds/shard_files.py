"""Find the shards of a TFDS dataset's splits, and how many records each should have.

`dataset_info.json` names the shards by a template and gives the number of records of each. Without that file,
or in a renamed dataset, shards are found by their file names.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from hma_data.errors import SourceError

TEMPLATE = "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}"
FORMATS = ("tfrecord", "array_record")
NUMBER = r"-(?P<shard>\d{5,})(?:-of-(?P<shards>\d{5,}))?"
NAMED = (  # forms of file names: the suffix after the number, or before it as TFDS writes it
    re.compile(rf"(?P<stem>.+?)[-_]{NUMBER[1:]}\.(?:tfrecord|array_record)"),
    re.compile(rf"(?P<stem>.+)\.(?:tfrecord|array_record)(?:{NUMBER})?"),
)


@dataclass(frozen=True)
class Shard:
    """One TFRecord or ArrayRecord file of a split.

    Attributes:
        path: on the folder's file system.
        number: its place in the split.
        records: how many dataset_info.json states; None where it states none.
        first: index within the split of its first record.
    """

    path: str
    number: int
    records: int | None
    first: int = 0


def stated_shards(
    root: str, info: dict[str, Any], listing: list[str] | None
) -> tuple[dict[str, list[Shard]], list[str]]:
    """Return the existing shards that dataset_info.json names, with `first` set, and what is missing."""
    there = None if listing is None else set(listing)
    shards: dict[str, list[Shard]] = {}
    problems, absent = [], []
    for split in info.get("splits", []):
        name, counts = str(split.get("name", "")), _counts(split)
        template = split.get("filepathTemplate") or split.get("filepath_template") or TEMPLATE
        items, first = [], 0
        for number, records in enumerate(counts):
            path = f"{root}/{_shard_name(template, info, name, number, len(counts))}"
            items.append(Shard(path, number, records, first))
            first += records
        present = [item for item in items if there is None or item.path in there]
        if present and len(present) < len(items):
            problems.append(_missing(name, len(items) - len(present), len(items)))
        if present:
            shards[name] = present
        elif first:
            absent.append(f"split {name} of {first:,} episodes is not there")
    return shards, problems + absent if shards else problems


def _counts(split: dict[str, Any]) -> list[int]:
    try:
        counts = [int(count) for count in split.get("shardLengths") or split.get("shard_lengths") or ()]
        if counts and min(counts) < 0:
            raise ValueError(f"{min(counts)} records")
        return counts
    except (TypeError, ValueError, OverflowError, AttributeError) as fault:
        raise SourceError(
            "dataset_info.json",
            f"shardLengths of split {split.get('name')!r} are not numbers",
            "remove the file",
        ) from fault


def _shard_name(template: str, info: dict[str, Any], split: str, number: int, shards: int) -> str:
    digits = max(5, len(str(shards)))
    place, total = f"{number:0{digits}d}", f"{shards:0{digits}d}"
    values = {
        "DATASET": str(info.get("name", "")),
        "SPLIT": split,
        "FILEFORMAT": str(info.get("fileFormat") or info.get("file_format") or FORMATS[0]),
        "SHARD_INDEX": place,
        "NUM_SHARDS": total,
        "SHARD_X_OF_Y": f"{place}-of-{total}",
    }
    return re.sub(r"\{(\w+)\}", lambda match: values.get(match[1], match[0]), template.split("%")[0])


def _missing(split: str, missing: int, shards: int) -> str:
    return f"{missing} of {shards} shards of split {split} are not there"


def named_shards(
    root: str, listing: Iterable[str], info: dict[str, Any]
) -> tuple[dict[str, list[Shard]], list[str]]:
    """Return the shards found by their names alone, and what is missing.

    This serves a renamed dataset, or one without dataset_info.json.
    """
    stated = {str(split.get("name")): _counts(split) for split in info.get("splits", [])}
    shards: dict[str, list[Shard]] = {}
    totals: dict[str, int] = {}
    for path in listing:
        inside = path[len(root) + 1 :]
        match = next((found for form in NAMED if (found := form.fullmatch(inside.rsplit("/", 1)[-1]))), None)
        if not match:
            continue
        split = inside.rsplit("/", 1)[0] if "/" in inside else _split_of(match["stem"], info, stated)
        parts = match.groupdict()
        number = int(parts["shard"] or len(shards.get(split, ())))
        totals[split] = max(totals.get(split, 0), int(parts["shards"] or 0))
        counts = stated.get(split, [])
        records = counts[number] if number < len(counts) else None
        shards.setdefault(split, []).append(Shard(path, number, records, sum(counts[:number])))
    problems = [
        _missing(split, totals[split] - len(items), totals[split])
        for split, items in shards.items()
        if totals[split] > len(items)
    ]
    return {split: sorted(items, key=lambda item: item.number) for split, items in shards.items()}, problems


def _split_of(stem: str, info: dict[str, Any], stated: Iterable[str]) -> str:
    """Return the split in a file's name, e.g. train of toy-train; a split's name may have hyphens itself."""
    for split in sorted(stated, key=len, reverse=True):
        if stem == split or stem.endswith(f"-{split}"):
            return split
    name = str(info.get("name", ""))
    if name and stem.startswith(f"{name}-"):
        return stem[len(name) + 1 :]
    return stem.rsplit("-", 1)[-1]
