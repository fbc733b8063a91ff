"""Write README.md of a published shard set: the facts for the hub's viewer and filters, and the usage."""

from typing import Any

from hma_data.shards.manifest import EPISODES, Manifest
from hma_data.storage.yaml_io import write_yaml
from hma_model.checkpoint.card_text import licence, line, number

_SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"),
          (10**7, "1M<n<10M"), (10**8, "10M<n<100M"), (10**9, "100M<n<1B"), (10**10, "1B<n<10B"))  # fmt: skip
_SPLITS = {"train": "train", "val": "validation"}  # our names, and the hub's names


def render(manifest: Manifest, repo: str | None) -> bytes:
    """Return the card as bytes.

    Args:
        manifest: the manifest of the set.
        repo: organisation/name; None if the set lies in a folder.
    """
    name, robot = repo or "PATH", manifest.embodiment
    parts = [
        f"---\n{write_yaml(_front(manifest))}---",
        f"# {line(robot.id)}",
        line(robot.description) or "Recordings of one robot, tokenized.",
        _facts(manifest),
        "## Splits\n\n" + _table(manifest),
        "## How to use\n\n" + _usage(name),
        "Made with hma-toolkit: one row is one frame; `manifest.json` lists every file with its SHA-256.",
    ]
    return ("\n\n".join(parts) + "\n").encode()


def _front(manifest: Manifest) -> dict[str, Any]:
    rows = sum(shard.rows for shard in manifest.shards)
    present = [split for split in _SPLITS if any(shard.split == split for shard in manifest.shards)]
    frames = [{"split": _SPLITS[split], "path": f"{split}/*.parquet"} for split in present]
    configs: list[dict[str, Any]] = [{"config_name": "frames", "data_files": frames, "default": True}]
    episodes = [
        {"split": "train", "path": EPISODES}
    ]  # of both splits; the datasets library reserves the name "all"
    configs.append({"config_name": "episodes", "data_files": episodes})
    return {
        **licence([manifest.embodiment.license]),
        "task_categories": ["robotics"],
        "size_categories": [next((name for most, name in _SIZES if rows < most), "n>1T")],
        "tags": [
            "robotics",
            "hma",
            "world-model",
            f"embodiment:{manifest.embodiment.id}",
            f"tokenizer:{manifest.tokenizer.name}",
        ],
        "configs": configs if frames else configs[1:],
    }


def _facts(manifest: Manifest) -> str:
    robot, tokenizer = manifest.embodiment, manifest.tokenizer
    unknown = robot.frequency_hz == "unknown"
    facts = {
        "robot": line(robot.robot),
        "actions": f"{robot.action_dim} dims, {line(robot.action.space)}",
        "frames per second of the model": "unknown" if unknown else number(robot.effective_hz),
        "tokenizer": f"{line(tokenizer.name)}, {'×'.join(map(str, tokenizer.grid))} of "
        f"{tokenizer.image_size} pixels, {line(tokenizer.kind)}",
        "licence": line(robot.license) or "not stated",
        "quarantined episodes": str(manifest.quarantined),
    }
    return "\n".join(f"- {key}: {value}" for key, value in facts.items() if value)


def _table(manifest: Manifest) -> str:
    rows = ["| split | episodes | frames | shards | MB |", "|---|---|---|---|---|"]
    for split, counts in manifest.splits.items():
        size = sum(shard.bytes for shard in manifest.shards if shard.split == split) / 1e6
        counted = " | ".join(f"{counts[key]:,}" for key in ("episodes", "frames", "shards"))
        rows.append(f"| {line(split)} | {counted} | {size:,.1f} |")
    return "\n".join(rows)


def _usage(name: str) -> str:
    return (
        f"```sh\nhma hub pull-data {name} --out shards\nhma shards preview shards --out seen\n```\n\n"
        f'```python\nfrom datasets import load_dataset\n\nframes = load_dataset("{name}", "frames")\n```'
    )
