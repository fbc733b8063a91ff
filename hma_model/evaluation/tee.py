"""Find the T of a pusher in pictures by its colour and its shape.

A network of a few thousand weights reads the place of a disc to a pixel and that of a T to five, because it
does not see how the T lies. So the pixels of the T's colour are taken, and the pose of the T is looked for
that holds them: the best of all angles around their middle, then ever smaller steps.

N pictures of S pixels a side, n pixels. A pose is (3,) x, y, angle; places are px of a picture of 128 by 128.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hma_data.lab import pusht, truth
from hma_data.lab.pusher import Tee, rotation

Floats = NDArray[np.float64]

ANGLES = 48  # that are tried
FARTHEST_PX = 20.0  # px of the arena; a pixel farther out of the T counts as that far
FIRST_STEP, LAST_STEP = 8.0, 0.4  # px of the arena, of the search
TURN_RADIUS = 50.0  # px of the arena by which an angle is as long as a step
LEAST_AREA = 0.3  # share of the T's area; of fewer pixels no pose is found


@dataclass(frozen=True)
class TeeFinder:
    """The T of a pusher.

    Attributes:
        shape: of the T.
    """

    shape: Tee

    @classmethod
    def of(cls, robot: str) -> "TeeFinder | None":
        """Return the finder of a robot's T; None for a robot without one."""
        return cls(pusht.tee()) if robot in truth.PUSHERS else None

    def within(self, parts: Floats) -> Floats:
        """Return parts (N, P, 2) with the middles of the T's bars instead of the last two, its places."""
        found = parts.copy()
        for row, places in enumerate(parts[:, -2:]):
            pose = pusht.tee_pose(places)
            middles = self.shape.boxes.mean(axis=1) @ rotation(pose[2]).T + pose[:2]
            found[row, -2:] = pusht.PX * middles
        return found

    def find(self, pixels: NDArray[np.bool_]) -> Floats | None:
        """Return the places (2, 2) of the T that has the pixels (S, S); None if they are too few."""
        side = len(pixels)
        size = truth.SIZE / pusht.PX / side  # px of the arena
        y, x = np.nonzero(pixels)
        boxes = self.shape.boxes
        areas = (boxes[:, 1] - boxes[:, 0]).prod(axis=1)
        if len(x) * size**2 < LEAST_AREA * areas.sum():
            return None
        points = (np.stack([x, y], axis=1).astype(np.float64) + 0.5) * size
        middle = (boxes.mean(axis=1) * areas[:, None]).sum(axis=0) / areas.sum()
        angles = np.arange(ANGLES) * (2 * np.pi / ANGLES)
        starts = np.array([[*(points.mean(axis=0) - rotation(a) @ middle), a] for a in angles])
        pose = starts[self._outside(points, starts).argmin()]
        return pusht.tee_places(self._nearer(points, pose))

    def _nearer(self, points: Floats, pose: Floats) -> Floats:
        """Return the best pose near another."""
        step, best = FIRST_STEP, float(self._outside(points, pose[None])[0])
        ways = np.concatenate([np.eye(3), -np.eye(3)]) * (1, 1, 1 / TURN_RADIUS)
        while step > LAST_STEP:
            tried = pose + step * ways
            found = self._outside(points, tried)
            if found.min() < best:
                pose, best = tried[found.argmin()], float(found.min())
            else:
                step /= 2
        return pose

    def _outside(self, points: Floats, poses: Floats) -> Floats:
        """Return (M,), how far points (n, 2) lie outside the T at each of M poses, in the mean."""
        cos, sin = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
        x, y = points[:, 0] - poses[:, :1], points[:, 1] - poses[:, 1:2]
        local = np.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)
        far: Floats = np.clip(self.shape.distance(local), 0, FARTHEST_PX).mean(axis=1)
        return far
