"""Grid World's rules are the paper's: a move pushes the whole chain, and what goes over the edge is gone."""

from __future__ import annotations

import numpy as np

from recorders.grid_rules import advance

UP, DOWN, LEFT, RIGHT = range(4)


def moved(cells: list[tuple[int, int]], action: int) -> list[tuple[int, int] | None]:
    """Where agent and objects are after an action; None for one that is gone."""
    padded = np.array(cells + [(-9, -9)] * (5 - len(cells)))
    there = np.arange(5) < len(cells)
    after, left = advance(padded[None], there[None], np.array([action]))
    return [(int(x), int(y)) if here else None for (x, y), here in zip(after[0], left[0], strict=True)][: len(cells)]


def test_a_move_into_nothing_moves_the_agent_alone() -> None:
    assert moved([(2, 2), (2, 4)], RIGHT) == [(3, 2), (2, 4)]
    assert moved([(2, 2), (2, 4)], UP) == [(2, 1), (2, 4)]
    assert moved([(2, 2), (2, 4)], DOWN) == [(2, 3), (2, 4)]  # the object is not adjacent
    assert moved([(2, 2), (0, 2)], LEFT) == [(1, 2), (0, 2)]


def test_the_whole_chain_before_the_agent_is_pushed() -> None:
    assert moved([(0, 1), (1, 1), (2, 1), (4, 1)], RIGHT) == [(1, 1), (2, 1), (3, 1), (4, 1)]
    assert moved([(0, 1), (2, 1), (1, 1)], RIGHT) == [(1, 1), (3, 1), (2, 1)]  # in whatever order they are listed


def test_an_object_pushed_over_the_edge_is_gone() -> None:
    assert moved([(2, 3), (2, 4)], DOWN) == [(2, 4), None]
    assert moved([(1, 0), (2, 0), (3, 0), (4, 0)], RIGHT) == [(2, 0), (3, 0), (4, 0), None]


def test_what_is_gone_is_in_nobodys_way() -> None:
    cells = np.array([[(1, 0), (2, 0), (3, 0), (9, 9), (9, 9)]])
    there = np.array([[True, False, True, False, False]])
    after, left = advance(cells, there, np.array([RIGHT]))
    assert after[0, 2].tolist() == [3, 0]
    assert left.tolist() == there.tolist()
