"""Simulate the Push-T table: a disc on a spring pushes a T; physics by pymunk, frames by pygame.

This is the environment of gym-pusht 0.1.8 (Apache-2.0; after Diffusion Policy, MIT, Columbia Artificial
Intelligence and Robotics Lab, and pymunk's drawing, MIT, Victor Blomqvist). It is written anew because that
package asks for a build of OpenCV that overwrites the headless one. States and frames are the same bits.

Lengths are pixels of the 512 × 512 table with y downward, angles radians, times seconds.
"""

from typing import Any

import numpy as np

from hma_data.arrays import Floats, Images
from hma_data.lab import imported

SIDE = 512
TICK_S = 0.01  # step of the physics
GOAL = (256.0, 256.0, np.pi / 4)  # x, y, angle of the T
K_P, K_V = 100, 20  # the spring that pulls the disc, and its damper
SCALE = 30
BAR = [(-2 * SCALE, SCALE), (2 * SCALE, SCALE), (2 * SCALE, 0), (-2 * SCALE, 0)]
STEM = [(-SCALE / 2, SCALE), (-SCALE / 2, 4 * SCALE), (SCALE / 2, 4 * SCALE), (SCALE / 2, SCALE)]


class TeeTable:
    """The table at a state (5,): the disc's x, y and the T's x, y, angle.

    Raises:
        MissingDependencyError: pymunk or pygame is not installed.
    """

    def __init__(self, state: Floats) -> None:
        with imported("pymunk and pygame"):
            import pygame
            import pymunk
        self._game: Any = pygame
        self._munk: Any = pymunk
        self.reset(state)

    def reset(self, state: Floats) -> None:
        """Set the table anew, at a state (5,)."""
        munk, color = self._munk, self._game.Color
        self._space = munk.Space()
        self._space.damping = 0.0
        corners = [(5, 506), (5, 5), (506, 5), (506, 506)]
        for start, stop in ((0, 1), (1, 2), (2, 3), (0, 3)):
            wall = munk.Segment(self._space.static_body, corners[start], corners[stop], 2)
            wall.color = color("LightGray")
            self._space.add(wall)
        self.agent = munk.Body(body_type=munk.Body.KINEMATIC)
        disc = munk.Circle(self.agent, 15)
        disc.color = color("RoyalBlue")
        self._space.add(self.agent, disc)
        self.block = munk.Body(1, 2 * munk.moment_for_poly(1, vertices=BAR))
        self.bars = [munk.Poly(self.block, corners) for corners in (BAR, STEM)]
        for bar in self.bars:
            bar.color = color("LightSlateGray")
        self.block.center_of_gravity = (self.bars[0].center_of_gravity + self.bars[1].center_of_gravity) / 2
        self._space.add(self.block, *self.bars)
        self.agent.position = (float(state[0]), float(state[1]))
        self.block.position = (float(state[2]), float(state[3]))  # before the angle, which moves it
        self.block.angle = float(state[4])
        self._space.step(TICK_S)

    def advance(self, target: Floats, ticks: int) -> None:
        """Run the physics for `ticks` while the spring pulls the disc to `target` (2,)."""
        for _ in range(ticks):
            pull = K_P * (target - np.array(self.agent.position)) - K_V * np.array(self.agent.velocity)
            x, y = np.array(self.agent.velocity) + pull * TICK_S
            self.agent.velocity = (float(x), float(y))
            self._space.step(TICK_S)

    def paint(self, color: str) -> None:
        """Give the T a colour, by its name."""
        for bar in self.bars:
            bar.color = self._game.Color(color)

    def raise_disc(self, up: bool, color: str) -> None:
        """Raise the disc over the T, or lower it, and give it a colour, by its name."""
        (disc,) = self.agent.shapes
        disc.sensor, disc.color = up, self._game.Color(color)

    def coverage(self) -> float:
        """Return the share of the goal that the T covers."""
        goal, here = self._outlines(self._goal()), self._outlines(self.block)
        covered = sum(_area(_clip(bar, edge)) for bar in here for edge in goal)
        return covered / sum(_area(bar) for bar in goal)

    def _goal(self) -> Any:
        body = self._munk.Body(1, 1)
        body.position, body.angle = GOAL[:2], GOAL[2]
        return body

    def _outlines(self, body: Any) -> list[Floats]:
        return [np.array([body.local_to_world(v) for v in bar.get_vertices()]) for bar in self.bars]

    def picture(self, size: int) -> Images:
        """Draw the goal, the T and the disc; (size, size, 3) RGB."""
        import cv2

        game = self._game
        screen = game.Surface((SIDE, SIDE))
        screen.fill((255, 255, 255))
        for outline in self._outlines(self._goal()):
            points = [(round(x), round(y)) for x, y in outline]
            game.draw.polygon(screen, game.Color("LightGreen"), points)
        self._space.debug_draw(_pencil(screen))
        pixels = np.frombuffer(game.image.tobytes(screen, "RGB"), np.uint8).reshape(SIDE, SIDE, 3)
        small: Images = cv2.resize(pixels, (size, size))
        return small


def _area(polygon: Floats) -> float:
    x, y = polygon.T
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2)


def _clip(polygon: Floats, convex: Floats) -> Floats:
    """Return the part of a convex polygon (N, 2) that is inside another (M, 2), by Sutherland and Hodgman."""
    middle = convex.mean(axis=0)
    for start, stop in zip(convex, np.roll(convex, -1, axis=0), strict=True):
        inward = np.array([start[1] - stop[1], stop[0] - start[0]])
        inward *= np.sign(inward @ (middle - start))
        kept: list[Floats] = []
        for here, there in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
            at, to = inward @ (here - start), inward @ (there - start)
            if at >= 0:
                kept.append(here)
            if at * to < 0:
                kept.append(here + (there - here) * (at / (at - to)))
        polygon = np.array(kept).reshape(-1, 2)
    return polygon


def _pencil(screen: Any) -> Any:
    """Return what draws a space of pymunk on a surface, in flat colours with a dark outline."""
    from pymunk import pygame_util

    game: Any = pygame_util.pygame

    class Pencil(pygame_util.DrawOptions):
        def draw_circle(self, pos: Any, angle: float, radius: float, outline: Any, fill: Any) -> None:
            game.draw.circle(screen, fill.as_int(), _rounded(pos), round(radius))
            game.draw.circle(screen, _light(fill), _rounded(pos), round(radius - 4))

        def draw_polygon(self, verts: Any, radius: float, outline: Any, fill: Any) -> None:
            game.draw.polygon(screen, _light(fill), [_rounded(corner) for corner in verts])
            for here, there in zip(verts, [*verts[1:], verts[0]], strict=True):
                self.draw_fat_segment(here, there, 2, fill, fill)

    return Pencil(screen)


def _rounded(place: Any) -> tuple[int, int]:
    return round(place[0]), round(place[1])


def _light(color: Any) -> tuple[int, ...]:
    return tuple(round(min(1.2 * value, 255.0)) for value in color)
