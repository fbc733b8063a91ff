"""Save a model with all its embodiments; load a trunk with some of them.

`hma_model.checkpoint.folder` describes the layout.
"""

import shutil
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hma_data.errors import CheckpointError, HMAError, OutputError
from hma_data.registry.embodiment import Embodiment
from hma_data.storage.files import file_sha256, new_folder, to_json, write_atomic
from hma_data.storage.paths import StrPath, as_path, is_repository
from hma_model.checkpoint import weights
from hma_model.checkpoint.folder import (
    CARD,
    CONFIG,
    FORMAT_VERSION,
    HEAD,
    LIBRARY,
    PARTS,
    README,
    SAMPLE,
    STATS,
    STEM,
    TRAINING,
    TRUNK,
    YAML,
    Checkpoint,
    action_stats,
    check_id,
    digest,
    inside,
)  # fmt: skip
from hma_model.checkpoint.model_card import render
from hma_model.checkpoint.weights import write_tensors
from hma_model.config import ActionSpace, HMAConfig

if TYPE_CHECKING:
    from hma_model.network.model import HMA


def save(
    model: "HMA",
    folder: StrPath,
    *,
    embodiment_yaml: Mapping[str, str],
    stats: Mapping[str, dict[str, Any]],
    cards: Mapping[str, dict[str, Any]],
    training: Callable[[Path], None] | None = None,
    base: Checkpoint | None = None,
    samples: Mapping[str, bytes] | None = None,
    half: bool = False,
) -> Checkpoint:
    """Write a model and all its embodiments; replace an existing checkpoint of that name in one step.

    Args:
        model: has exactly the embodiments of `embodiment_yaml`.
        folder: str or path of the folder; an error leaves an older checkpoint there as it was.
        embodiment_yaml: id -> registry YAML.
        stats: id -> {"action": {"mean", "std", ...}, ...}.
        cards: id -> the known facts of its data and metrics; an id without a card gets an empty one.
        training: writes what only a resumed run needs into the folder `training/`, which it is given.
        base: a checkpoint with the same trunk. Its trunk, its configuration and the files of its other
            embodiments are taken over unchanged.
        samples: id -> a PNG shown in the model card.
        half: store weights in float16, half the bytes; statistics stay float32, and all is once loaded.

    Raises:
        CheckpointError: parts do not agree, the folder holds something else, it cannot be written, or a
            weight is too large for float16.
    """
    from safetensors import SafetensorError

    folder = as_path(folder)
    if unnamed := sorted(set(model.embodiments) - set(embodiment_yaml)):
        raise CheckpointError(folder, f"no embodiment YAML was given for {', '.join(unnamed)}")
    for name, text in embodiment_yaml.items():
        check_id(name, folder)
        found = Embodiment.from_yaml(text, f"{folder}: {name}").id
        if found != name:
            raise CheckpointError(folder, f"the YAML given for {name!r} has id {found!r}")
        action_stats(stats.get(name, {}), f"{folder}: statistics of {name}")
    foreign = any(folder.iterdir()) if folder.is_dir() else folder.exists()
    if foreign and not (folder / CONFIG).is_file():
        raise CheckpointError(folder, "already exists and is not a checkpoint", "choose another folder")
    try:
        with new_folder(folder) as new:
            if base:
                trunk = base.trunk_sha256
                taken = {name: inside(base.folder, name) for name in (CONFIG, TRUNK)}
                for name in set(base.embodiments) - set(embodiment_yaml):
                    taken |= base.files(name)
                for name, path in taken.items():
                    _link(path, new / name)
            else:
                write_tensors(new / TRUNK, model.trunk_state(), {"format": "pt"}, half)
                trunk = file_sha256(new / TRUNK)
                (new / CONFIG).write_bytes(to_json(config_json(model.config, trunk)))
            for name in sorted(embodiment_yaml):
                home = new / "embodiments" / name
                home.mkdir(parents=True)
                (home / YAML).write_text(embodiment_yaml[name], encoding="utf-8")
                (home / STATS).write_bytes(to_json(stats[name]))
                if samples and name in samples:
                    (home / SAMPLE).write_bytes(samples[name])
                _write_embodiment(model, home, trunk, cards.get(name, {}), half)
            if training:
                (new / TRAINING).mkdir()
                training(new / TRAINING)
            write_readme(new)
    except (OSError, SafetensorError) as fault:
        remedy = "free space or choose another folder; older checkpoints are intact"
        raise CheckpointError(folder, f"cannot be written: {fault}", remedy) from fault
    return Checkpoint.open(folder)


def load(
    checkpoint: StrPath | Checkpoint, embodiments: Iterable[str] | None = None, device: str = "cpu"
) -> "HMA":
    """Return the model of a checkpoint with the chosen embodiments; read nothing else.

    Args:
        checkpoint: an open one, or str or path of a checkpoint or of a training run.
        embodiments: ids; None for all of the checkpoint.
        device: where the model goes.

    Raises:
        CheckpointError: the checkpoint is missing or damaged, or its parts do not belong together.
    """
    from hma_model.network.model import HMA

    checkpoint = Checkpoint.open(checkpoint)
    wanted = checkpoint.chosen(embodiments)
    trunk = weights.trunk(checkpoint)
    model = HMA(checkpoint.config)
    model.load_trunk(trunk, checkpoint.folder / TRUNK)
    for name in wanted:
        add_embodiment(model, checkpoint, name)
    model.source = checkpoint
    return model.to(device).eval()


