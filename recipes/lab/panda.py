# /// script
# requires-python = ">=3.12"
# dependencies = ["hma-toolkit", "robosuite==1.5.2", "mujoco==3.3.2"]
#
# [tool.uv]
# override-dependencies = [  # what recording does not need, and what would overwrite the headless OpenCV
#     "torch ; sys_platform == 'never'",
#     "lerobot ; sys_platform == 'never'",
#     "opencv-python ; sys_platform == 'never'",
#     "pynput ; sys_platform == 'never'",  # of robosuite's keyboards; it needs a compiler on Linux
#     "numpy>=2",  # robosuite's inverse kinematics, which is not used here, ask for less
# ]
#
# [tool.uv.sources]
# hma-toolkit = {path = "../..", editable = true}
# ///
"""Record robosuite's Lift and Stack to RLDS: a Panda lifts a cube or stacks it on another one, at 20 Hz.

    uv run recipes/lab/panda.py build/lab --episodes 40
    hma convert build/lab/panda -e panda --out build/lab/shards/panda

The physics, the look and the success are robosuite's, and so is the controller OSC_POSE, which moves the hand
by steps. The tasks take turns.
"""

import logging

import numpy as np
import recorder

from hma_data.console import run_script

SIZE = 128  # pixels: the side of the pictures
TASKS = {"Lift": "lift the red cube", "Stack": "stack the red cube on the green one"}
REACH, TURN = 12.0, 1.5  # commands for each metre and radian to go; 1 moves the hand by 0.05 m or 0.5 rad
UP = np.array([0.0, 0.0, 1.0])
CLOSING = 6  # frames in which the fingers close or open


class Panda:
    """The two environments; commands are steps of the hand in x, y, z and about them, and the gripper's."""

    robot = "panda"
    low, high = -np.ones(7), np.ones(7)
    noise = np.array([0.3, 0.3, 0.3, 0.1, 0.1, 0.1, 0.0])
    centre, spread = np.zeros(7), np.array([0.5, 0.5, 0.4, 0.15, 0.15, 0.3, 1.0])
    least, steps, rest = 40, 120, 8  # frames

    def __init__(self) -> None:
        import robosuite

        logging.getLogger("robosuite_logs").setLevel(logging.ERROR)
        self._envs = [
            robosuite.make(
                name,
                robots="Panda",
                control_freq=20,
                has_renderer=False,
                has_offscreen_renderer=True,
                use_camera_obs=False,
                ignore_done=True,
            )
            for name in TASKS
        ]

    def reset(self, seed):
        which = seed % len(TASKS)
        self._env = self._envs[which]
        self._env.rng = self._env.placement_initializer.rng = np.random.default_rng(seed)
        self._seen = self._env.reset()
        self._stage, self._waited = 0, 0
        return list(TASKS.values())[which]

    def observe(self):
        seen = self._seen
        state = np.concatenate(
            [seen["robot0_joint_pos"], seen["robot0_gripper_qpos"], seen["robot0_eef_pos"]]
        )
        cubes = [self._cube("cubeA" if "cubeA_pos" in seen else "cube"), self._cube("cubeB")]
        simulation = self._env.sim
        simulation._render_context_offscreen.gl_ctx.make_current()  # the other task may have drawn last
        picture = simulation.render(SIZE, SIZE, camera_name="agentview")
        return picture[::-1], state, np.concatenate(cubes)

    def _cube(self, name):
        """Return the place and turn (7,) of a cube; zeros where the task has none."""
        return np.concatenate(
            [self._seen.get(f"{name}_pos", np.zeros(3)), self._seen.get(f"{name}_quat", np.zeros(4))]
        )

    def expert(self):
        hand, quat = self._seen["robot0_eef_pos"], self._seen["robot0_eef_quat"]
        cube = self._cube("cubeA" if "cubeA_pos" in self._seen else "cube")
        other = self._cube("cubeB")[:3]
        over = other + UP * 0.1 if other.any() else np.append(cube[:2], 0.95)
        stages = [  # target, whether the fingers are closed, tolerance in metres
            (cube[:3] + UP * 0.07, False, 0.02),
            (cube[:3] - UP * 0.005, False, 0.012),
            (cube[:3] - UP * 0.005, True, None),
            (np.append(hand[:2], 0.98), True, 0.03),
            (over, True, 0.015),
            (other + UP * 0.05, True, 0.01),
            (other + UP * 0.05, False, None),
            (over + UP * 0.05, False, 0.0),
        ]
        target, closed, near = stages[self._stage]
        self._waited += 1
        arrived = self._waited > CLOSING if near is None else np.linalg.norm(target - hand) < near
        if arrived and not (self._stage == 4 and not other.any()):
            self._stage, self._waited = self._stage + 1, 0
        turn = _yaw(cube[3:]) - _yaw(quat) if self._stage < 2 else 0.0
        turn = (turn + np.pi / 4) % (np.pi / 2) - np.pi / 4  # a cube looks the same after a quarter of a turn
        return np.array([*REACH * (target - hand), 0.0, 0.0, TURN * turn, 1.0 if closed else -1.0])

    def step(self, command):
        self._seen, *_ = self._env.step(command)
        return bool(self._env._check_success())


def _yaw(quat):
    """Return the angle about the vertical of a rotation given as x, y, z, w."""
    x, y, z, w = quat
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


if __name__ == "__main__":
    run_script(lambda: recorder.main(Panda, __doc__))
