"""Check a checkpoint before it is pushed, or after it was pulled."""

from collections.abc import Iterable

from hma_data.errors import CheckpointError
from hma_data.storage.files import file_sha256
from hma_data.storage.folders import read_metadata
from hma_model.checkpoint import io as checkpoints
from hma_model.checkpoint.io import CARD, SAMPLE, YAML, Checkpoint

MOST_PICTURE = 10_000_000  # maximum bytes of a sample.png, which a page shows
_PNG_BEGIN, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xae\x42\x60\x82"


def require_publishable(source: Checkpoint, embodiments: Iterable[str]) -> None:
    """Raise unless others can load the embodiments.

    Raises:
        CheckpointError: parts do not belong together, are damaged, or hold values that no model can use.
        RegistryError: an embodiment's YAML is not valid.
    """
    read_metadata(source.trunk())
    for name in embodiments:
        require_yaml(source, name)
        checkpoints.read_embodiment(source, name)
        _require_card(source, name)
        _require_picture(source, name)


def require_yaml(source: Checkpoint, name: str) -> None:
    """Raise CheckpointError unless embodiment.yaml is the file that the embodiment was saved with."""
    files = source.card(name).get("files")
    recorded = files.get(YAML) if isinstance(files, dict) else None
    path = source.path(name, YAML)
    if recorded not in (None, file_sha256(path)):
        remedy = "put the one back that it was trained with; facts for readers can be changed in the card"
        raise CheckpointError(path, f"is not the file that {CARD} names", remedy)


def _require_card(source: Checkpoint, name: str) -> None:
    card, path = source.card(name), source.path(name, CARD)
    if card.get("id", name) != name:
        raise CheckpointError(path, f"is the card of {str(card['id'])[:60]!r}", "save the checkpoint again")
    wanted = {"data": (dict, "an object"), "metrics": (dict, "an object"), "license": (str, "text")}
    for key, (kind, words) in wanted.items():
        if not isinstance(card.get(key), (kind, type(None))):
            fault = f"has a {key} that is {type(card[key]).__name__}, not {words}"
            raise CheckpointError(path, fault, "correct it, or save the checkpoint again")


def _require_picture(source: Checkpoint, name: str) -> None:
    if not (source.folder / "embodiments" / name / SAMPLE).is_file():
        return
    path = source.path(name, SAMPLE)
    content = path.read_bytes() if path.stat().st_size <= MOST_PICTURE else b""
    if not (content.startswith(_PNG_BEGIN) and content.endswith(_PNG_END)):
        fault = f"is not a whole PNG of at most {MOST_PICTURE:,} bytes"
        raise CheckpointError(path, fault, "make it again with hma hub push --sample DATA, or delete it")
