# /// script
# requires-python = ">=3.12"
# dependencies = ["hma-toolkit", "gym-aloha==0.1.5"]
#
# [tool.uv]
# override-dependencies = ["opencv-python ; sys_platform == 'never'"]  # it overwrites the headless OpenCV
#
# [tool.uv.sources]
# hma-toolkit = {path = "../..", editable = true}
# ///
"""Record gym-aloha's AlohaTransferCube to a LeRobotDataset: one arm hands a cube to the other, at 50 Hz.

    uv run recipes/lab/aloha_sim.py build/lab --episodes 40
    hma convert build/lab/aloha_sim -e aloha_sim --out build/lab/shards/aloha_sim

The physics, the look and the success are the environment's, but its shadows are coarser, which halves the
time of a picture. Commands are joint positions. The expert plans them when an episode begins: both hands
follow lines, and inverse kinematics give the joints.
"""

import numpy as np
import recorder

from hma_data.console import run_script

SIZE, SHADOWS = 128, 1024  # pixels: the side of the pictures, and of the map of shadows
SIDES = ("left", "right")
PINCH = np.array([0.135, 0.0, 0.0])  # between the fingers, in metres from the hand's origin
MEET = np.array([0.0, 0.5, 0.25])  # where the cube is handed over
START = (0.183, 0.5, 0.31, 0.1, 0.0, 0.0)  # of the right hand: x, y, z, pitch, roll, gripper


class Aloha:
    """The environment; commands are gym-aloha's: six joints and the gripper of each arm, left first."""

    robot = "aloha_sim"
    low = np.tile([-3.14, -1.85, -1.76, -3.14, -1.87, -3.14, 0.0], 2)
    high = np.tile([3.14, 1.25, 1.6, 3.14, 2.23, 3.14, 1.0], 2)
    noise = np.tile([0.05, 0.04, 0.04, 0.08, 0.06, 0.08, 0.0], 2)
    centre = np.tile([0.0, -0.96, 1.16, 0.0, -0.3, 0.0, 0.5], 2)
    spread = np.tile([0.25, 0.25, 0.25, 0.3, 0.3, 0.4, 0.5], 2)
    least, steps, rest = 100, 220, 40  # frames

    def __init__(self) -> None:
        from gym_aloha.env import AlohaEnv

        aloha = AlohaEnv("transfer_cube")
        self._aloha, self._env = aloha, aloha._env
        self._task, self._physics = self._env.task, self._env.physics
        self._physics.model.vis.quality.shadowsize = SHADOWS
        self._task.get_observation = lambda physics: {
            "images": {"top": np.zeros(1)}
        }  # it draws three large pictures

    def reset(self, seed):
        self._aloha.reset(seed=seed)
        self._plan = iter(self._commands(self._physics.data.qpos[16:19].copy()))
        return "hand the red cube from the right arm to the left arm"

    def observe(self):
        picture = self._physics.render(height=SIZE, width=SIZE, camera_id="top")
        return picture, self._task.get_qpos(self._physics), self._physics.data.qpos[16:].copy()

    def expert(self):
        return next(self._plan)

    def step(self, command):
        _, _, success, _, _ = self._aloha.step(command)
        return bool(success)

    def _commands(self, cube):
        """Return the commands (T, 14) of an episode in which the cube lies at (3,)."""
        x, y = cube[:2]
        right = (  # frame, then as START; the pitch is downward
            (0, *START), (40, x, y, 0.1, 1.05, 0.0, 1.0), (65, x, y, 0.02, 1.05, 0.0, 1.0),
            (80, x, y, 0.02, 1.05, 0.0, 0.0), (120, *MEET, 1.05, 0.0, 0.0), (160, *MEET, 1.05, 0.0, 0.0),
            (172, *MEET, 1.05, 0.0, 1.0), (195, 0.12, 0.5, 0.27, 1.05, 0.0, 1.0),
        )  # fmt: skip
        aside = MEET - (0.12, 0.0, 0.0)
        left = (
            (0, -START[0], *START[1:]), (80, *aside, 0.0, 1.57, 1.0), (120, *aside, 0.0, 1.57, 1.0),
            (142, *MEET, 0.0, 1.57, 1.0), (155, *MEET, 0.0, 1.57, 0.0), (175, *MEET, 0.0, 1.57, 0.0),
            (210, *aside, 0.0, 1.57, 0.0),
        )  # fmt: skip
        physics = self._physics.copy(share_model=True)
        hands = [np.array(points).T for points in (left, right)]
        commands = []
        for frame in range(self.steps):
            wanted = [
                np.array([np.interp(frame, times, values) for values in rest]) for times, *rest in hands
            ]
            arms = [_joints(physics, side, pose) for side, pose in enumerate(wanted)]
            commands.append(np.concatenate([[*arm, pose[5]] for arm, pose in zip(arms, wanted, strict=True)]))
        return commands


def _joints(physics, side, pose):
    """Move one arm of a simulator so that it pinches at a pose, and return its joints (6,)."""
    import mujoco

    model, data = physics.model.ptr, physics.data.ptr
    hand, own = model.body(f"vx300s_{SIDES[side]}/gripper_link").id, slice(8 * side, 8 * side + 6)
    wanted = _turn(2, np.pi * side) @ _turn(1, pose[3]) @ _turn(0, pose[4])
    along, about = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    for _ in range(12):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        turned = data.xmat[hand].reshape(3, 3)
        point = data.xpos[hand] + turned @ PINCH
        mujoco.mj_jac(model, data, along, about, point, hand)
        error = np.append(pose[:3] - point, sum(np.cross(turned[:, i], wanted[:, i]) for i in range(3)) / 2)
        jacobian = np.concatenate([along[:, own], about[:, own]])
        data.qpos[own] += jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-4 * np.eye(6), error)
        low, high = model.jnt_range[own].T
        data.qpos[own] = np.clip(data.qpos[own], low, high)
    return data.qpos[own].copy()


def _turn(axis, angle):
    """Return the matrix (3, 3) of a rotation about an axis."""
    matrix, (i, j) = np.eye(3), ((1, 2), (2, 0), (0, 1))[axis]
    matrix[[i, i, j, j], [i, j, i, j]] = np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)
    return matrix


if __name__ == "__main__":
    run_script(lambda: recorder.main(Aloha, __doc__))
