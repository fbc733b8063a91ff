"""List the tokenizers: what each is, where its weights come from, and what it needs on this machine.

To add a tokenizer, add a row to `CATALOG`, or have an installed package add an `Entry`
(docs/extending.md), and a module with `load(name, *, weights, device, **arguments)`. This module
imports neither torch nor a built-in tokenizer's module.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, get_args

from hma_data.episodes.images import Filter
from hma_data.errors import PluginError, TokenizerError, install_command
from hma_data.plugins import TOKENIZER_GROUP, Plugin, installed
from hma_data.storage.files import file_sha256, opened_weights

EMBEDDED = Path(__file__).parent / "weights"


@dataclass(frozen=True)
class Entry:
    """A tokenizer, as `hma tokenizer list` shows it.

    Attributes:
        name: name that `--tokenizer` takes.
        kind: discrete ids or continuous latents.
        image_size: side of the square image in pixels.
        grid: (h, w) of the tokens or latents.
        description: one line.
        weights: embedded in the package, downloaded from the hub, none needed, or a path that the
            user names.
        module: imported on use; its `load` makes the tokenizer.
        arguments: further keyword arguments of `load`.
        licence: SPDX id or name of the weights' licence, or of the code's if there are no weights.
        file: the weights' file, inside the package or inside `repo`.
        bytes: size of a download; the size of an embedded file is read from the file.
        repo, revision, repo_type: repository on the hub, if weights are downloaded.
        sha256: SHA-256 of the download, if it is known; another file is refused.
        imports: modules that must be importable.
        extra: the command that installs them; empty if the plain dependencies do.
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
    repo_type: Literal["model", "dataset"] = "model"
    sha256: str = ""
    imports: tuple[str, ...] = ("torch",)
    extra: str = ""

    def missing(self) -> list[str]:
        """Return the modules it needs that are not installed."""
        return [name for name in self.imports if find_spec(name) is None]

    def size(self) -> int:
        """Return the size of the weights in bytes; 0 if there are none or the user names them."""
        return (EMBEDDED / self.file).stat().st_size if self.weights == "embedded" else self.bytes or 0

    def tokens_digest(self) -> str:
        """Return the digest by which specs name its embedded weights; empty where none are embedded."""
        if self.weights != "embedded":
            return ""
        path = EMBEDDED / self.file
        with opened_weights(path) as file:
            return (file.metadata() or {}).get("tokens_sha256") or file_sha256(path)

    def state(self) -> str:
        """Return "ready" or what it still needs: an install, a path, or a download on first use."""
        if missing := self.missing():
            return f"needs {', '.join(missing)}: {self.extra}"
        if self.weights == "path":
            return "needs --weights PATH"
        if self.weights == "download" and self.cached() is None:
            return "downloads on first use"
        return "ready"

    def cached(self) -> str | None:
        """Return the path of the weights in the hub's cache on this machine, if they are there."""
        from huggingface_hub import try_to_load_from_cache

        place = {"revision": self.revision or None, "repo_type": self.repo_type}
        found = try_to_load_from_cache(self.repo, self.file, **place)
        return found if isinstance(found, str) else None

    def to_json(self) -> dict[str, Any]:
        """Return plain values, with the state and the measured size."""
        values = {key: value for key, value in asdict(self).items() if key not in ("module", "arguments")}
        state = {"missing": self.missing(), "state": self.state(), "usable": self.state() == "ready"}
        return values | {"bytes": self.size()} | state


