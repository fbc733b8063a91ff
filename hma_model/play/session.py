"""Drive one robot in a world model, with what truly happens beside it.

A session lives in the stepper's thread; `hma_model.play.stepper` steps all sessions that are due together.

H×W pixels, A action dims, K = stride * A values of a chunk.
"""

import math
import time
from collections import deque
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from hma_data.arrays import Float32s, Images
from hma_data.episodes.images import opencv, resize
from hma_data.errors import UsageError
from hma_model.evaluation.calibration import POWER
from hma_model.evaluation.metrics import PSNR_LIMIT, psnr
from hma_model.generation.unmask import Decoding
from hma_model.play.pads import describe
from hma_model.worlds.scenes import Drivable, LabScene, RecordedScene
from hma_model.worlds.world import World

RESTART_FRAMES = 8  # frames that a restart of the model is given
KEPT_FRAMES = 3000  # frames to save
QUALITY = 92  # of JPEG
Scene = LabScene | RecordedScene


@dataclass(frozen=True)
class Frame:
    """A frame that was driven to: JPEG images of the model and of the truth, and the actions before it.

    Attributes:
        actions: (stride, A); where nobody knows the recorded ones, the last known one held.
        state: (S,) of the simulator after it, or None.
        psnr: of the two images in dB, or None.
        still: PSNR of an image that stands still since the beginning or the last sync, or None.
    """

    number: int
    model: bytes
    true: bytes | None
    actions: Float32s
    state: Float32s | None
    psnr: float | None
    still: float | None = None


class Viewer(Protocol):
    """The receiver of a session's images; the stepper's thread calls its methods, which return at once."""

    @property
    def stalled(self) -> bool:
        """Return whether it has read nothing for a while."""

    @property
    def behind(self) -> int:
        """Return how many frames it was given and has not shown yet."""

    def show(self, frame: Frame, facts: dict[str, Any]) -> None:
        """Show a frame; one that it has not sent yet is replaced."""

    def tell(self, message: dict[str, Any]) -> None:
        """Send a message."""


