"""Simulate a robot of the family among its blocks.

A robot pushes its blocks without dynamics: a block is moved along the shortest way out of the part that
touches it, and stays inside the frame. A closed gripper, or a magnet that is on, carries a block.

Lengths are px. Q axes, A actions, B blocks, P parts that push.
"""

import zlib

import numpy as np

from hma_data.arrays import Bools, Float32s, Floats, Images
from hma_data.lab.family.bodies import GRIP, Body
from hma_data.lab.family.look import SIZE, block_shapes, draw, shrunk
from hma_data.lab.pusher import rotation

REACH = 8.0  # of a gripper, from its tip


class BlockTable:
    """A body at a pose (Q,) among its blocks (B, 2)."""

    def __init__(self, body: Body, pose: Floats, blocks: Floats) -> None:
        self.body, self.pose, self.blocks = body, pose.copy(), blocks.copy()
        self.held = -1  # the block that is carried
        self.grasp = np.zeros(2)  # its place from the tip, in the tip's direction and beside it
        self._radii = np.array([block.radius for block in body.blocks])
        self._push()

    @property
    def state(self) -> Floats:
        """Return (Q + 2·B + 1,): pose, blocks, and the number of the carried block or -1."""
        return np.concatenate([self.pose, self.blocks.ravel(), [self.held]])

    @property
    def joints(self) -> dict[str, Floats]:
        """Return the pose (Q,)."""
        return {"joint_pos": self.pose}

    @property
    def observed(self) -> Float32s:
        """Return the pose (Q,), as recorded."""
        return self.pose.astype(np.float32)

    @property
    def own(self) -> Floats:
        """Return the middles (P, 2) of the moving parts."""
        return self.body.own(self.pose)

    @property
    def loose(self) -> Floats:
        """Return the middles (B, 2) of the blocks."""
        return self.blocks

    def advance(self, action: Floats | Float32s) -> None:
        """Simulate one control step under an action (A,)."""
        before = self.body.holds(self.pose)
        self.pose = self.body.moved(self.pose, action.astype(np.float64))
        if self.body.grip:
            self._carry(before)
        self._push()

    def picture(self) -> Images:
        """Draw the table, the blocks and the body; (SIZE, SIZE, 3) RGB."""
        image = self.body.canvas.copy()
        for block, place in zip(self.body.blocks, self.blocks, strict=True):
            draw(image, block_shapes(block, place))
        draw(image, self.body.mechanism.shapes(self.pose))
        return shrunk(image)

    def _carry(self, before: bool) -> None:
        """Grasp, move along or release a block; fingers stop at it."""
        tip, angle = self.body.mechanism.tip(self.pose)
        turn = rotation(-angle)
        gripper = self.body.grip == "gripper"
        if not self.body.holds(self.pose):
            self.held = -1
            return
        if self.held < 0 and not (gripper and before):
            far = np.linalg.norm(self.blocks - tip, axis=1)
            if far.min() < REACH:
                self.held = int(far.argmin())
                self.grasp = turn @ (self.blocks[self.held] - tip) * (1.0, 0.0 if gripper else 1.0)
        if self.held >= 0:
            self.blocks[self.held] = tip + self.grasp @ turn
            if gripper:
                self.pose[-1] = max(self.pose[-1], min(GRIP - 0.01, (self._radii[self.held] - 0.9) / 8))

    def _push(self) -> None:
        """Move the blocks out of the parts, off each other and inside the walls."""
        parts = [part for part in self.body.mechanism.shapes(self.pose) if part.pushes]
        ends = np.array([_segment(part.points) for part in parts]).reshape(-1, 2, 2)
        radii = np.array([part.radius for part in parts])
        free = np.arange(len(self.blocks)) != self.held
        for _ in range(3):
            depth, way = _overlap(self.blocks, self._radii, ends, radii)
            depth[:, ~free] = 0
            worst, columns = depth.argmax(axis=0), np.arange(len(self.blocks))
            deepest = depth[worst, columns]
            self.blocks += way[worst, columns] * np.maximum(deepest, 0)[:, None]
            apart = self._separate(free)
            low, high = self._radii[:, None], SIZE - self._radii[:, None]
            self.blocks = np.clip(self.blocks, low, high)
            if deepest.max() <= 0 and not apart:
                break

    def _separate(self, free: Bools) -> bool:
        touched = False
        for one in range(len(self.blocks)):
            for other in range(one):
                gap = self.blocks[one] - self.blocks[other]
                far = float(np.hypot(*gap)) or 1e-6
                depth = self._radii[one] + self._radii[other] - far
                if depth > 0:
                    # Each of two free blocks gives way by the whole depth: recordings were made so.
                    self.blocks[one] += gap / far * depth * free[one]
                    self.blocks[other] -= gap / far * depth * free[other]
                    touched = True
        return touched


def _segment(points: Floats) -> Floats:
    """Return the (2, 2) ends of what pushes for a shape: a polygon's is its middle."""
    return points if len(points) == 2 else np.repeat(points.mean(axis=0)[None], 2, axis=0)


def _overlap(blocks: Floats, sizes: Floats, ends: Floats, radii: Floats) -> tuple[Floats, Floats]:
    """Return how deep each of P parts is in each block (P, B), and the way out (P, B, 2)."""
    if not len(ends):
        return np.zeros((1, len(blocks))), np.zeros((1, len(blocks), 2))
    start, along = ends[:, None, 0], ends[:, None, 1] - ends[:, None, 0]
    length = np.maximum((along**2).sum(axis=-1), 1e-9)
    share = np.clip(((blocks[None] - start) * along).sum(axis=-1) / length, 0, 1)
    gap = blocks[None] - start - share[..., None] * along
    far = np.linalg.norm(gap, axis=-1)
    way = np.where(far[..., None] > 1e-6, gap / np.maximum(far, 1e-6)[..., None], (1.0, 0.0))
    return radii[:, None] + sizes - far, way


def start(body: Body, seed: int, number: int) -> tuple[BlockTable, np.random.Generator]:
    """Return the world at the start of an episode, and the generator of its driver."""
    rng = np.random.default_rng((seed, zlib.crc32(body.name.encode()), number))
    low, high = body.limits
    pose = rng.uniform(low + 0.1 * (high - low), high - 0.1 * (high - low))
    if body.grip:
        pose[-1] = float(body.grip == "gripper")
    return BlockTable(body, pose, rng.uniform(18, SIZE - 18, (len(body.blocks), 2))), rng
