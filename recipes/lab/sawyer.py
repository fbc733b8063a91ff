# /// script
# requires-python = ">=3.12"
# dependencies = ["hma-toolkit", "metaworld==3.0.0", "mujoco==3.3.2"]
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
"""Record six tasks of Meta-World to MCAP: a Sawyer pushes, places, opens and presses things, at 20 Hz.

    uv run recipes/lab/sawyer.py build/lab --episodes 40
    hma convert build/lab/sawyer -e sawyer --out build/lab/shards/sawyer

The physics, the look, the success and the scripted experts are Meta-World's, but its shadows are coarser,
which takes a third off the time of a picture. The camera is corner2, moved nearer; as there, it hangs upside
down. A command is held for four steps of the environment; the experts move at 0.4 of full speed at most.
"""

import warnings

import numpy as np
import recorder

from hma_data.console import run_script

SIZE, SHADOWS = 128, 1024  # pixels: the side of the pictures, and of the map of shadows
NEARER = (0.75, 0.075, 0.7)  # the camera's place, as for LeRobot's metaworld_mt50
HOLD = 4  # steps of the environment, 0.0125 s each, for which a command is held
SPEED = 0.4  # fastest step of the experts
TASKS = {
    "button-press-topdown-v3": "press the button from above",
    "door-open-v3": "open the door",
    "drawer-open-v3": "open the drawer",
    "pick-place-v3": "pick up the puck and hold it at the goal",
    "push-v3": "push the puck to the goal",
    "window-open-v3": "slide the window open",
}


class Sawyer:
    """The environments; commands are steps of the hand in x, y, z, and the gripper's (1 closes it)."""

    robot = "sawyer"
    low, high = -np.ones(4), np.ones(4)
    noise, centre, spread = np.array([0.25, 0.25, 0.25, 0.0]), np.zeros(4), np.array([0.4, 0.4, 0.3, 1.0])
    least, steps, rest = 40, 110, 8  # frames

    def __init__(self) -> None:
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS
        from metaworld.policies import ENV_POLICY_MAP

        warnings.filterwarnings("ignore", "Constant.s. may be too high")  # of the experts, which are clipped
        self._all = []
        for name in TASKS:
            env = ALL_V3_ENVIRONMENTS[name](
                render_mode="rgb_array", width=SIZE, height=SIZE, camera_name="corner2"
            )
            env._partially_observable, env._set_task_called = False, True  # the experts need to see the goal
            del env.sawyer_observation_space  # which is kept, without the goal
            env.model.camera("corner2").pos = NEARER
            env.model.vis.quality.shadowsize = SHADOWS
            env.seeded_rand_vec, env._freeze_rand_vec = True, False
            self._all.append((env, ENV_POLICY_MAP[name]()))

    def reset(self, seed):
        which = seed % len(TASKS)
        self._env, self._policy = self._all[which]
        self._env.seed(seed)
        self._seen, _ = self._env.reset()
        return list(TASKS.values())[which]

    def observe(self):
        if viewer := self._env.mujoco_renderer.viewer:
            viewer.make_context_current()  # else it draws the things of the environment that drew last
        return self._env.render(), self._seen[:4], np.concatenate([self._seen[4:18], self._seen[36:]])

    def expert(self):
        command = self._policy.get_action(self._seen).astype(np.float64)
        command[:3] *= SPEED / max(SPEED, abs(command[:3]).max())
        return command

    def step(self, command):
        for _ in range(HOLD):
            self._seen, *_, facts = self._env.step(command)
        return bool(facts["success"])


if __name__ == "__main__":
    run_script(lambda: recorder.main(Sawyer, __doc__))
