"""Write README.md of a checkpoint, from its config.json and card.json files alone.

The same facts give the same text, so it does not matter who pushes last. Cards may come from untrusted
authors, so every value becomes one plain line before it enters the page.
"""

import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping
from typing import Any

from hma_data.storage.paths import REPOSITORY
from hma_data.storage.yaml_io import write_yaml
from hma_data.tables import fill
from hma_data.tokenizers.catalog import other_weights
from hma_model.config import token_words

_TAGS = ("robotics", "world-model", "video-prediction", "hma")
# Parts of a card that judge the weights: by `hma evaluate`, `hma bench holds` and `hma benchmark`.
JUDGED = ("evaluation", "holds", "meter")
_DATASET = re.compile(rf"hf://datasets/({REPOSITORY.pattern})")

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
    page: bool = False,
) -> bytes:
    """Return the model card as bytes.

    Args:
        config: the values of config.json.
        cards: id -> the values of card.json.
        repo: the name of the checkpoint for a reader; None for the folder that the card lies in.
        samples: files that are there of `ID/sample.gif` (a film) and `ID/sample.png`; the film is shown.
        page: a page that drives the robots is there too.
    """
    model, tokenizer = config["model"], config["tokenizer"]
    example, merge = min(cards, default="ID"), model.get("merge", 1)
    beside = any("baseline_loss" in metrics for metrics in _parts(cards, "metrics"))
    says_baseline = beside and model.get("kind") == "discrete"
    front: dict[str, Any] = {"library_name": "hma-toolkit", "pipeline_tag": "robotics"}
    front |= licence(card.get("license") for card in cards.values()) | _origins(cards)
    front["tags"] = [*_TAGS, *(f"embodiment:{name}" for name in sorted(cards))]
    pictures = []
    for name in sorted(cards):
        found = [part for part in (f"{name}/sample.gif", f"{name}/sample.png") if part in samples]
        pictures += [(name, picture) for picture in found[:1]]
    text = fill(
        "hma_model",
        "model_card.md",
        front=write_yaml(front),
        title=line((repo or "HMA world model").rsplit("/", 1)[-1]),
        verdicts=[
            (name, line(judged.get("verdict"), 400))
            for name, card in sorted(cards.items())
            for part in JUDGED
            if isinstance(judged := card.get(part), Mapping) and judged.get("verdict")
        ],
        model=_lines(model),
        levels="-".join(map(line, model.get("levels", ()))) if model.get("trunk") == "unet" else "",
        views=model.get("views", 1),
        tokenizer=_lines(tokenizer),
        grid="×".join(str(side) for side in model.get("grid", ())),
        weights=line(other_weights(tokenizer)),
        trunk=line(config.get("trunk_sha256")),
        page=page,
        rows=[_row(name, card) for name, card in sorted(cards.items())],
        loss_unit=token_words(merge if isinstance(merge, int) else 1) if says_baseline else "",
        pictures=pictures,
        name=repo or ".",
        example=example,
        side=line(tokenizer.get("image_size")),
        chunk=line(cards.get(example, {}).get("chunk_dim")) or "K",
        dtype="int64" if model.get("kind") == "discrete" else "float32",
        height=line(next(iter(tokenizer.get("grid", (0,))))),
        format_version=line(config.get("format_version")),
    )
    return (text + "\n").encode()


def _row(name: str, card: Mapping[str, Any]) -> list[str]:
    return [
        f"`{name}`",
        line(card.get("robot") or card.get("description")),
        f"{line(card.get('action_dim'))} ({line(card.get('action_space'))})",
        number(card.get("effective_hz")),
        line(card.get("stride")),
        _pairs(card.get("data")),
        _pairs(card.get("metrics")),
        line(card.get("license")) or "not stated",
    ]


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


def _lines(values: Mapping[str, Any]) -> Mapping[str, str]:
    """Return the values as `line` has them; a key that is missing is an empty text."""
    return defaultdict(str, {key: line(value) for key, value in values.items()})


def line(value: Any, longest: int = 200) -> str:
    """Return a value as one line that cannot leave its cell, become markup or change the text direction."""
    text = "".join(c if c.isprintable() else " " for c in str("" if value is None else value))
    text = " ".join(text.split())[:longest]
    if re.fullmatch(r"[\w.-]*", text, re.ASCII):
        return text
    text = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    text = re.sub(r"([|`\[\]\\*_~!#(){}$])", r"\\\1", text)
    return re.sub(r"(?i)(\w)(://|@)", r"\1&#8203;\2", text)  # prevents automatic links


def number(value: Any) -> str:
    """Return a float with four digits, or any other value as `line` does."""
    return f"{value:.4g}" if isinstance(value, float) else line(value)