_MAGVIT2 = Entry(
    "magvit2", "discrete", 256, (16, 16),
    "the paper's: Open-MAGVIT2 as 1X tuned it to robot video, 18 bits per token",
    "download", "hma_data.tokenizers.magvit2", {"averaged": True},
    repo="1x-technologies/worldmodel", repo_type="dataset", file="magvit2.ckpt", bytes=1_150_000_000,
    revision="94b418de3ad6efe100495a45ce82d5d870df6265",
)  # fmt: skip
_ROWS = (
    Entry(
        "fsq-16", "discrete", 256, (16, 16),
        "the default: finite scalar quantisation, 18 bits per token, fast on a CPU",
        "embedded", "hma_data.tokenizers.embedded", {"image_size": 256}, file="fsq.safetensors",
    ),
    Entry(
        "fsq-8", "discrete", 128, (8, 8),
        "the same network on small images, four times cheaper to train on",
        "embedded", "hma_data.tokenizers.embedded", {"image_size": 128}, file="fsq.safetensors",
    ),
    Entry(
        "fsq-lab", "discrete", 128, (16, 16),
        "sharp on clean small images, 15 bits per token; the tokenizer of the bundled world model",
        "embedded", "hma_data.tokenizers.embedded", {"image_size": 128}, file="fsq-lab.safetensors",
    ),
    Entry(
        "palette-64", "discrete", 64, (32, 32),
        "each pixel one of up to 255 colours, 2×2 pixels per token: sharp edges, for convolutional models",
        "embedded", "hma_data.tokenizers.palette", {"image_size": 64, "colors": None},
        file="palette.safetensors",
    ),
    Entry(
        "vae-8", "continuous", 256, (32, 32),
        "continuous without a download: 4 channels at 1/8 of the side, fast on a CPU",
        "embedded", "hma_data.tokenizers.embedded", {"image_size": 256}, file="vae.safetensors",
    ),
    _MAGVIT2,
    replace(
        _MAGVIT2, name="magvit2-plain", arguments={"averaged": False},
        description="the same checkpoint without averaged weights: the same ids as the paper's code",
    ),
    Entry(
        "svd-vae", "continuous", 256, (32, 32),
        "the paper's continuous one: Stable Video Diffusion's autoencoder, 4 channels",
        "download", "hma_data.tokenizers.latents", licence="Stability AI Community License",
        repo="stabilityai/stable-video-diffusion-img2vid", bytes=391_000_000,
        file="vae/diffusion_pytorch_model.safetensors", revision="9cf024d5bfa8f56622af86c884f26a52f6676f2e",
        imports=("torch", "diffusers"), extra=install_command("svd"),
    ),
    Entry(
        "taesd", "continuous", 256, (32, 32),
        "the latents of Stable Diffusion 1 and 2 by a tiny network, 4 channels",
        "download", "hma_data.tokenizers.latents", {"channels": 4}, licence="MIT",
        repo="madebyollin/taesd", file="diffusion_pytorch_model.safetensors", bytes=9_793_292,
        revision="614f76814bbe30edbe2e627ace1c2234c81a2c0e",
        sha256="db169d69145ec4ff064e49d99c95fa05d3eb04ee453de35824a6d0f325513549",
    ),
    Entry(
        "taef2", "continuous", 256, (32, 32),
        "the latents of FLUX.2 by a tiny network, 32 channels: finer images, eight times the data",
        "download", "hma_data.tokenizers.latents", {"channels": 32}, licence="MIT",
        repo="madebyollin/taef2", file="taef2.safetensors", bytes=10_000_000,
        revision="bd244ebfe4398c84fbf312a2f1c868c676b500e3",
        sha256="701d31c0ecbef3b609fe236e2e3a65ffb17f3a94237acdd771e8ea3194df557a",
    ),
    Entry(
        "cosmos-di16", "discrete", 256, (16, 16),
        "NVIDIA Cosmos, discrete: 64,000 ids; TorchScript files that the user trusts and names",
        "path", "hma_data.tokenizers.cosmos", licence="NVIDIA Open Model License",
    ),
    Entry(
        "cosmos-ci16", "continuous", 256, (16, 16),
        "NVIDIA Cosmos, continuous: 16 channels; TorchScript files that the user trusts and names",
        "path", "hma_data.tokenizers.cosmos", licence="NVIDIA Open Model License",
    ),
    Entry(
        "raw", "continuous", 256, (256, 256),
        "raw pixels, for baselines and for models with their own tokenizer",
        "none", "hma_data.tokenizers.raw", imports=(),
    ),
    Entry(
        "raw-128", "continuous", 128, (128, 128),
        "raw pixels of small images: no tokenizer error, no decoding",
        "none", "hma_data.tokenizers.raw", {"image_size": 128}, imports=(),
    ),
    Entry(
        "raw-64", "continuous", 64, (64, 64),
        "the same at 64 pixels, four times cheaper to train on",
        "none", "hma_data.tokenizers.raw", {"image_size": 64}, imports=(),
    ),
)  # fmt: skip

CATALOG: dict[str, Entry] = {entry.name: entry for entry in _ROWS}


def other_weights(spec: Mapping[str, Any]) -> str:
    """Return the digest of a tokenizer's weights if they are not those that come along under its name.

    Args:
        spec: values of a TokenizerSpec, as in a checkpoint's config.json.
    """
    entry, stated = CATALOG.get(str(spec.get("name"))), str(spec.get("weights_sha256") or "")
    own = entry.tokens_digest() if entry else ""
    return stated if own and stated and stated != own else ""


def find_entry(name: str) -> Entry:
    """Return the tokenizer of that name: built in, or of an installed package.

    The name may end in a filter for resizing, as in `raw-128:antialias`.

    Raises:
        TokenizerError: there is no such tokenizer, or no such filter.
        PluginError: the package that adds it is broken.
    """
    name, chosen, resize_filter = name.partition(":")
    if chosen and resize_filter not in get_args(Filter):
        known = " or ".join(f"{name}:{one}" for one in get_args(Filter))
        raise TokenizerError(name, f"has no filter {resize_filter!r} for resizing", f"write {known}")
    if name in CATALOG:
        return CATALOG[name]
    plugin = installed(TOKENIZER_GROUP).get(name)
    if plugin is None:
        known = ", ".join(sorted({*CATALOG, *installed(TOKENIZER_GROUP)}))
        more = f"an installed package may add tokenizers by entry points of {TOKENIZER_GROUP}"
        raise TokenizerError(name, "is not a tokenizer", f"known: {known}; {more}")
    return _entry_of(plugin)


def all_entries() -> tuple[list[Entry], list[PluginError]]:
    """Return every tokenizer, and the errors of packages that are broken."""
    found, broken = list(CATALOG.values()), list[PluginError]()
    for name, plugin in installed(TOKENIZER_GROUP).items():
        if name not in CATALOG:
            try:
                found.append(_entry_of(plugin))
            except PluginError as fault:
                broken.append(fault)
    return found, broken


def _entry_of(plugin: Plugin) -> Entry:
    """Return the entry that a package's object is, or gives when it is called."""
    entry = plugin.load()
    if callable(entry):
        entry = plugin.call(f"{plugin.entry_point.value}()", entry)
    if not isinstance(entry, Entry):
        kind = type(entry).__name__
        raise plugin.broken(f"gives a {kind}, not an Entry of hma_data.tokenizers.catalog")
    if entry.name != plugin.name:
        raise plugin.broken(f"its Entry is named {entry.name!r}, not {plugin.name!r}")
    return entry
