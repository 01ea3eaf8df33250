"""The lattice that a pusher's tip stands on: every step leads from one place of it to the next, so none is partial."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

Place = tuple[int, int]  # along the world's x and y


@dataclass(frozen=True, kw_only=True)
class Lattice:
    """Places above a table, and how actions lead from one to another.

    Attributes:
        places: How many there are along x and y.
        origin: Where place (0, 0) is [m].
        step: From one place to the next [m].
        moves: What each action adds to a place.
    """

    places: tuple[int, int]
    origin: tuple[float, float]
    step: float
    moves: tuple[Place, ...]

    def at(self, place: Place) -> tuple[float, float]:
        """A place in the world [m]."""
        return self.origin[0] + self.step * place[0], self.origin[1] + self.step * place[1]

    def after(self, place: Place, action: int) -> Place:
        """Where an action leads, on the lattice or off it."""
        return place[0] + self.moves[action][0], place[1] + self.moves[action][1]

    def legal(self, place: Place) -> Bool[np.ndarray, " a"]:
        """Which actions stay on the lattice."""
        reached = [self.after(place, action) for action in range(len(self.moves))]
        return np.array([0 <= x < self.places[0] and 0 <= y < self.places[1] for x, y in reached])


@dataclass(frozen=True, kw_only=True)
class TableTop:
    """Where things can stand.

    Attributes:
        size: Along x and y [m].
        center: [m].
        edge_gap: From the edge to anything, at an episode's start [m].
        gap: Between any two things, at an episode's start [m].
    """

    size: tuple[float, float]
    center: tuple[float, float]
    edge_gap: float
    gap: float

    def scatter(
        self, radii: Sequence[float], *, pusher: float, lattice: Lattice, generator: np.random.Generator
    ) -> tuple[Float[np.ndarray, "k 2"], Place]:
        """Spots [m] for round things of these radii and a place for the pusher, of radius ``pusher``."""
        half = np.asarray(self.size) / 2
        while True:
            spots = np.full((len(radii), 2), np.inf)
            for index, radius in enumerate(radii):
                free = half - radius - self.edge_gap
                for _ in range(50):
                    spot = np.asarray(self.center) + generator.uniform(-free, free)
                    apart = np.hypot(*(spots[:index] - spot).T) - np.asarray(radii[:index])
                    if (apart > radius + self.gap).all():
                        spots[index] = spot
                        break
            place = (int(generator.integers(lattice.places[0])), int(generator.integers(lattice.places[1])))
            apart = np.hypot(*(spots - np.asarray(lattice.at(place))).T) - np.asarray(radii)
            if np.isfinite(spots).all() and (apart > pusher + self.gap).all():
                return spots, place
