"""Render robots in MuJoCo for the tokenizer's training: many scenes, cameras, lights and colours.

    MUJOCO_GL=osmesa python recipes/tokenizer/render.py OUT [--pictures 120] [--seed 20]

It needs an environment of its own, because the simulators' versions of MuJoCo exclude others: gym-aloha,
gymnasium-robotics, metaworld, mujoco; and Debian's libosmesa6. Scenes come from the simulators' own tasks
after random actions; each picture has its own camera, lights and colours. `--package robosuite` renders
pictures that are held out: no robosuite scene is used in training.
"""

import argparse
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.console import run_script

SIZE = 256
# name -> tasks; a scene is a task after random actions
SCENES: dict[str, list[str]] = {
    "gymnasium-robotics": [
        "FetchPickAndPlace-v4",
        "FetchSlide-v4",
        "HandManipulateBlock-v1",
        "HandManipulateEgg-v1",
        "HandReach-v3",
        "AdroitHandDoor-v1",
        "AdroitHandHammer-v1",
        "AdroitHandRelocate-v1",
        "FrankaKitchen-v1",
    ],
    "metaworld": [
        "assembly-v3",
        "basketball-v3",
        "button-press-v3",
        "coffee-button-v3",
        "dial-turn-v3",
        "drawer-open-v3",
        "faucet-open-v3",
        "hammer-v3",
        "lever-pull-v3",
        "plate-slide-v3",
        "shelf-place-v3",
        "sweep-v3",
        "window-open-v3",
    ],
    "gym-aloha": ["gym_aloha/AlohaTransferCube-v0", "gym_aloha/AlohaInsertion-v0"],
}
HELD_OUT: dict[str, list[str]] = {
    "robosuite": ["PickPlaceCan/Panda", "Door/Sawyer", "NutAssemblySquare/Panda", "Wipe/UR5e"],
}


def _make_robosuite(task: str, seed: int) -> Any:
    suite, wrappers = import_module("robosuite"), import_module("robosuite.wrappers")
    name, robot = task.split("/")
    quiet = {"has_renderer": False, "has_offscreen_renderer": False, "use_camera_obs": False}
    return wrappers.GymWrapper(suite.make(name, robots=robot, seed=seed, **quiet))


def _make(package: str, task: str, seed: int) -> tuple[Any, Callable[[], tuple[Any, Any]]]:
    """Return an environment, and a function that returns its MuJoCo model and data."""
    import gymnasium

    if package == "robosuite":
        env = _make_robosuite(task, seed)
    elif package == "metaworld":
        metaworld = import_module("metaworld")
        benchmark = metaworld.MT1(task, seed=1)
        env = benchmark.train_classes[task]()
        env.set_task(benchmark.train_tasks[0])
    else:
        module = import_module(package.replace("-", "_"))
        if hasattr(gymnasium, "register_envs"):
            gymnasium.register_envs(module)
        env = gymnasium.make(task).unwrapped

    def handles() -> tuple[Any, Any]:
        if package == "gym-aloha":
            physics = env._env.physics
            return physics.model.ptr, physics.data.ptr
        if package == "robosuite":
            simulation = env.unwrapped.sim
            return simulation.model._model, simulation.data._data
        return env.model, env.data

    return env, handles


def _randomize(model: Any, rng: np.random.Generator) -> None:
    """Change colours and lights of the model in place; keep the textures."""
    visible = model.geom_rgba[:, 3] > 0
    tint = rng.uniform(0.3, 1.0, (len(model.geom_rgba), 3))
    chosen = visible & (rng.random(len(visible)) < 0.4)
    model.geom_rgba[chosen, :3] = tint[chosen]
    materials = rng.random(len(model.mat_rgba)) < 0.4
    model.mat_rgba[materials, :3] = rng.uniform(0.2, 1.0, (int(materials.sum()), 3))
    if model.nlight:
        model.light_diffuse[:] = rng.uniform(0.2, 0.9, model.light_diffuse.shape)
        model.light_pos[:] += rng.normal(0, 0.3, model.light_pos.shape)
    model.vis.headlight.diffuse[:] = rng.uniform(0.1, 0.6)
    model.vis.headlight.ambient[:] = rng.uniform(0.1, 0.4)


def _camera(model: Any, data: Any, rng: np.random.Generator) -> Any:
    """Return one of the scene's own cameras, or one that looks at a random body from nearby."""
    mujoco = import_module("mujoco")
    if model.ncam and rng.random() < 0.3:
        return int(rng.integers(model.ncam))
    camera = mujoco.MjvCamera()
    camera.lookat[:] = data.xpos[int(rng.integers(1, model.nbody))]
    camera.distance = float(np.exp(rng.uniform(np.log(0.35), np.log(1.8))))
    camera.azimuth = float(rng.uniform(0, 360))
    camera.elevation = float(rng.uniform(-65, -10))
    return camera


def render(package: str, count: int, seed: int) -> Iterator[NDArray[np.uint8]]:
    """Yield `count` pictures (256, 256, 3) uint8 RGB of a package's scenes."""
    mujoco = import_module("mujoco")
    rng = np.random.default_rng([seed, len(package)])
    tasks = (SCENES | HELD_OUT)[package]
    option = mujoco.MjvOption()
    option.geomgroup[0] = package != "robosuite"  # robosuite's group of collision geometry
    for index, task in enumerate(tasks):
        env, handles = _make(package, task, seed)
        env.reset(seed=seed)
        env.action_space.seed(seed)
        model, data = handles()
        share = count // len(tasks) + (index < count % len(tasks))
        with mujoco.Renderer(model, SIZE, SIZE) as renderer:
            for made in range(share):
                for _ in range(4):
                    env.step(env.action_space.sample())
                if made % 3 == 2:
                    _randomize(model, rng)
                renderer.update_scene(data, _camera(model, data, rng), option)
                yield renderer.render().copy()
        env.close()


def main() -> None:
    """Write OUT/<package>/00000.png and the pictures that follow, for each package."""
    import cv2

    parser = argparse.ArgumentParser(description="Render robots in MuJoCo for the tokenizer's training")
    parser.add_argument("out", type=Path)
    parser.add_argument("--pictures", type=int, default=120, help="a package")
    parser.add_argument("--seed", type=int, default=20)
    parser.add_argument("--package", choices=sorted(SCENES | HELD_OUT), action="append")
    arguments = parser.parse_args()
    for package in arguments.package or SCENES:
        folder = arguments.out / package
        folder.mkdir(parents=True, exist_ok=True)
        for index, picture in enumerate(render(package, arguments.pictures, arguments.seed)):
            cv2.imwrite(str(folder / f"{index:05d}.png"), picture[:, :, ::-1])


if __name__ == "__main__":
    run_script(main)
