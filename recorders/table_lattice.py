"""The lattice that a pusher's tip stands on: every step leads from one place of it to the next, so none is partial.

With continuous actions the tip goes anywhere between the lattice's outer places; a place then has fractions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

Place = tuple[float, float]
"""Along the world's x and y, in steps from the lattice's origin; whole numbers on the lattice."""
NEAR = 1e-9  # steps: as good as there
KEPT_PLACES = 256  # for which a picture of the pusher is kept: more than a lattice has


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
    moves: tuple[tuple[int, int], ...]

    def at(self, place: Place) -> tuple[float, float]:
        """A place in the world [m]."""
        return self.origin[0] + self.step * place[0], self.origin[1] + self.step * place[1]

    def nearest(self, point: Float[np.ndarray, "2"]) -> tuple[int, int]:
        """The place that is nearest to a point of the world [m]."""
        x, y = np.rint((point - np.asarray(self.origin)) / self.step).astype(int).tolist()
        return x, y

    def after(self, place: Place, action: int) -> Place:
        """Where an action leads, on the lattice or off it."""
        return place[0] + self.moves[action][0], place[1] + self.moves[action][1]

    def legal(self, place: Place) -> Bool[np.ndarray, " a"]:
        """Which actions stay on the lattice, or between its outer places."""
        width, height = self.places
        reached = [self.after(place, action) for action in range(len(self.moves))]
        return np.array([0 <= x <= width - 1 and 0 <= y <= height - 1 for x, y in reached])

    def moved(self, place: Place, by: tuple[float, float]) -> tuple[Place, bool]:
        """Where a displacement leads [m], at most to the outer places; and whether it would have led farther."""
        free = [one + length / self.step for one, length in zip(place, by, strict=True)]
        kept = [min(max(one, 0.0), count - 1.0) for one, count in zip(free, self.places, strict=True)]
        return (kept[0], kept[1]), any(abs(one - two) > NEAR for one, two in zip(free, kept, strict=True))

    def room(self, place: Place) -> Float[np.ndarray, "2 2"]:
        """The least and the greatest displacement [m] along x and y that stays between the outer places."""
        here = np.asarray(place, np.float64)
        room: Float[np.ndarray, "2 2"] = self.step * np.stack([-here, np.asarray(self.places) - 1.0 - here])
        return room


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
        while True:
            spots = list[tuple[float, float]]()
            for radius in radii:
                free = [length / 2 - radius - self.edge_gap for length in self.size]
                for _ in range(50):
                    there = zip(self.center, free, generator.random(2).tolist(), strict=True)
                    x, y = (middle + (2 * reach * number - reach) for middle, reach, number in there)
                    if self._is_clear((x, y), radius, spots, radii):
                        spots.append((x, y))
                        break
                else:
                    spots.append((math.inf, math.inf))
            place = (int(generator.integers(lattice.places[0])), int(generator.integers(lattice.places[1])))
            if (math.inf, math.inf) not in spots and self._is_clear(lattice.at(place), pusher, spots, radii):
                return np.array(spots).reshape(-1, 2), place

    def _is_clear(
        self, spot: tuple[float, float], radius: float, spots: Sequence[tuple[float, float]], radii: Sequence[float]
    ) -> bool:
        """Whether a round thing there has its gap from what already stands."""
        x, y = spot
        reach = radius + self.gap
        return all(math.hypot(u - x, v - y) - other > reach for (u, v), other in zip(spots, radii, strict=False))