class Session:
    """A robot, its scene, its place in a world, and the frames so far.

    Attributes:
        world: of the model.
        row: the world's number for it.
        meter: calibrated uncertainty; None where `unmetered` says why.
        viewer: who watches; without one the session stands still.
        due: the time of the next step.
        touched: when a person did something last.
        last: the frame to be seen now: the newest one, or that from which the model was restarted.
    """

    def __init__(
        self, name: str, robot: Drivable, number: int, scene: Scene, world: World, sampling: Decoding
    ) -> None:
        self.name = name
        self.robot = robot
        self.world = world
        self.viewer: Viewer | None = None
        self.due = self.touched = time.monotonic()
        self.paused = True
        self.replays = False
        self.fast = False
        self.warned = False  # that actions are outside the range of the page
        self.steps = 0  # single steps asked for
        self.input = 0  # number of the newest input, by which the page measures latency
        self._times: deque[float] = deque(maxlen=40)
        self._stated = 0.0
        self.sample(sampling)
        self._begin(number, scene)
        self.row = world.open(robot.embodiment.id, *self._history())
        self._set_start()

    def sample(self, sampling: Decoding) -> None:
        """Go on with another sampling; the meter of uncertainty is that of such frames."""
        self.sampling = sampling
        meter, self.unmetered = self.world.meter(self.robot.embodiment.id, **vars(sampling))
        if meter is not None and not meter.better:
            self.unmetered = meter.verdict
        self.meter = None if self.unmetered else meter

    # -- scene and model

    def begin(self, number: int) -> None:
        """Begin another scene, or the same anew."""
        self._begin(number, self.robot.scene(number))
        self.world.reset(self.row, *self._history())
        self._set_start()

    def _begin(self, number: int, scene: Scene) -> None:
        self.number = number
        self.scene = scene
        prompt = scene.prompt
        self._true: deque[Images] = deque(prompt.frames, maxlen=RESTART_FRAMES)
        self._chunks: deque[Float32s] = deque(prompt.chunks, maxlen=RESTART_FRAMES - 1)
        self.held = self.scene.action.copy()
        self.frames: deque[Frame] = deque(maxlen=KEPT_FRAMES)
        self.count = 0
        self.ended = False
        self.steps = 0

    def _set_start(self) -> None:
        """Take the prompt's last frame as the tokenizer shows it, which the model cannot surpass."""
        self.start = self.last = self._restarted(
            Frame(0, b"", None, np.zeros((0, 0), np.float32), self._state, None)
        )

    def _restarted(self, frame: Frame) -> Frame:
        """Return a frame with the images from which the model goes on; divergence is looked for anew."""
        shown = self.world.image(self.row)
        true = self._true[-1]
        rate = self.robot.embodiment.rate_hz / self.robot.embodiment.stride
        self._divergence = DivergenceDetector(true, shown, round(rate))
        self._stated = 0.0
        self._still = true
        return replace(frame, model=jpeg(shown), true=jpeg(true), psnr=_score(shown, true), still=PSNR_LIMIT)

    @property
    def parted(self) -> int | None:
        """Return the frame from which on the model no longer shows what truly happens."""
        return self._divergence.parted

    def sync(self) -> None:
        """Restart the model from the true last frames.

        Raises:
            UsageError: nobody knows them.
        """
        if not self._true:
            raise UsageError("sync", "the true frames are unknown here", "reset first, or drive a simulator")
        self.steps = 0  # a step asked for before is not one from the true frames
        self.world.reset(self.row, *self._history())
        self.last = self._restarted(self.last)

    def _history(self) -> tuple[Images, Float32s]:
        """Return the true last frames, and the chunks between them."""
        frames = list(self._true)
        chunks = list(self._chunks)
        return np.stack(frames), np.stack(chunks[len(chunks) - len(frames) + 1 :])

    # -- one step

    def ready(self, now: float) -> bool:
        """Check whether the next frame is due."""
        if self.viewer is None or self.viewer.stalled or self.ended or now < self.due:
            return False
        return self.steps > 0 or (not self.paused and not (self.fast and self.viewer.behind > 1))

    def next_chunk(self) -> Float32s | None:
        """Advance the truth, and return the chunk (K,) for the model; None at a recording's end."""
        stride = self.robot.embodiment.stride
        found = self.scene.advance(None if self.replays else np.tile(self.held, stride))
        if found is None:
            self.ended = True
            return None
        chunk, self._truth = found
        self._chunks.append(chunk)
        return chunk

    def take(self, image: Images, now: float, took: float) -> None:
        """Take the model's image (H, W, 3) of the step, which took so many seconds, and show it."""
        self.steps = max(0, self.steps - 1)
        self.count += 1
        period = self.robot.embodiment.stride / self.robot.embodiment.rate_hz
        self.due = now if self.fast else max(self.due + period, now)
        self._times.append(now)
        if self._truth is None:
            self._true.clear()
        else:
            self._true.append(self._truth)
        unsure = self.world.uncertainty.get(self.row, math.nan) if self.meter else math.nan
        self._stated = (self._stated**POWER + unsure**POWER) ** (1 / POWER)
        score = still = None
        if self._truth is not None:
            score = _score(image, self._truth)
            still = _score(self._still, self._truth)
            self._divergence.look(self.count, image, self._truth)
        stride = self.robot.embodiment.stride
        actions: Float32s = self._chunks[-1].reshape(stride, -1)
        if np.isnan(actions).any():
            actions = np.tile(self.held, (stride, 1))
        true = None if self._truth is None else jpeg(self._truth)
        frame = Frame(self.count, jpeg(image), true, actions, self._state, score, still)
        self.frames.append(frame)
        self.last = frame
        if self.replays:
            self.touched = now
            self.held = actions[-1].copy()
        if self.viewer:
            facts = {
                "ms": round(1000 * took, 1), "rate": self._rate(now), "input": self.input,
                "action": actions[-1].tolist(), "parted": self.parted, "meter": self.metered,
            }  # fmt: skip
            self.viewer.show(frame, facts)

    @property
    def metered(self) -> dict[str, Any] | None:
        """Return the state error to expect in the newest frame, and whether to warn; None without a meter.

        `beyond`: the model is less certain than in any calibrated group of frames, so that the error is more.
        """
        if self.meter is None or not math.isfinite(self._stated):
            return None
        stated = np.array(self._stated)
        px, warns = round(float(self.meter.expected(stated)), 1), bool(self.meter.warns(stated))
        return {"px": px, "beyond": self._stated > self.meter.stated[-1], "warns": warns}

    @property
    def _state(self) -> Float32s | None:
        """Return the state (S,) of the simulator, if there is one."""
        return self.scene.simulator.state if isinstance(self.scene, LabScene) else None

    def _rate(self, now: float) -> float:
        """Return the frames a second of the last 2 s or so."""
        recent = [then for then in self._times if now - then < 2.0]
        return round((len(recent) - 1) / (now - recent[0]), 1) if len(recent) > 1 and now > recent[0] else 0.0

    # -- what the page shows

    def status(self) -> dict[str, Any]:
        """Return the settings that the page shows, as plain values."""
        return {
            "kind": "status", "paused": self.paused, "replays": self.replays, "fast": self.fast,
            "sampling": vars(self.sampling), "one_pass": self.world.one_pass, "scene": self.number,
            "frame": self.count, "ended": self.ended, "knows": bool(self._true), "parted": self.parted,
            "meter": self.metered, "unmetered": self.unmetered,
            "metered": "" if self.meter is None else self.meter.verdict,
        }  # fmt: skip

    def opened(self) -> dict[str, Any]:
        """Return all that a page needs to go on with the session, as plain values."""
        scores = [[frame.number, frame.psnr, frame.still] for frame in list(self.frames)[-600:]]
        return self.status() | {
            "kind": "opened", "scores": scores, "session": self.name, "robot": describe(self.robot),
            "held": self.held.tolist(), "input": self.input,
        }  # fmt: skip

    def film(self) -> list[Frame]:
        """Return the frames that are kept, after the prompt's last one if they begin there."""
        return [*([self.start] if self.count == len(self.frames) else []), *self.frames]


