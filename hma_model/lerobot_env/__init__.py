"""Offer a world model to lerobot as an environment: `lerobot-eval --env.type=hma`, and EnvHub.

    lerobot-eval --policy.path=POLICY --env.type=hma --env.checkpoint=CHECKPOINT --env.embodiment=ID \\
        --env.discover_packages_path=hma_model.lerobot_env

    from lerobot.envs.factory import make_env  # a checkpoint that hma hub push has published
    envs = make_env("org/model", n_envs=4, trust_remote_code=True)

lerobot imports this package and finds the environment registered. S pixels a side.
"""

import logging
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from lerobot.configs import FeatureType, PolicyFeature, parser
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig

from hma_data.errors import HMAError, UsageError
from hma_data.sources.lerobot.writer import SYNTHETIC
from hma_model.checkpoint.folder import Checkpoint
from hma_model.hub.publish import located
from hma_model.lerobot_env.vector import LeRobotVectorEnv, camera_names, judged_task, state_source
from hma_model.worlds.images import image_shape
from hma_model.worlds.prompts import read_prompt
from hma_model.worlds.world import World, load_world

Envs = dict[str, dict[int, LeRobotVectorEnv]]
log = logging.getLogger(__name__)


@EnvConfig.register_subclass("hma")
@dataclass
class HMAEnvConfig(EnvConfig):
    """An environment in a world model.

    Attributes:
        checkpoint: as `HMA.from_pretrained` takes it.
        embodiment: an id of it; may be left out if it has one.
        horizon: steps of an episode.
        judge: a task or a reward model that judges success, as of `hma policy-eval --judge`; None for none.
        judge_from: shards with success labels, which measure a reward model.
        state: whether policies are told the state, read off the images, where it can be learned.
        prompt: what all episodes start from, as `hma play --prompt`; None draws from the simulator, or from
            the held-out episodes of the training's shards.
        size: side in pixels of the images; None for that of the model.
        device, unmask_steps, temperature: as of `load_world`.
        task: what policies are told; by default the robot's id.
        fps, features, features_map: read from the checkpoint.
    """

    task: str | None = None
    checkpoint: str = "embedded"
    embodiment: str = ""
    horizon: int = 300
    judge: str | None = None
    judge_from: str | None = None
    state: bool = True
    prompt: str | None = None
    clip: bool = False
    size: int | None = None
    device: str = "cpu"
    unmask_steps: int = 2
    temperature: float | None = None
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        with in_one_line():
            refuse_own_checkpoint()
            checkpoint, self.embodiment = opened(self.checkpoint, self.embodiment, "--env.embodiment")
            self._read(checkpoint)

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> Envs:
        """Return the environments; they step in one pass in any case."""
        with in_one_line():
            require_fit(self)
            if self.judge is None:
                log.warning("no judge is given, so pc_success will be 0; name one by --env.judge")
            world = load_world(
                self.checkpoint, [self.embodiment], device=self.device, unmask_steps=self.unmask_steps,
                temperature=self.temperature,
            )  # fmt: skip
            read_prompt(world.model, self.embodiment, self.prompt)  # or a refusal before what takes minutes
            checkpoint = located(self.checkpoint, [self.embodiment])[0]
            env = made(checkpoint, self.embodiment, n_envs, world, vars(self))
            _ = env.reader, env.judge  # what they say of themselves comes before the evaluation
            return {self.type: {0: env}}

    def _read(self, checkpoint: Checkpoint) -> None:
        """Complete what the checkpoint says."""
        robot = checkpoint.embodiment(self.embodiment)
        if self.horizon < robot.stride:
            remedy = f"give {robot.stride} or more, the actions of one frame"
            raise UsageError("horizon", f"is {self.horizon}", remedy)
        if self.judge is not None:
            judged_task(self.embodiment, self.judge)
        self.fps = max(1, round(robot.rate_hz if robot.states_rate else 10))
        self.task = self.task or self.embodiment
        side = self.size or image_shape(checkpoint.config)[0]
        image = PolicyFeature(FeatureType.VISUAL, (side, side, 3))
        names = camera_names(checkpoint, self.embodiment)
        # lerobot's recorder finds one camera as "pixels", and several only by the names that policies know
        cameras = (
            {f"observation.images.{name}": image for name in names} if len(names) > 1 else {"pixels": image}
        )
        self.features = {"action": PolicyFeature(FeatureType.ACTION, (robot.action_dim,)), **cameras}
        if self.state and robot.state is not None and state_source(checkpoint, self.embodiment):
            size = len(robot.state.names())
            self.features["agent_pos"] = PolicyFeature(FeatureType.STATE, (size,))
        # of no type that policies take, but a column of what lerobot records of an evaluation
        self.features[SYNTHETIC] = PolicyFeature(FeatureType.REWARD, (1,))
        own = {"pixels": "observation.image", "agent_pos": "observation.state"}
        own[SYNTHETIC] = f"observation.{SYNTHETIC}"
        self.features_map = {key: own.get(key, key) for key in self.features}


