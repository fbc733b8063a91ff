"""Tell policies, models and judges from others of the same name by what they are made of.

`hma policy-eval` keeps what came of finished policies. A fingerprint is in the name of each kept file, so a
policy that was edited or trained again is scored again.
"""

import pickle
import sys
import uuid
from contextlib import suppress
from pathlib import Path
from typing import Any

from hma_data.errors import HMAError
from hma_data.storage.files import file_sha256, short_sha256
from hma_model.checkpoint.folder import HEAD, STATS, STEM, YAML, Checkpoint
from hma_model.evaluation.kept import weights_sha256
from hma_model.network.model import HMA
from hma_model.policies.acting import OPTIONS
from hma_model.policies.base import split_options
from hma_model.worlds.world import World


def policy_facts(words: str, embodiment: str) -> dict[str, str]:
    """Return what may change under the words of a policy that was read: names and SHA-256 of its files.

    Of `module:name` it is the module's own file: other files that it reads or imports are not looked at. A
    repository of the hub is known by its words alone.

    Args:
        words: as `hma policy-eval` takes them.
        embodiment: the robot.
    """
    kind, _, rest = words.partition(":")
    if kind == "hma" and rest:
        with suppress(HMAError):
            kept = Checkpoint.open(split_options(kind, rest, OPTIONS)[0], [embodiment])
            parts = {part: file_sha256(kept.path(embodiment, part)) for part in (STEM, HEAD, YAML, STATS)}
            return {"trunk": kept.trunk_sha256} | parts
        return {}  # of the hub or a store
    if kind == "lerobot" and rest:
        return folder_facts(Path(rest))
    source = getattr(sys.modules.get(kind), "__file__", None) if rest else None
    return {"module": file_sha256(Path(source))} if source else {}


def folder_facts(folder: Path) -> dict[str, str]:
    """Return names and SHA-256 of the files in a folder; nothing if it is none, as of a hub's repository."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): file_sha256(path) for path in files}


def world_facts(world: World) -> dict[str, Any]:
    """Return what changes the frames of a world, beside its checkpoint, unmask steps and temperature."""
    way = world.decoding
    facts = {"order": way.order, "sample_steps": way.sample_steps, "precision": world.precision}
    if world.model.source is None:
        facts["weights"] = weights_sha256(world.model)
    return facts


def object_sha256(value: Any) -> str:
    """Return the SHA-256 of an object as pickled; of one that cannot be pickled, another one in each call."""
    try:
        return short_sha256(pickle.dumps(value, protocol=5), 64)
    except Exception:  # an object's own methods may raise anything
        return uuid.uuid4().hex


def world_digests(world: World, embodiment: str) -> dict[str, str]:
    """Return what tells the checkpoint of a world from others."""
    kept = world.model.source
    if kept is None:
        return {"checkpoint": "in memory"}
    return {"checkpoint_sha256": kept.trunk_sha256, "stem_sha256": file_sha256(kept.path(embodiment, STEM))}


def device_facts(model: HMA) -> dict[str, str]:
    """Return the device of a model, on which its numbers depend; nothing for a CPU."""
    return {} if model.device.type == "cpu" else {"device": model.device.type}
