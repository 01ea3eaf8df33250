"""Two-Room: how the dot moves and is drawn, which tasks are asked, and that plans of a model that knows it succeed."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from baselines.published import lewm_two_room
from baselines.published.lewm_two_room import (
    AWAY,
    BLOCK,
    BORDER,
    BUDGET,
    DOOR,
    FRAME,
    PLANNER,
    RADIUS,
    REACHED,
    SIDE,
    SPEED,
    WALL,
    Episodes,
    Tasks,
    TwoRoomModel,
    after,
    at_random,
    drawn,
    idle,
    main,
    place_correlation,
    planned,
    recorded,
    rooms,
    row,
    scripted,
    solved,
    tasks_of,
    towards,
)


@pytest.fixture(scope="module")
def data() -> Episodes:
    return recorded(300, torch.Generator().manual_seed(0))


@pytest.mark.parametrize(
    ("place", "action", "following"),
    [
        ((60, 100), (1, -0.5), (65, 97.5)),
        ((60, 100), (3, 0), (65, 100)),  # actions are clipped
        ((22, 100), (-1, 0), (21, 100)),  # the border, as far from it as the dot is wide
        ((200, 201), (1, 1), (203, 203)),
        ((98, 100), (1, 0), (99.5, 100)),  # the wall throws the dot back a little
        ((126, 100), (-1, 1), (124.5, 105)),
        ((98, 50), (1, 0), (103, 50)),  # the door
        ((98, 64.75), (1, 0), (103, 64.75)),
        ((98, 65), (1, 0), (99.5, 65)),
        ((112, 62), (0, 1), (124.5, 67)),  # within the wall, out of the door: back to its own side
        ((111, 62), (0, 1), (99.5, 67)),
    ],
)
def test_the_dot_moves_and_is_stopped_by_borders_and_by_the_wall_but_not_in_the_door(place, action, following) -> None:
    moved = after(torch.tensor([place], dtype=torch.float32), torch.tensor([action], dtype=torch.float32))
    assert moved[0].tolist() == pytest.approx(following)


def test_the_script_goes_by_the_door_to_goals_in_the_other_room() -> None:
    place = torch.tensor([[60.0, 149.0], [60.0, 149.0], [112.0, 45.0], [150.0, 49.0]])
    goal = torch.tensor([[60.0, 100.0], [200.0, 149.0], [20.0, 45.0], [60.0, 49.0]])
    wanted = torch.nn.functional.normalize(torch.tensor([[0.0, -1], [52, -100], [-1, 0], [-1, 0]]), dim=1)
    assert torch.allclose(towards(place, goal), wanted, atol=1e-6)


def test_episodes_end_at_their_goals_and_stay_in_the_rooms(data) -> None:
    assert data.lengths.min() >= 1
    assert (data.lengths == 100).any()
    assert (data.lengths < 100).any()
    assert ((data.places[:, 0, 0] - WALL).abs() > 12).all()
    assert (data.places[:, 1:] >= BORDER + RADIUS).all()
    assert (data.places[:, 1:] <= SIDE - BORDER - RADIUS).all()
    assert data.actions.abs().max() == 1
    crossed = (data.places[:, :-1, 0] < WALL) != (data.places[:, 1:, 0] < WALL)
    assert crossed.any()
    assert ((data.places[:, 1:, 1] - DOOR).abs()[crossed] <= 15.75).all()
    episode, step = data.moments(BLOCK)
    assert len(episode) == int((data.lengths - BLOCK + 1).clamp(min=0).sum())
    assert (step + BLOCK <= data.lengths[episode]).all()


def test_rooms_and_dot_are_drawn_where_they_are() -> None:
    empty = rooms()[0]
    assert empty.shape == (FRAME, FRAME)
    scale = SIDE / FRAME

    def seen(picture, x, y):
        return picture[int((y + 0.5) / scale), int((x + 0.5) / scale)]

    assert seen(empty, WALL, 150) == -1
    assert seen(empty, WALL, DOOR) == 1
    assert seen(empty, 60, 100) == 1
    assert seen(empty, 12, 100) < 0
    picture = drawn(torch.tensor([[60.0, 152.0]]), rooms())[0]
    redness = picture[0] - picture[1:].mean(0)
    down, across = divmod(int(redness.argmax()), FRAME)
    assert (down, across) == (int(152.5 / scale), int(60.5 / scale))
    assert picture[0].sum() == pytest.approx(float(empty.sum()), abs=1e-3)  # red stays red: only green and blue fade
    one_away = torch.exp(torch.tensor(-(((across + 0.5) * scale - 0.5 - 60) ** 2) / 98))
    assert picture[1, down, across] < 1 - 1.8 * one_away


def test_tasks_are_moments_of_recordings_and_the_places_25_steps_later(data) -> None:
    tasks = tasks_of(data, 50, torch.Generator().manual_seed(3))
    pairs = {
        (tuple(data.places[e, m].tolist()), tuple(data.places[e, m + AWAY].tolist()))
        for e, m in zip(*(one.tolist() for one in data.moments(AWAY)), strict=True)
    }
    asked = list(zip(map(tuple, tasks.start.tolist()), map(tuple, tasks.goal.tolist()), strict=True))
    assert len(set(asked)) == 50
    assert set(asked) <= pairs


def test_a_goal_counts_when_the_dot_comes_near_it_within_the_budget() -> None:
    tasks = Tasks(
        start=torch.tensor([[30.0, 100.0], [30.0, 100.0], [30.0, 100.0], [90.0, 150.0]]),
        goal=torch.tensor([[45.9, 100.0], [46.1, 100.0], [90.0, 190.0], [130.0, 150.0]]),
    )
    assert solved(tasks, idle).tolist() == [True, False, False, False]
    assert solved(tasks, scripted(tasks)).tolist() == [True, True, True, True]
    steps: list[int] = []

    def away(places, which, step):
        steps.append(step)
        return torch.tensor([[[-1.0, 0.0]]]).expand(len(places), 20, 2)

    assert not solved(tasks, away).any()
    assert steps == [0, 20, 40]
    assert steps[-1] + 20 > BUDGET


def test_chance_reaches_more_than_nobody_and_the_script_reaches_all(data) -> None:
    tasks = tasks_of(data, 200, torch.Generator().manual_seed(3))
    shares = [row("", solved(tasks, who)).reached for who in (idle, at_random(0), scripted(tasks))]
    assert shares[0] < shares[1] < shares[2] == 1


class _Known(TwoRoomModel):
    """Reads the place in the picture and knows how the dot moves; or takes every action for none."""

    def __init__(self, knows: bool) -> None:
        super().__init__()
        self.knows = knows

    def embed(self, image):
        share = (rooms() - image[:, 1:2])[:, 0].double().clamp(min=0)
        centres = (torch.arange(FRAME) + 0.5) * (SIDE / FRAME) - 0.5
        weights = share / share.sum((1, 2), keepdim=True)
        return torch.stack([(weights.sum(1) * centres).sum(1), (weights.sum(2) * centres).sum(1)], 1).float()

    def advance(self, state, action):
        place = state[1].float()
        if self.knows:
            for step in action.float().unflatten(1, (BLOCK, 2)).unbind(1):
                place = after(place, step)
        return state[1], place


@pytest.fixture
def short_search(monkeypatch) -> None:
    monkeypatch.setattr(lewm_two_room, "PLANNER", replace(PLANNER, samples=60, iterations=8, elites=8))


@pytest.mark.slow
@pytest.mark.usefixtures("short_search")
def test_plans_of_a_model_that_knows_the_rules_reach_their_goals() -> None:
    tasks = Tasks(
        start=torch.tensor([[40.0, 60.0], [180.0, 150.0], [85.0, 60.0]]),
        goal=torch.tensor([[70.0, 100.0], [140.0, 190.0], [140.0, 60.0]]),
    )
    assert (tasks.start - tasks.goal).norm(dim=1).min() > REACHED + SPEED
    assert solved(tasks, planned(_Known(True), tasks, 0)).all()
    again, others = (planned(_Known(True), tasks, seed)(tasks.start, torch.arange(3), 0) for seed in (0, 1))
    assert again.shape == (3, AWAY, 2)
    assert torch.equal(again, planned(_Known(True), tasks, 0)(tasks.start, torch.arange(3), 0))
    assert torch.equal(again[1:2], planned(_Known(True), tasks, 0)(tasks.start[1:2], torch.tensor([1]), 0))
    assert not torch.equal(again, others)


@pytest.mark.slow
def test_the_probe_is_perfect_where_the_embedding_is_the_place_and_blind_where_it_is_a_constant(data) -> None:
    other = recorded(50, torch.Generator().manual_seed(1))
    assert place_correlation(_Known(True), data, other) > 0.999

    class Turned(_Known):
        def embed(self, image):
            return torch.stack([super().embed(image)[:, 0], torch.randn(len(image))], 1)

    assert 0.4 < place_correlation(Turned(True), data, other) < 0.6


@pytest.mark.slow
@pytest.mark.usefixtures("short_search")
def test_one_command_trains_and_prints_the_published_shares_below(capsys) -> None:
    short = ["--steps", "2", "--episodes", "30", "--tasks", "2", "--development"]
    main(short)
    printed = capsys.readouterr().out
    assert "| ours, seed 0 |" in printed
    assert printed.splitlines()[-3].startswith("| LeWorldModel, published | 87% |")
    main([*short, "--json"])
    rows = json.loads(capsys.readouterr().out)
    assert [one["who"] for one in rows] == ["nobody", "random actions", "the script", "ours, seed 0"]
    assert rows[2]["reached"] == 1
    with pytest.raises(SystemExit):
        main(["--seeds", "0"])
