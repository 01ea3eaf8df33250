"""Distractors: grey discs that drift over the table, whatever the arm does."""

from __future__ import annotations

import numpy as np

from recorders.robot_push.renderer import Renderer, Sprite
from recorders.robot_push.scene import TABLE_CENTER, TABLE_SIZE
from recorders.robot_push.solids import prism

DISC_RADIUS, DISC_COLOR, DRIFT = 0.03, (0.5, 0.5, 0.5), 0.02  # [m], RGB 0-1, [m] a step


class DriftingDiscs:
    """So many discs that go straight on and turn back at the table's edges.

    They lie flat, hide nothing of the objects, and count as background.
    """

    def __init__(self, generator: np.random.Generator, count: int) -> None:
        self._starts = generator.uniform(0, 1, (3, 2))[:count]
        turns = generator.uniform(-np.pi, np.pi, 3)[:count]
        self._steps = DRIFT * np.stack([np.cos(turns), np.sin(turns)], axis=-1)

    def sprites(self, renderer: Renderer, time: int) -> list[Sprite | None]:
        """The discs after so many steps."""
        free = np.asarray(TABLE_SIZE) - 2 * DISC_RADIUS
        way = np.abs((self._starts * free + self._steps * time + free) % (2 * free) - free)  # to and fro
        spots = way - free / 2 + TABLE_CENTER
        disc = prism(24, DISC_RADIUS, 0.002)
        upright = np.array([0.0, 0.0, 0.0, 1.0])
        return [renderer.sprite(disc, np.array([x, y, 0.001]), upright, DISC_COLOR) for x, y in spots]