def add_embodiment(model: "HMA", checkpoint: Checkpoint, embodiment: str) -> None:
    """Load one embodiment's stem and head beside a trunk that is already loaded."""
    from hma_model.network.stem import waves_of_stem

    space, stem, head = read_embodiment(checkpoint, embodiment)
    model.add_embodiment(space, waves=waves_of_stem(stem) or None)
    added = model.stem(embodiment).waves
    if added is not None and "waves.weight" not in stem:  # they begin at zero
        stem = {**stem, "waves.weight": added.weight.detach()}
    model.load_embodiment(embodiment, stem, head)


def read_embodiment(
    checkpoint: Checkpoint, embodiment: str
) -> tuple[ActionSpace, weights.State, weights.State]:
    """Return an embodiment's action space and the tensors of its stem and head, all checked."""
    checkpoint.check(embodiment)
    yaml, path = checkpoint.embodiment(embodiment), checkpoint.path(embodiment, STATS)
    if yaml.id != embodiment:
        raise CheckpointError(path.with_name(YAML), f"has id {yaml.id!r}", f"its folder says {embodiment!r}")
    try:
        space = ActionSpace.of(yaml, action_stats(checkpoint.stats(embodiment), path))
    except HMAError as fault:
        text = f"does not fit {YAML}: {fault.fault}"
        raise CheckpointError(path, text, "pull the embodiment again") from fault
    return space, *weights.embodiment(checkpoint, embodiment, space)


def write_readme(checkpoint: StrPath | Checkpoint) -> None:
    """Write README.md from the cards of a checkpoint (str or path of its folder, or an open one)."""
    checkpoint = Checkpoint.open(checkpoint)
    cards = checkpoint.cards()
    samples = {f"{name}/{part}" for name in cards for part in checkpoint.pictures(name)}
    text = render(config_json(checkpoint.config, checkpoint.trunk_sha256), cards, samples=samples)
    write_atomic(checkpoint.folder / README, text)


def record_evaluation(
    checkpoint: Checkpoint, embodiment: str, facts: Mapping[str, Any], part: str = "evaluation"
) -> None:
    """Write what a measurement found into an embodiment's card, and the model card anew.

    Args:
        facts: `verdict`, a sentence about the embodiment, and the figures behind it.
        part: of the card; one of `model_card.JUDGED`.
    """
    card = checkpoint.card(embodiment)
    if card.get(part) != facts:
        write_atomic(checkpoint.path(embodiment, CARD), to_json(card | {part: dict(facts)}))
        write_readme(checkpoint)


def record_locally(
    label: StrPath,
    source: Checkpoint | None,
    embodiment: str,
    facts: Mapping[str, Any],
    part: str = "evaluation",
) -> None:
    """Do as `record_evaluation` if a command's checkpoint, `label`, is the user's own on this machine."""
    if source is None or source.bundled or is_repository(label) or "://" in str(label):
        return
    with suppress(OutputError):  # a folder that may only be read
        record_evaluation(source, embodiment, facts, part)


def remove(folder: StrPath) -> None:
    """Delete a checkpoint; an interrupted deletion leaves no partial checkpoint under its name."""
    folder = as_path(folder)
    # Renamed first: what a killed deletion leaves has no checkpoint's name.
    doomed = folder.with_name(f".{folder.name}.partial-removed")
    shutil.rmtree(doomed, ignore_errors=True)
    folder.rename(doomed)
    shutil.rmtree(doomed, ignore_errors=True)


def config_json(config: HMAConfig, trunk_sha256: str) -> dict[str, Any]:
    """Return the content of config.json."""
    model = config.to_json()
    tokenizer = model.pop("tokenizer")
    return {
        "format_version": FORMAT_VERSION,
        "library": LIBRARY,
        "trunk_sha256": trunk_sha256,
        "tokenizer": tokenizer,
        "model": model,
    }


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        target.hardlink_to(source)
    except OSError:  # another file system, or one without hard links
        shutil.copyfile(source, target)


def _write_embodiment(model: "HMA", home: Path, trunk: str, given: dict[str, Any], half: bool) -> None:
    tokenizer, stats = digest(model.config.tokenizer), file_sha256(home / STATS)
    links = {"trunk_sha256": trunk, "tokenizer": tokenizer, "stats_sha256": stats}
    metadata = {"format": "pt", "format_version": str(FORMAT_VERSION), "embodiment": home.name, **links}
    write_tensors(home / STEM, model.stem_state(home.name), metadata, half)
    write_tensors(home / HEAD, model.head_state(home.name), metadata, half)
    robot = Embodiment.load(home / YAML)
    unstated = robot.frequency_hz == "unknown" and not robot.sync.rate_hz
    facts = {
        "format_version": FORMAT_VERSION,
        "id": robot.id,
        "description": robot.description,
        "robot": robot.robot,
        "kind": robot.kind,
        "action_space": robot.action.space,
        "action_dim": robot.action_dim,
        "stride": robot.stride,
        "chunk_dim": robot.chunk_dim,
        "effective_hz": None if unstated else robot.effective_hz,
        "license": robot.license,
    }
    files = {part: file_sha256(home / part) for part in PARTS[:-1]}  # all but the card itself
    card = {**facts, "data": {}, "metrics": {}, **given, **links, "files": files}
    (home / CARD).write_bytes(to_json(card))