def opened(source: str, embodiment: str, option: str) -> tuple[Checkpoint, str]:
    """Return a checkpoint and its embodiment; if none is named, a UsageError asks for the option."""
    checkpoint, names = located(source, [embodiment] if embodiment else None)
    if len(names) != 1:
        there = ", ".join(checkpoint.embodiments)
        raise UsageError("embodiment", "is not given", f"give {option}=ID; the model has: {there}")
    return checkpoint, names[0]


def made(
    checkpoint: Checkpoint, embodiment: str, n_envs: int, world: World, given: Mapping[str, Any]
) -> LeRobotVectorEnv:
    """Return the environments of a robot, with the settings that are given."""
    keys = ("state", "judge", "judge_from", "task", "horizon", "prompt", "clip", "size")
    settings = {key: given[key] for key in keys if key in given}
    return LeRobotVectorEnv(checkpoint, embodiment, n_envs, world, **settings)


def published_envs(file: str, repo: str | None, n_envs: int, cfg: Any = None) -> Envs:
    """Return the environments of a published checkpoint by robot; its `env.py` calls this.

    Args:
        file: path of the `env.py`.
        repo: of the checkpoint, in the revision that the file is of; None if it lies beside the file.
        n_envs: of each robot.
        cfg: with attributes as of `HMAEnvConfig`, if wanted; an `embodiment` chooses one.
    """
    folder = Path(file).parent
    source = str(folder) if repo is None else repo
    if repo is not None and folder.parent.name == "snapshots":  # of the hub's client: named by the commit
        source = f"{repo}@{folder.name}"
    given = {} if cfg is None else dict(vars(cfg))
    names = [given["embodiment"]] if given.get("embodiment") else None
    checkpoint, chosen = located(source, names)
    own = {key: given[key] for key in ("device", "unmask_steps", "temperature") if key in given}
    world = load_world(source, names, **own)
    return {name: {0: made(checkpoint, name, n_envs, world, given)} for name in chosen}


def refuse_own_checkpoint() -> None:
    """Check that --policy.path of lerobot's command line is no checkpoint of ours, which lerobot cannot read.

    Raises:
        UsageError: it is one.
    """
    path = parser.get_path_arg("policy")
    if path is None:
        return
    try:
        Checkpoint.open(path)
    except HMAError:
        return
    fault = "is a checkpoint of this toolkit, and lerobot reads only configurations of its own"
    remedy = f"give --policy.type=hma --policy.checkpoint={path} in place of --policy.path"
    raise UsageError("--policy.path", fault, remedy)


def require_fit(config: HMAEnvConfig) -> None:
    """Check that the policy of lerobot's command line takes what the robot gives.

    Raises:
        UsageError: it does not.
    """
    path = parser.get_path_arg("policy")
    if path is None:
        return
    policy = PreTrainedConfig.from_pretrained(path)
    renamed = yaml.safe_load(parser.parse_arg("rename_map") or "{}") or {}
    own = {config.features_map[key]: one for key, one in config.features.items() if key != SYNTHETIC}
    given = {renamed.get(key, key): feature for key, feature in own.items()}
    for key, feature in {**policy.input_features, **policy.output_features}.items():
        there = given.get(key)
        if there and (feature.type is FeatureType.VISUAL or tuple(there.shape) == tuple(feature.shape)):
            continue
        offered = ", ".join(f"{name} {tuple(one.shape)}" for name, one in given.items())
        fault = f"takes {key} {tuple(feature.shape)}, and {config.embodiment} gives {offered}"
        remedy = "give a policy of this robot, --env.state=true, or other names by --rename_map"
        raise UsageError(f"policy {path}", fault, remedy)


@contextmanager
def in_one_line() -> Iterator[None]:
    """Let a command line of lerobot end with the one line of an error of ours."""
    try:
        yield
    except HMAError as fault:
        if Path(sys.argv[0]).name.startswith("lerobot"):
            sys.exit(f"error: {fault}")
        raise
