"""Write README.md of a checkpoint, from its config.json and card.json files alone.

The same facts give the same text, so it does not matter who pushes last. Cards may come from untrusted
authors, so every value becomes one plain line before it enters the page.
"""

import re
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from hma_data.storage.paths import REPOSITORY
from hma_data.storage.yaml_io import write_yaml
from hma_data.tables import Table
from hma_data.tokenizers.catalog import other_weights
from hma_model.config import token_words

_TAGS = ("robotics", "world-model", "video-prediction", "hma")
_DATASET = re.compile(rf"hf://datasets/({REPOSITORY.pattern})")
_HEADINGS = ["embodiment", "robot", "action dims", "Hz", "stride", "data", "metrics", "licence"]

# The identifiers that the hub accepts in a card's front matter; it refuses any other.
LICENCES = frozenset((
    "apache-2.0", "mit", "cc0-1.0", "cc-by-2.0", "cc-by-2.5", "cc-by-3.0", "cc-by-4.0", "cc-by-sa-3.0",
    "cc-by-sa-4.0", "cc-by-nc-2.0", "cc-by-nc-3.0", "cc-by-nc-4.0", "cc-by-nd-4.0", "cc-by-nc-nd-3.0",
    "cc-by-nc-nd-4.0", "cc-by-nc-sa-2.0", "cc-by-nc-sa-3.0", "cc-by-nc-sa-4.0", "cdla-permissive-1.0",
    "cdla-permissive-2.0", "cdla-sharing-1.0", "odc-by", "odbl", "pddl", "bsd", "bsd-2-clause",
    "bsd-3-clause", "isc", "gpl", "gpl-2.0", "gpl-3.0", "lgpl", "lgpl-2.1", "lgpl-3.0", "agpl-3.0",
    "mpl-2.0", "epl-2.0", "eupl-1.2", "unlicense", "wtfpl", "zlib", "bsl-1.0", "ecl-2.0", "artistic-2.0",
    "openrail", "creativeml-openrail-m",
))  # fmt: skip


def render(
    config: Mapping[str, Any],
    cards: Mapping[str, Mapping[str, Any]],
    *,
    repo: str | None = None,
    samples: Collection[str] = (),
) -> bytes:
    """Return the model card as bytes.

    Args:
        config: the values of config.json.
        cards: id -> the values of card.json.
        repo: the name of the checkpoint for a reader; None for the folder that the card lies in.
        samples: files that are there of `ID/sample.gif` (a film) and `ID/sample.png`; the film is shown.
    """
    pictures = [
        f"### {name}\n\n![A rollout of {name} beside the truth](embodiments/{found[0]})"
        for name in sorted(cards)
        if (found := [part for part in (f"{name}/sample.gif", f"{name}/sample.png") if part in samples])
    ]
    front: dict[str, Any] = {"library_name": "hma-toolkit", "pipeline_tag": "robotics"}
    front |= licence(card.get("license") for card in cards.values()) | _origins(cards)
    front["tags"] = [*_TAGS, *(f"embodiment:{name}" for name in sorted(cards))]
    parts = [
        f"---\n{write_yaml(front)}---",
        f"# {line((repo or 'HMA world model').rsplit('/', 1)[-1])}",
        _about(config),
        "## Embodiments\n\n" + _table(cards) + _words(config, cards),
        *pictures,
        "## How to use\n\n" + _usage(repo or ".", config, cards),
        f"Format version {line(config.get('format_version'))}. Each `card.json` names its trunk by SHA-256: "
        "parts that do not belong together are refused on loading.",
    ]
    return ("\n\n".join(parts) + "\n").encode()


def _about(config: Mapping[str, Any]) -> str:
    model, tokenizer = config["model"], config["tokenizer"]
    grid = "×".join(str(side) for side in model.get("grid", ()))
    views = f" of {line(model['views'])} cameras" if model.get("views", 1) != 1 else ""
    other = other_weights(tokenizer)
    weights = f", with weights of its own (SHA-256 `{line(other)}`), which are needed too" if other else ""
    return (
        "An action-conditioned video model of robots (Heterogeneous Masked Autoregression): one trunk, "
        "and a stem and head for each embodiment, which are published and pulled one at a time.\n\n"
        f"- network: {line(model.get('kind'))}, {line(model.get('layers'))} layers, "
        f"width {line(model.get('width'))}, {line(model.get('heads'))} heads, "
        f"window of {line(model.get('frames'))} frames{views}\n"
        f"- tokenizer: {line(tokenizer.get('name'))}, {grid} tokens of a "
        f"{line(tokenizer.get('image_size'))}-pixel picture{weights}\n"
        f"- trunk SHA-256: `{line(config.get('trunk_sha256'))}`"
    )


def _table(cards: Mapping[str, Mapping[str, Any]]) -> str:
    if not cards:
        return "None yet."
    rows = []
    for name in sorted(cards):
        card = cards[name]
        rows.append([
            f"`{name}`",
            line(card.get("robot") or card.get("description")),
            f"{line(card.get('action_dim'))} ({line(card.get('action_space'))})",
            number(card.get("effective_hz")),
            line(card.get("stride")),
            _pairs(card.get("data")),
            _pairs(card.get("metrics")),
            line(card.get("license")) or "not stated",
        ])  # fmt: skip
    return Table(_HEADINGS, rows).markdown()


