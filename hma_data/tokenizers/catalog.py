"""Which tokenizers there are: what each is, where its weights come from, and what it needs here.

A new tokenizer is a row of `CATALOG` and a module with `load(name, *, weights, device, **arguments)`.
Nothing here imports torch or a tokenizer's module.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

EMBEDDED = Path(__file__).parent / "weights"


@dataclass(frozen=True)
class Entry:
    """One tokenizer, as `hma tokenizer list` shows it.

    Attributes:
        name: as `--tokenizer` takes it.
        kind: discrete ids or continuous latents.
        image_size: side of the square picture in pixels.
        grid: (h, w) of the tokens or latents.
        description: one line.
        weights: embedded in the package, downloaded from the hub, none needed, or a path that the
            user names.
        module: imported on use; its `load` makes the tokenizer.
        arguments: further keyword arguments of `load`.
        licence: SPDX id or name of the weights' licence, or of the code where there are no weights.
        file: the weights' file, inside the package or inside `repo`.
        bytes: of a download; an embedded file is measured.
        repo, revision: of the hub, when weights are downloaded.
        imports: modules that must be importable.
        extra: the command that installs them; empty where the plain dependencies do.
    """

    name: str
    kind: Literal["discrete", "continuous"]
    image_size: int
    grid: tuple[int, int]
    description: str
    weights: Literal["embedded", "download", "none", "path"]
    module: str
    arguments: Mapping[str, Any] = field(default_factory=dict)
    licence: str = "Apache-2.0"
    file: str = ""
    bytes: int | None = None
    repo: str = ""
    revision: str = ""
    imports: tuple[str, ...] = ("torch",)
    extra: str = ""

    def missing(self) -> list[str]:
        """Modules it needs that are not installed."""
        return [name for name in self.imports if find_spec(name) is None]

    def size(self) -> int:
        """Bytes of the weights; 0 where there are none or the user names them."""
        if self.weights == "embedded":
            return (EMBEDDED / self.file).stat().st_size
        return self.bytes or 0

    def downloaded(self) -> bool:
        """Whether the hub's cache on this machine holds the weights."""
        if self.weights != "download":
            return False
        from huggingface_hub import try_to_load_from_cache

        found = try_to_load_from_cache(self.repo, self.file, revision=self.revision or None)
        return isinstance(found, str)

    def state(self) -> str:
        """What stands between here and using it: ready, a download, an install, or a path to name."""
        if missing := self.missing():
            return f"needs {', '.join(missing)}: {self.extra}"
        if self.weights == "path":
            return "needs --weights PATH"
        if self.weights == "download" and not self.downloaded():
            return "downloads on first use"
        return "ready"

    def to_json(self) -> dict[str, Any]:
        """Plain values, with the state and the measured size."""
        values = asdict(self)
        del values["module"], values["arguments"]
        return values | {
            "grid": list(self.grid),
            "imports": list(self.imports),
            "bytes": self.size(),
            "missing": self.missing(),
            "state": self.state(),
            "usable": self.state() == "ready",
        }


_ROWS = (
    Entry(
        "fsq-16",
        "discrete",
        256,
        (16, 16),
        "the default: finite scalar quantisation, 18 bits a token, fast on a CPU",
        "embedded",
        "hma_data.tokenizers.fsq",
        {"image_size": 256},
        file="fsq.safetensors",
    ),
    Entry(
        "fsq-8",
        "discrete",
        128,
        (8, 8),
        "the same network on small pictures, four times cheaper to train on",
        "embedded",
        "hma_data.tokenizers.fsq",
        {"image_size": 128},
        file="fsq.safetensors",
    ),
    Entry(
        "vae-8",
        "continuous",
        256,
        (32, 32),
        "continuous without a download: 4 channels at 1/8 of the side, fast on a CPU",
        "embedded",
        "hma_data.tokenizers.vae",
        {"image_size": 256},
        file="vae.safetensors",
    ),
    Entry(
        "raw",
        "continuous",
        256,
        (256, 256),
        "pixels as they are, for baselines and for models with a tokenizer of their own",
        "none",
        "hma_data.tokenizers.raw",
        imports=(),
    ),
)

CATALOG: dict[str, Entry] = {entry.name: entry for entry in _ROWS}
