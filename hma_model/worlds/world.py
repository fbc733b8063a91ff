"""Keep sessions of a world model side by side, in images and actions.

    world = load_world("embedded")
    session = world.open("rails_03", *starting_window(world.model, "rails_03"))
    images = world.step({session: actions})   # the image that the actions lead to
    actions = world.act([session])              # those of the model itself, if it was trained to act

A session is a row of a rollout. Rows are added as sessions open, and used again as sessions close.

P frames of a prompt, H×W pixels, S pixels a side of the tokenizer's images, V views side by side, A action
dims, K = stride · A, n sessions of a step.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from hma_data.arrays import Float32s, Images
from hma_data.errors import HMAError
from hma_data.storage.paths import StrPath
from hma_data.tokenizers.base import Tokenizer, reopened
from hma_model.checkpoint.folder import require_tokenizer
from hma_model.evaluation.calibration import Meter, meter_of
from hma_model.generation.commands import Commands, card, described
from hma_model.generation.decode import decode, trained_cameras
from hma_model.generation.engine import products_in
from hma_model.generation.rollout import Rollout
from hma_model.generation.state import Snapshot as Snapshot
from hma_model.generation.unmask import Decoding, check
from hma_model.network.model import HMA
from hma_model.worlds.images import as_chunks, fitted, image_shape


@dataclass(frozen=True)
class _Session:
    row: int
    embodiment: str
    seed: int


class World:
    """Sessions of a world model. Not thread-safe.

    Args:
        model: in eval mode.
        tokenizer: the tokenizer that the model was trained on.
        compile, precision, decoding: as in `Rollout`; compile is for a GPU.

    Attributes:
        decoding: how frames are drawn; it may be replaced between steps, and counts for all sessions. With
            `measure` one knows how unsure the model is, see `uncertainty`; latents are then drawn twice.
        uncertainty: session → that of the newest frame as of `Rollout`, if it is measured.
        image_shape: (S, V·S, 3) of every image.
    """

    def __init__(
        self,
        model: HMA,
        tokenizer: Tokenizer,
        *,
        compile: bool = False,
        precision: str = "float32",
        **decoding: Any,
    ) -> None:
        require_tokenizer(model.config, tokenizer.spec, "the model")
        self.model = model
        self.tokenizer = tokenizer
        self.compile = compile
        self.precision = precision
        self.decoding = Decoding.of(model.config, **decoding)
        self.uncertainty = dict[int, float]()
        products_in(precision, model.device, compile)  # checks that the device has them
        self.image_shape = image_shape(model.config)
        self._rollout: Rollout | None = None
        self._sessions: dict[int, _Session] = {}
        self._opened = 0
        self._specs: dict[str, Commands] = {}

    @contextmanager
    def drawing(self, **changes: Any) -> Iterator[None]:
        """Draw frames in another way while the block runs; the changes are of fields of `decoding`."""
        before = self.decoding
        self.decoding = replace(before, **changes)
        try:
            yield
        finally:
            self.decoding = before

    def meter(self, embodiment: str, **changes: Any) -> tuple[Meter | None, str]:
        """Return the calibrated uncertainty of a robot's frames, or None and why there is none.

        Args:
            embodiment: an id.
            changes: fields in which the drawing of the frames differs from `decoding`.
        """
        way = replace(self.decoding, **changes)
        facts = card(self.model, embodiment)
        return meter_of(self.model.config, facts, way.unmask_steps, way.temperature, way.order)

    @property
    def one_pass(self) -> bool:
        """Return whether the model predicts a whole frame in one pass, whatever `decoding` says."""
        return self.model.config.whole_frames

    @property
    def sessions(self) -> dict[int, str]:
        """Return the open sessions and their embodiments."""
        return {number: one.embodiment for number, one in self._sessions.items()}

    def action_spec(self, embodiment: str) -> Commands:
        """Return what actions an embodiment takes; an HMAError says that the model lacks it."""
        if embodiment not in self._specs:
            self._specs[embodiment] = Commands.of(self.model, embodiment)
        return self._specs[embodiment]

    def open(
        self, embodiment: str, frames: NDArray[Any], chunks: Float32s | None = None, *, seed: int = 0
    ) -> int:
        """Open a session that starts from known frames, and return its number.

        Args:
            embodiment: an id of the model.
            frames: images (P, H, W, 3) uint8 RGB, at the rate of the model's frames; another size is
                resized as in a conversion. Or tokens or latents as stored, (P, h, w) or (P, c, h, w).
            chunks: (P - 1, K) raw; chunk k holds the actions from frame k to k+1. NaN where they are
                unknown. None: all are.
            seed: of the session's random numbers.

        Raises:
            HMAError: the model lacks the embodiment, or frames or chunks do not fit.
        """
        prompt = self._prompt(embodiment, frames, chunks)
        taken = {one.row for one in self._sessions.values()}
        row = next(row for row in range(len(taken) + 1) if row not in taken)
        self._reserve(row, embodiment)
        session = self._opened
        self._opened = self._opened + 1
        self._sessions[session] = _Session(row, embodiment, seed)
        self._begin(session, *prompt)
        return session

    def reset(
        self, session: int, frames: NDArray[Any], chunks: Float32s | None = None, *, seed: int | None = None
    ) -> None:
        """Start a session anew, as `open` does; without a seed, with the one that it had."""
        one = self._at(session)
        prompt = self._prompt(one.embodiment, frames, chunks)
        self._sessions[session] = replace(one, seed=one.seed if seed is None else seed)
        self._begin(session, *prompt)

    def close(self, session: int) -> None:
        """End a session; its row is free for another."""
        self._at(session)
        del self._sessions[session]

    def step(self, actions: Mapping[int, ArrayLike], *, decoded: bool = True) -> dict[int, Images]:
        """Generate the next image of some sessions, in one pass.

        Args:
            actions: session → (K,) or (stride, A) raw actions from its newest image to the next one. A
                action of NaN is unknown, and then the whole chunk is.
            decoded: whether the images are wanted; decoding takes as long as a small model.

        Returns:
            session → (S, V·S, 3) uint8 RGB; nothing if not decoded.
        """
        if not actions:
            return {}
        order, rows = self._ordered(actions)
        chunks, known = self._chunks(order, actions)
        rollout = self._running()
        check(self.decoding, self.model.config)
        rollout.decoding = self.decoding
        frames = rollout.step(chunks, known=known, rows=rows)
        if self.decoding.measure:
            self.uncertainty |= dict(zip(order, rollout.uncertainty.tolist()))
        return dict(zip(order, decode(self.tokenizer, frames.unsqueeze(1))[:, 0])) if decoded else {}

    def act(self, sessions: Iterable[int]) -> dict[int, Float32s]:
        """Return the actions (stride, A) that the model itself gives after the newest images of sessions.

        Raises:
            HMAError: the model was not trained to act.
        """
        order, rows = self._ordered(sessions)
        made = self._running().act(rows).numpy(force=True)
        spaces = [self.model.embodiments[self._at(session).embodiment] for session in order]
        return {
            session: chunk[: space.chunk_dim].reshape(space.stride, space.action_dim)
            for session, chunk, space in zip(order, made, spaces)
        }

    def observe(self, images: Mapping[int, Images], actions: Mapping[int, ArrayLike]) -> None:
        """Add the images that truly came next to sessions, in one pass.

        Args:
            images: session → (H, W, 3) uint8 RGB, all of one size.
            actions: session → as in `step`, those that led to its image.
        """
        order, rows = self._ordered(images)
        chunks, known = self._chunks(order, actions)
        stored = self.encoded(self._at(order[0]).embodiment, np.stack([images[one] for one in order]))
        self._running().observe(torch.from_numpy(stored), chunks, known=known, rows=rows)

    def image(self, session: int) -> Images:
        """Return the newest image of a session; after `open`, the last of its prompt."""
        return decode(self.tokenizer, self._newest(session).unsqueeze(1))[0, 0]

    def shown(self, frames: NDArray[Any]) -> Images:
        """Return the images (P, S, V·S, 3) of frames as a prompt takes them; images stay as they are."""
        stored = frames.shape[1:] == self.model.config.frame_shape  # of pixels in uint8 too
        if frames.ndim == 4 and frames.dtype == np.uint8 and not stored:
            return frames
        return decode(self.tokenizer, torch.from_numpy(np.asarray(frames)).unsqueeze(0))[0]

    def encoded(self, embodiment: str, frames: NDArray[Any]) -> NDArray[Any]:
        """Return the tokens (P, h, w) int64 or latents (P, c, h, w) float32 of frames as a prompt takes them.

        Images are encoded, those of another size resized as in a conversion of the embodiment.
        """
        config = self.model.config
        if not len(frames) or frames.shape[1:] != config.frame_shape:
            cameras = trained_cameras(self.model, embodiment)
            images = fitted(frames, config, described(self.model, embodiment), cameras)
            views = [self.tokenizer.encode(view) for view in np.split(images, config.views, axis=2)]
            frames = np.concatenate(views, axis=-2)
        if not config.discrete:
            return frames.astype(np.float32)
        ids = frames.astype(np.int64)
        if not 0 <= ids.min() <= ids.max() < config.vocab_size:
            fault = f"has tokens from {ids.min()} to {ids.max()}"
            raise HMAError("prompt", fault, f"give those of the tokenizer, from 0 to {config.vocab_size - 1}")
        return ids

    def stored(self, session: int) -> NDArray[Any]:
        """Return the newest frame of a session as shards store it: tokens (h, w) or latents (c, h, w)."""
        frame = self._newest(session)[0].cpu().numpy()
        if self.model.config.pixels:
            frame = frame.clip(0, 255)  # a cast would wrap around
        return frame.astype(self.tokenizer.spec.dtype)

    def snapshot(self, session: int) -> Snapshot:
        """Return a copy of a session's state."""
        return self._running().snapshot([self._at(session).row])

    def fork(self, sessions: Sequence[int], n: int) -> "World":
        """Return a world in which each of some sessions is n times, with the same random numbers.

        Its sessions are numbered from 0, those of one side by side.
        """
        ones = [self._at(session) for session in sessions for _ in range(n)]
        way = {"compile": self.compile, "precision": self.precision, **vars(self.decoding)}
        other = World(self.model, self.tokenizer, **way)
        other._rollout = self._running().fork(n, [self._at(session).row for session in sessions])
        other._opened = len(ones)
        other._sessions = {number: replace(one, row=number) for number, one in enumerate(ones)}
        return other

    def restore(self, session: int, snapshot: Snapshot) -> None:
        """Put a session into the state of a snapshot, of itself or of another session of the same model."""
        one = self._at(session)
        self._running().restore([one.row], snapshot)
        self._sessions[session] = replace(one, embodiment=snapshot.embodiments[0])

    # -- rows -----------------------------------------------------------------------------------------------

    def _at(self, session: int) -> _Session:
        if session not in self._sessions:
            there = ", ".join(map(str, self._sessions)) or "none"
            raise HMAError(f"session {session}", f"is not open; open are: {there}", "open one first")
        return self._sessions[session]

    def _ordered(self, sessions: Iterable[int]) -> tuple[list[int], list[int]]:
        """Return sessions in the order of their rows, and these rows."""
        order = sorted(sessions, key=lambda session: self._at(session).row)
        return order, [self._at(session).row for session in order]

    def _chunks(
        self, order: Sequence[int], actions: Mapping[int, ArrayLike]
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the actions of sessions as chunks (n, K), and which are known (n,)."""
        read = [self.action_spec(self._at(one).embodiment).read(actions[one]) for one in order]
        chunks = np.zeros((len(order), max(len(chunk) for chunk, _ in read)), np.float32)
        for row, (chunk, _) in zip(chunks, read):
            row[: len(chunk)] = chunk
        return torch.from_numpy(chunks), torch.tensor([known for _, known in read])

    def _newest(self, session: int) -> torch.Tensor:
        return self._running().newest([self._at(session).row])

    def _running(self) -> Rollout:
        assert self._rollout is not None
        return self._rollout

    def _reserve(self, row: int, embodiment: str) -> None:
        """Make sure that the rollout has a row; rows double."""
        before = self._rollout
        if before is not None and row < before.batch:
            return
        batch = 1 if before is None else 2 * before.batch
        self._rollout = Rollout(self.model, embodiment, batch, compile=self.compile, precision=self.precision)
        if before is not None:
            self._rollout.restore(range(before.batch), before.snapshot())

    def _begin(self, session: int, frames: torch.Tensor, chunks: torch.Tensor, known: torch.Tensor) -> None:
        one = self._at(session)
        actions = chunks.unsqueeze(0) if len(chunks) else None
        self._running().reset(
            [one.row], frames.unsqueeze(0), actions, known.unsqueeze(0), [one.seed], [one.embodiment]
        )

    # -- prompts --------------------------------------------------------------------------------------------

    def _prompt(
        self, embodiment: str, frames: NDArray[Any], chunks: Float32s | None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return stored frames (P, ...), chunks (P - 1, K), and which are known (P - 1,)."""
        spec = self.action_spec(embodiment)
        stored = self.encoded(embodiment, np.asarray(frames)[-self.model.config.frames :])
        if chunks is None:
            chunks = np.full((len(frames) - 1, spec.stride * len(spec.names)), np.nan)
        chunks = as_chunks(chunks)
        if len(chunks) != len(frames) - 1:
            fault = f"has {len(chunks)} chunks for {len(frames)} frames"
            raise HMAError("prompt", fault, f"give {len(frames) - 1}, one from each frame to the next")
        # A prompt longer than the model's window has lost its first frames, and the chunks between them.
        read = [spec.read(chunk) for chunk in chunks[len(frames) - len(stored) :]]
        known = torch.tensor([known for _, known in read], dtype=torch.bool)
        values = np.stack([chunk for chunk, _ in read]) if read else np.zeros((0, 1), np.float32)
        return torch.from_numpy(stored), torch.from_numpy(values), known


def load_world(
    checkpoint: StrPath = "embedded",
    embodiments: Sequence[str] | None = None,
    *,
    device: str = "cpu",
    **settings: Any,
) -> World:
    """Return a world of a checkpoint and of its tokenizer.

    Args:
        checkpoint: str or path of a checkpoint or training run, a URI, a hub repository, or `embedded`.
        embodiments: ids of those to load; None for all of one network; of `embedded`, its transformer.
        device: of the network and of the tokenizer.
        settings: of `World`.
    """
    model = HMA.from_pretrained(checkpoint, embodiments, device=device)
    return World(model, reopened(model.config.tokenizer, device), **settings)