def _words(config: Mapping[str, Any], cards: Mapping[str, Mapping[str, Any]]) -> str:
    """Return what the metrics mean, where an embodiment states a loss beside its baseline."""
    stated = _parts(cards, "metrics")
    if config["model"].get("kind") != "discrete" or not any("baseline_loss" in metrics for metrics in stated):
        return ""
    merge = config["model"].get("merge", 1)
    unit = token_words(merge if isinstance(merge, int) else 1)
    return (
        f"\n\nVal loss: nats a {unit}, in held-out episodes. Baseline loss: that of knowing only how often "
        "each token occurs, which a model must beat. Accuracy: the share predicted right."
    )


def _origins(cards: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the datasets of the hub and the checkpoints there that the embodiments name."""
    data = [parts.get(key) for parts in _parts(cards, "data") for key in ("source", "shards")]
    datasets = {found[1] for uri in data if (found := _DATASET.match(str(uri)))}
    bases = {str(parts.get("from")).split("@")[0] for parts in _parts(cards, "training")}
    bases = {name for name in bases if REPOSITORY.fullmatch(name)}
    front: dict[str, Any] = {"datasets": sorted(datasets)} if datasets else {}
    if bases:
        front |= {"base_model": sorted(bases), "base_model_relation": "finetune"}
    return front


def _parts(cards: Mapping[str, Mapping[str, Any]], key: str) -> list[Mapping[str, Any]]:
    return [part for card in cards.values() if isinstance(part := card.get(key), Mapping)]


_CODE = """
import numpy as np
import torch
from hma_data import get_tokenizer
from hma_model import HMA

tokenizer = get_tokenizer("{tokenizer}"{weights})
model = HMA.from_pretrained("{name}", embodiments=["{example}"]).eval()

pictures = np.zeros((2, {side}, {side}, 3), np.uint8)  # two frames of your camera, RGB
actions = torch.zeros(1, 2 + 6, {chunk})  # the commands from each frame up to the next, {chunk} values
stored = tokenizer.encode(pictures){views}
prompt = torch.from_numpy(stored.astype(np.{dtype}))[None]
frames = model.generate(prompt, actions, "{example}", frames=6)
film = tokenizer.decode(frames[0]{first}.numpy().astype(stored.dtype))  # (6, {side}, {side}, 3) uint8
"""


def _usage(name: str, config: Mapping[str, Any], cards: Mapping[str, Any]) -> str:
    example, model, tokenizer = min(cards, default="ID"), config["model"], config["tokenizer"]
    views, (height, *_) = model.get("views", 1), tokenizer.get("grid", (0, 0))
    discrete = model.get("kind") == "discrete"
    code = _CODE.strip().format(
        name=name, example=example, tokenizer=line(tokenizer.get("name")),
        weights=', weights="WEIGHTS"' if other_weights(tokenizer) else "",
        side=line(tokenizer.get("image_size")), chunk=line(cards.get(example, {}).get("chunk_dim")) or "K",
        dtype="int64" if discrete else "float32",
        views="" if views == 1 else f".repeat({line(views)}, axis=-2)  # one picture a camera, stacked",
        first="" if views == 1 else f"[..., :{line(height)}, :]",
    )  # fmt: skip
    where = "In this folder, with" if name == "." else "With"
    where += " HMA Toolkit (the Python package `hma-toolkit`) installed:\n\n"
    return (
        f"{where}```python\n{code}\n```\n\n"
        "```sh\n"
        f"hma hub pull {name} --embodiment {example} --out model\n"
        "hma generate model SHARDS --out rollout.mp4\n"
        "```\n\n"
        "`actions[:, k]` is the chunk of commands from frame k up to frame k + 1, in the units of the "
        "embodiment's `embodiment.yaml`; the model normalises by itself."
    )


def _pairs(values: Any) -> str:
    if not isinstance(values, Mapping) or not values:
        return "not stated"
    return ", ".join(
        f"{line(key).replace('_', ' ')} {number(value)}"
        for key, value in values.items()
        if value is not None and not isinstance(value, dict | list)
    )


# -- values as text


def licence(stated: Iterable[Any]) -> dict[str, str]:
    """Return the licence fields of the front matter; empty if the embodiments state no licence.

    One licence stands for all only if each of them states it.
    """
    told = {line(value) for value in stated}
    names = sorted(told - {"", "unknown"})
    if not names:
        return {}
    if len(told) == 1 and names[0].lower() in LICENCES:
        return {"license": names[0].lower()}
    shown = re.sub(r"[^a-z0-9.+-]+", "-", names[0].lower()).strip("-")[:60] if len(told) == 1 else "several"
    return {"license": "other", "license_name": shown or "stated-below"}


def line(value: Any) -> str:
    """Return a value as one line that cannot leave its cell, become markup or change the text direction."""
    text = "".join(c if c.isprintable() else " " for c in str("" if value is None else value))
    text = " ".join(text.split())[:200]
    if re.fullmatch(r"[\w.-]*", text, re.ASCII):
        return text
    text = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    text = re.sub(r"([|`\[\]\\*_~!#(){}$])", r"\\\1", text)
    return re.sub(r"(?i)(\w)(://|@)", r"\1&#8203;\2", text)  # prevents automatic links


def number(value: Any) -> str:
    """Return a float with four digits, or any other value as `line` does."""
    return f"{value:.4g}" if isinstance(value, float) else line(value)