def jpeg(image: Images) -> bytes:
    """Return an image (H, W, 3) RGB as a JPEG with colours at full size."""
    cv2 = opencv()
    settings = [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    settings += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    return cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), settings)[1].tobytes()


def _score(image: Images, true: Images) -> float:
    return round(float(psnr(true, image, limit=PSNR_LIMIT)), 2)


# -- divergence
#
# A frame is lost if it is much worse than the tokenizer alone would make it, and another frame would do as
# well: a still of the beginning, or the truth of another moment. A model that follows its actions is nearest
# to the truth of now, however blurred it is. One that does not may still be sharp and move plausibly.

SIDE = 32  # pixels of thumbnails: where parts are, not how sharp they are
LOST_FACTOR = 4.0  # times the squared error of the tokenizer alone: 6 dB
NEARER = 0.8  # of the squared error: another moment must be nearer by 1 dB
OWN_ERROR = 1.0  # of the tokenizer alone, at least
MEMORY = 300  # moments that are remembered: comparing with them takes a few milliseconds a frame
MIN_ROW = 3  # lost frames in a row, for robots of few frames a second


class DivergenceDetector:
    """Find the first of the frames that were lost for a second.

    Args:
        true: the first true frame (H, W, 3).
        shown: the same as the tokenizer shows it.
        second: frames of a second.

    Attributes:
        parted: number of that frame; None so far.
    """

    def __init__(self, true: Images, shown: Images, second: int) -> None:
        self.parted: int | None = None
        self._second = max(MIN_ROW, second)
        self._first = _thumbnail(true)
        self._own_error = max(OWN_ERROR, float(np.square(_thumbnail(shown) - self._first).mean()))
        self._moments = self._first[None]  # (n, S, S, 3) true ones, the oldest first
        self._lost = 0  # frames in a row

    def look(self, number: int, image: Images, true: Images) -> None:
        """Compare the model's frame of a number with the true one."""
        if self.parted is not None:
            return
        made = _thumbnail(image)
        now = _thumbnail(true)
        self._moments = np.concatenate([self._moments, now[None]])[-MEMORY:]
        errors = np.square(self._moments - made).mean(axis=(1, 2, 3))
        # A frame that is a little late is not lost: it may be of any moment of the last half second.
        error = errors[-max(1, self._second // 2) :].min()
        others = errors[: max(1, len(errors) - self._second)]
        still = np.square(self._first - now).mean()
        replaceable = still <= error or others.min() < NEARER * error
        self._lost = self._lost + 1 if replaceable and error > LOST_FACTOR * self._own_error else 0
        if self._lost == self._second:
            self.parted = number - self._second + 1


def _thumbnail(image: Images) -> Float32s:
    return resize(image[None], SIDE, "stretch")[0].astype(np.float32)
