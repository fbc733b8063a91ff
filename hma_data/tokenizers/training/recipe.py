"""Read and check the YAML recipe that trains an embedded tokenizer; unknown keys are refused."""

import hashlib
import json
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, ValidationError, model_validator

from hma_data.errors import RecipeError
from hma_data.storage.paths import StrPath, as_path
from hma_data.storage.yaml_io import first_fault, read_yaml
from hma_data.tokenizers.shapes import PATCH, FsqConfig, VaeConfig

LOCAL: dict[str, Any] = {"corpus": True, "network": {"latent_scale"}}  # a place, and a measured value
Share = Annotated[float, Field(ge=0, le=1)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class TrainingRecipe(_Strict):
    """The length, batch size and learning rates of a training.

    Attributes:
        steps: number of optimizer steps.
        batch, crop: number of crops a step, and their side in pixels, a multiple of 16.
        learning_rate: highest rate of Muon (matrices), in units of the spectral norm.
        adam_learning_rate: highest rate of Adam (biases, first and last layers).
        weight_decay: decay of Muon's matrices; it keeps their spectral norms below its inverse.
        warmup_steps: number of steps over which the rate rises linearly at the start.
        fall: points (step, share of the highest rate), in ascending order. The rate is constant up to the
            first point and linear between points; the last point is (steps, 0). A run that has started
            can be resumed with another `fall` and another `steps`, as long as the rates of the past
            steps stay the same.
        ema: decay of the averaged weights; the averaged weights are the ones that are kept.
        decoder_only: whether the encoder stays as it is. Shards and models of the tokenizer that the
            training starts from then stay valid; only images that are decoded change.
        threads: number of torch threads; it changes only the last bits of the result.
    """

    steps: int = Field(gt=0)
    batch: int = Field(gt=0)
    crop: int = Field(gt=0, multiple_of=2 * PATCH)
    learning_rate: float = Field(gt=0)
    adam_learning_rate: float = Field(gt=0)
    weight_decay: float = Field(ge=0, default=0.0)
    warmup_steps: int = Field(ge=0, default=100)
    fall: list[tuple[NonNegativeInt, Share]] = Field(default_factory=list)
    ema: float = Field(ge=0, lt=1, default=0.998)
    decoder_only: bool = False
    threads: int = Field(gt=0, default=1)

    @model_validator(mode="after")
    def _falls_to_the_end(self) -> "TrainingRecipe":
        steps = [step for step, _ in self.fall]
        ends = self.fall and (self.fall[0][1], self.fall[-1]) == (1, (self.steps, 0))
        if self.fall and not (ends and sorted(set(steps)) == steps):
            raise ValueError(f"fall must begin with share 1, ascend in steps and end with [{self.steps}, 0]")
        return self

    def rate(self, step: int) -> float:
        """Return the share of the highest learning rate at a step; steps count from 0."""
        rise = min(1.0, (step + 1) / max(1, self.warmup_steps))
        if not self.fall:
            return rise
        steps, shares = [point[0] for point in self.fall], [point[1] for point in self.fall]
        return min(rise, float(np.interp(step, steps, shares)))


class LossRecipe(_Strict):
    """The weights of the parts of the loss; pixels are in [0, 1].

    Attributes:
        l2: of the squared error.
        l1: of the absolute error.
        gradient: of the error of the differences of neighbours.
        ssim: of 1 - SSIM.
        edges: how much more pixels near an edge count in l2 and l1; a robot's outline is mostly edges.
    """

    l2: float = Field(ge=0)
    l1: float = Field(ge=0)
    gradient: float = Field(ge=0)
    ssim: float = Field(ge=0)
    edges: float = Field(ge=0, default=0.0)


class FileSource(_Strict):
    """Images and videos under a folder of the corpus.

    Attributes:
        path: folder below the recipe's `corpus`.
        glob: patterns of the files to take.
        origin: the package and version that the files come from.
        weight: how often a crop is from this source, relative to the others.
        frames: number of frames taken from each video, evenly spaced.
    """

    kind: Literal["files"]
    path: str
    glob: list[str]
    origin: str
    weight: float = Field(gt=0, default=1.0)
    frames: int = Field(gt=0, default=40)


class DrawnSource(_Strict):
    """Images made by `recipes/tokenizer/draw.py`, in a folder of the corpus named after their kind."""

    kind: Literal["pusht", "drawn"]
    pictures: int = Field(gt=0, default=200)
    weight: float = Field(gt=0, default=1.0)
    glob: ClassVar[list[str]] = ["*.png"]
    origin: ClassVar[str] = "images of recipes/tokenizer/draw.py"
    frames: ClassVar[int] = 1

    @property
    def path(self) -> str:
        """Return the folder below the recipe's `corpus`."""
        return self.kind


class TokenizerRecipe(_Strict):
    """A whole training, described well enough to repeat it.

    Attributes:
        start: path of the weights of an earlier training to start from, of a network that is no larger; by
            default the corpus's linear code.
    """

    job: Literal["tokenizer"]
    name: str
    start: str | None = None
    seed: int = Field(ge=0)
    corpus: str
    network: FsqConfig | VaeConfig
    training: TrainingRecipe
    loss: LossRecipe
    sources: list[FileSource | DrawnSource] = Field(min_length=1)

    @model_validator(mode="after")
    def _keeps_an_encoder(self) -> "TokenizerRecipe":
        if self.training.decoder_only and self.start is None:
            raise ValueError("training.decoder_only keeps the encoder of `start`: name that file")
        return self

    def digest(self) -> str:
        """Return the SHA-256 of all values except the corpus's location and what training measures."""
        return self._digest(LOCAL)

    def course(self) -> str:
        """Return the SHA-256 of the values that must not change when a run is resumed.

        It covers the values of `digest` except `steps`, `fall` and `threads`. A run can be resumed if this
        digest and the rates of its past steps are the same.
        """
        return self._digest(LOCAL | {"training": {"steps", "fall", "threads"}})

    def _digest(self, exclude: dict[str, Any]) -> str:
        values = self.model_dump(mode="json", exclude=exclude)
        if self.start is None:  # the digests of recipes older than these settings stay
            values.pop("start", None)
        if "loss" in values and not self.loss.edges:
            values["loss"].pop("edges", None)
        if "training" in values and not self.training.decoder_only:
            values["training"].pop("decoder_only", None)
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def load_recipe(path: StrPath, overrides: dict[str, Any] | None = None) -> TokenizerRecipe:
    """Read a recipe from a YAML file.

    Args:
        path: str or path of the YAML.
        overrides: values that replace those of the file, by dotted key (`training.steps`).

    Raises:
        RecipeError: the file or an override is not valid.
    """
    path = as_path(path)
    values = read_yaml(path, RecipeError)
    for key, value in (overrides or {}).items():
        *parents, last = key.split(".")
        node = values
        for parent in parents:
            node = node.get(parent) if isinstance(node, dict) else None
        if not isinstance(node, dict):
            raise RecipeError(path, f"has no key {key!r} to override")
        node[last] = value
    try:
        return TokenizerRecipe.model_validate(values)
    except ValidationError as fault:
        raise RecipeError(path, first_fault(fault)) from fault
