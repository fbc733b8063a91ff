# /// script
# requires-python = ">=3.12"
# dependencies = ["hma-toolkit", "gymnasium-robotics==1.4.2", "mujoco==3.3.2"]
#
# [tool.uv]
# override-dependencies = [  # what recording does not need, and what would overwrite the headless OpenCV
#     "torch ; sys_platform == 'never'",
#     "lerobot ; sys_platform == 'never'",
#     "opencv-python ; sys_platform == 'never'",
# ]
#
# [tool.uv.sources]
# hma-toolkit = {path = "../..", editable = true}
# ///
"""Record gymnasium-robotics' FetchPickAndPlace to HDF5: a Fetch arm carries a block to a goal, at 25 Hz.

    uv run recipes/lab/fetch.py build/lab --episodes 40
    hma convert build/lab/fetch.hdf5 -e fetch --out build/lab/shards/fetch

The physics, the look and the success are the environment's; the camera is nearer. The goal is the red ball.
"""

import numpy as np
import recorder

from hma_data.console import run_script

SIZE = 128  # pixels: the side of the pictures
NEARER = {"distance": 1.25, "azimuth": 145.0, "elevation": -25.0, "lookat": np.array([1.3, 0.75, 0.5])}
REACH = 8.0  # command for each metre to go; 1 moves the hand by 0.05 m


class Fetch:
    """The environment; commands are steps of the hand in x, y, z, and the gripper's (1 opens it)."""

    robot = "fetch"
    low, high = -np.ones(4), np.ones(4)
    noise, centre, spread = np.array([0.35, 0.35, 0.35, 0.0]), np.zeros(4), np.array([0.5, 0.5, 0.4, 1.0])
    least, steps, rest = 40, 60, 8  # frames

    def __init__(self) -> None:
        import gymnasium
        import gymnasium_robotics

        gymnasium.register_envs(gymnasium_robotics)
        self._env = gymnasium.make(
            "FetchPickAndPlace-v4",
            render_mode="rgb_array",
            width=SIZE,
            height=SIZE,
            default_camera_config=NEARER,
        ).unwrapped

    def reset(self, seed):
        self._seen, _ = self._env.reset(seed=seed)
        self._held = 0  # frames for which the gripper was told to close round the block
        return "put the block where the red ball is"

    def observe(self):
        seen = self._seen["observation"]
        objects = np.concatenate([seen[3:6], seen[11:14], self._seen["desired_goal"]])
        return self._env.render(), np.concatenate([seen[:3], seen[9:11]]), objects

    def expert(self):
        hand, block, goal = (
            self._seen["observation"][:3],
            self._seen["observation"][3:6],
            self._seen["desired_goal"],
        )
        aside, above = np.linalg.norm((block - hand)[:2]), hand[2] - block[2]
        if aside > 0.04 or above > 0.1:
            self._held = 0
        if aside > 0.015 and above > 0.03 and not self._held:
            target = block + np.array([0.0, 0.0, 0.08])
        elif above > 0.012 and not self._held:
            target = block
        else:
            self._held += 1
            target = goal if self._held > 5 else block
        return np.append(REACH * (target - hand), -1.0 if self._held else 1.0)

    def step(self, command):
        self._seen, *_, facts = self._env.step(command)
        return bool(facts["is_success"])


if __name__ == "__main__":
    run_script(lambda: recorder.main(Fetch, __doc__))
