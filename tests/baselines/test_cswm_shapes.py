"""C-SWM's 2D shapes: how objects move and are drawn, and figures that are known for states that are known."""

from __future__ import annotations

import json

import pytest
import torch

from baselines.published.cswm_shapes import (
    ACTIONS,
    CELL,
    OBJECTS,
    SIDE,
    ShapesModel,
    after,
    drawn,
    figures,
    main,
    recorded,
    shapes,
)

UP, DOWN, LEFT, RIGHT = range(4)


@pytest.mark.parametrize(
    ("object_", "way", "cell"),
    [(0, UP, 0), (0, LEFT, 0), (0, RIGHT, 0), (0, DOWN, 5), (1, RIGHT, 2), (2, DOWN, 24), (3, RIGHT, 14), (4, UP, 10)],
)
def test_an_object_moves_to_a_free_cell_of_the_grid_or_stays(object_, way, cell) -> None:
    board = torch.tensor([[0, 1, 24, 14, 15]])
    following = after(board, torch.tensor([4 * object_ + way]))
    assert following[0, object_] == cell
    others = torch.arange(OBJECTS) != object_
    assert torch.equal(following[0, others], board[0, others])


def test_objects_never_share_a_cell_and_move_one_at_a_time() -> None:
    data = recorded(200, 30, torch.Generator().manual_seed(0))
    assert data.cells.shape == (200, 31, OBJECTS)
    assert all(len(set(board)) == OBJECTS for board in data.cells.flatten(0, 1).tolist())
    moved = (data.cells[:, 1:] != data.cells[:, :-1]).sum(2)
    assert moved.unique().tolist() == [0, 1]
    assert data.actions.unique().tolist() == list(range(len(ACTIONS.names)))
    assert data.cells[:, 0].unique().tolist() == list(range(SIDE**2))


def test_each_object_is_drawn_in_its_cell() -> None:
    tiles = shapes()
    assert all(not torch.equal(one, other) for i, one in enumerate(tiles) for other in tiles[:i])
    picture = drawn(torch.tensor([[24, 7, 0, 3, 12]]), tiles)[0]
    seen = picture.unfold(1, CELL, CELL).unfold(2, CELL, CELL)  # colour, row, column, and the pixels of the cell
    for cell in range(SIDE**2):
        thing = {24: 1, 7: 2, 0: 3, 3: 4, 12: 5}.get(cell, 0)
        assert torch.equal(seen[:, cell // SIDE, cell % SIDE], tiles[thing])


def test_each_slot_is_told_what_is_done_to_its_own_object() -> None:
    told = ShapesModel().transition.told(torch.tensor([4 * 2 + LEFT, 4 * 0 + DOWN]), OBJECTS)
    wanted = torch.zeros(2, OBJECTS, 4)
    wanted[0, 2, LEFT] = wanted[1, 0, DOWN] = 1
    assert torch.equal(told, wanted)


class _Known(ShapesModel):
    """Knows the boards by their pictures, and how they go on; or takes every action for the first one."""

    def __init__(self, knows: bool) -> None:
        super().__init__()
        self.knows, self.tiles = knows, shapes()

    def states(self, before, now):
        things = now.unfold(2, CELL, CELL).unfold(3, CELL, CELL).flatten(2, 3).transpose(1, 2)
        same = (things[:, None] == self.tiles[None, 1:, None]).all(-1).all(-1).all(-1)
        return same.float().argmax(2).float()[:, :, None]

    def advance(self, state, action):
        (cells,) = state
        board = after(cells[:, :, 0].long(), action if self.knows else torch.zeros_like(action))
        return (board.float()[:, :, None],)

    def frame(self, state):
        return drawn(state[0][:, :, 0].long(), self.tiles)


@pytest.mark.slow
def test_figures_are_perfect_for_a_model_that_knows_the_rules_and_not_for_another() -> None:
    data = recorded(300, 10, torch.Generator().manual_seed(1))
    known, other = figures(_Known(True), data), figures(_Known(False), data)
    assert known.ranked == dict.fromkeys((1, 5, 10), (1.0, 1.0))
    assert known.error == 0
    assert 0 < known.copying == other.copying
    assert other.ranked[10][0] < other.ranked[5][0] < other.ranked[1][0] < 0.8
    assert other.ranked[10][0] < 0.2
    assert other.error > 0


@pytest.mark.slow
def test_one_command_trains_and_prints_the_paper_beside_it(capsys) -> None:
    short = ["--passes", "1", "--episodes", "3", "--asked", "20", "--decoder-steps", "2"]
    main(short)
    printed = capsys.readouterr().out
    assert printed.splitlines()[2].startswith("| seed 0 |")
    assert "99.9" in printed.splitlines()[3]
    main([*short, "--json"])
    (found,) = json.loads(capsys.readouterr().out)
    assert set(found) == {"ranked", "error", "copying"}
    for wrong in (["--seeds", "0"], ["--episodes", "2"]):
        with pytest.raises(SystemExit):
            main(wrong)
