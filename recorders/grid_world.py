"""The environment ``grid_world``: the paper's Grid World (section 5.1), reproduced.

Five by five cells on 128x128 black pixels. The agent is a green square; red and magenta circles, blue and yellow
triangles each fill their cell. The agent moves up, down, left or right and pushes the whole chain of objects
before it; an object pushed over the edge is gone for good. The agent itself never leaves the grid.

Positions are in cells, called metres: x to the right, y downwards, cell (0, 0) at the upper left.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from types import MappingProxyType
from typing import Any, ClassVar, Final

import gymnasium
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from dmotion_bench.environment import Policy, RecordingPreset
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.recording.rollout import policy_generator
from dmotion_bench.specs import (
    MASK_AGENT,
    MASK_FIRST_OBJECT,
    EnvSpec,
    Episode,
    EpisodeLabels,
    ObjectSpec,
    ObjectStates,
    Preset,
)
from recorders.policies import RandomPolicy

CELLS: Final = 5
SIZE: Final = 128  # [px]
FACTS: Final = EnvSpec(
    id="grid_world",
    actions=("up", "down", "left", "right"),
    agent=ObjectSpec(name="agent", shape="square", color=(0, 255, 0)),
    objects=(
        ObjectSpec(name="red_circle", shape="circle", color=(255, 0, 0)),
        ObjectSpec(name="magenta_circle", shape="circle", color=(255, 0, 255)),
        ObjectSpec(name="blue_triangle", shape="triangle", color=(0, 0, 255)),
        ObjectSpec(name="yellow_triangle", shape="triangle", color=(255, 255, 0)),
    ),
    height=SIZE,
    width=SIZE,
    agent_has_color=True,
)
OBJECTS: Final = len(FACTS.objects)
MOVES: Final = np.array([(0, -1), (0, 1), (-1, 0), (1, 0)])
"""What each action adds to the agent's (x, y)."""
EDGES: Final = tuple(round(cell * SIZE / CELLS) for cell in range(CELLS + 1))
"""Cell i spans the pixels ``EDGES[i]`` to ``EDGES[i + 1]``."""


@cache
def _stamp(shape: str, column: int, row: int) -> Bool[np.ndarray, "h w"]:
    """Which pixels of a cell a shape covers: those whose centre lies in it."""
    height, width = EDGES[row + 1] - EDGES[row], EDGES[column + 1] - EDGES[column]
    y, x = ((np.arange(height) + 0.5) / height)[:, None], ((np.arange(width) + 0.5) / width)[None]
    if shape == "circle":
        inside = (x - 0.5) ** 2 + (y - 0.5) ** 2 <= 0.25
    elif shape == "triangle":
        inside = np.abs(x - 0.5) <= y / 2
    else:
        inside = np.ones((height, width), np.bool_)
    return inside


@cache
def _tiles(thing: int) -> dict[tuple[int, int], tuple[slice, slice, Any, Any, tuple[float, float]]]:
    """For each cell: its rows and columns, what the thing looks like there, its mask, and its pixel centre.

    Thing 0 is the agent, thing 1 + k object k. No two things share a cell, so a tile is simply laid down.
    """
    look = (FACTS.agent, *FACTS.objects)[thing]
    value = MASK_AGENT if thing == 0 else MASK_FIRST_OBJECT + thing - 1
    tiles = {}
    for column in range(CELLS):
        for row in range(CELLS):
            stamp = _stamp(look.shape, column, row)
            rows, columns = slice(EDGES[row], EDGES[row + 1]), slice(EDGES[column], EDGES[column + 1])
            ys, xs = np.nonzero(stamp)
            center = (EDGES[column] + float(xs.mean()), EDGES[row] + float(ys.mean()))
            picture = stamp[..., None] * np.array(look.color, np.uint8)
            tiles[column, row] = (rows, columns, picture, stamp.astype(np.uint8) * value, center)
    return tiles


def draw(
    cells: Int[np.ndarray, "t n 2"], there: Bool[np.ndarray, "t n"]
) -> tuple[UInt8[np.ndarray, "t h w 3"], UInt8[np.ndarray, "t h w"], Float[np.ndarray, "t n 2"]]:
    """Frames, masks and pixel centres of agent and objects (thing 0 is the agent) at a sequence of moments."""
    frames = np.zeros((len(cells), SIZE, SIZE, 3), np.uint8)
    masks = np.zeros((len(cells), SIZE, SIZE), np.uint8)
    centers = np.full((*there.shape, 2), np.nan)
    for thing in range(there.shape[1]):
        tiles = _tiles(thing)
        for moment in np.flatnonzero(there[:, thing]):
            column, row = cells[moment, thing]
            rows, columns, picture, mask, center = tiles[int(column), int(row)]
            frames[moment, rows, columns] = picture
            masks[moment, rows, columns] = mask
            centers[moment, thing] = center
    return frames, masks, centers


def legal_moves(agent: Int[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n a"]:
    """Which actions keep the agent on the grid."""
    target = agent[:, None] + MOVES
    inside: Bool[np.ndarray, "n a"] = ((target >= 0) & (target < CELLS)).all(axis=-1)
    return inside


def advance(
    cells: Int[np.ndarray, "n k 2"], there: Bool[np.ndarray, "n k"], action: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, "n k 2"], Bool[np.ndarray, "n k"]]:
    """The grids after one legal action each; thing 0 is the agent."""
    move = MOVES[action]
    moving = np.zeros_like(there)
    moving[:, 0] = True
    front, chain = cells[:, 0], np.ones(len(cells), np.bool_)
    for _ in range(OBJECTS):  # whoever stands before the last of the chain joins it
        front = front + move
        hit = there & (cells == front[:, None]).all(axis=-1) & chain[:, None]
        chain = hit.any(axis=-1)
        moving |= hit
    cells = cells + move[:, None] * moving[..., None]
    return cells, there & ((cells >= 0) & (cells < CELLS)).all(axis=-1)


def starting_cells(generator: np.random.Generator) -> Int[np.ndarray, "k 2"]:
    """Agent and objects on cells of their own."""
    chosen = generator.permutation(CELLS * CELLS)[: 1 + OBJECTS]
    return np.stack([chosen % CELLS, chosen // CELLS], axis=-1)


def _states(
    cells: Int[np.ndarray, "*t k 2"], there: Bool[np.ndarray, "*t k"], centers: Float[np.ndarray, "*t k 2"]
) -> ObjectStates:
    known = there[..., None]
    position = np.concatenate([cells, np.zeros_like(cells[..., :1])], axis=-1)
    return ObjectStates(
        position=np.where(known, position, np.nan),
        orientation=np.where(known, (0.0, 0.0, 0.0, 1.0), np.nan),
        pixel=centers,
        visible=there.astype(np.float64),
    )


class GridWorld(gymnasium.Env[UInt8[np.ndarray, "h w 3"], Any]):
    """A square pushes circles and triangles over a grid, and off it.

    Args:
        render_mode: Gymnasium's; None or ``"rgb_array"``.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 -- as in Gymnasium
    recording: ClassVar[Mapping[Preset, RecordingPreset]] = MappingProxyType(
        {
            Preset.TINY: RecordingPreset(episodes=20, frames=12, tasks=0),
            Preset.SMALL: RecordingPreset(episodes=300, frames=32, tasks=100),
            Preset.PAPER: RecordingPreset(episodes=700, frames=32, tasks=100),
        }
    )
    policies: ClassVar[Mapping[str, Callable[[], Policy]]] = MappingProxyType({"random": RandomPolicy})
    default_policy: ClassVar[str] = "random"

    def __init__(self, *, render_mode: str | None = None) -> None:
        self.facts = FACTS
        self.render_mode = render_mode
        self.action_space = gymnasium.spaces.Discrete(len(FACTS.actions))
        self.observation_space = gymnasium.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)
        self._place(starting_cells(np.random.default_rng(0)), np.ones(1 + OBJECTS, np.bool_))

    @property
    def moves(self) -> Float[np.ndarray, "a 2"]:
        """Where each action takes the agent, in cells."""
        return MOVES.astype(np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[UInt8[np.ndarray, "h w 3"], dict[str, Any]]:
        """Put agent and objects on cells of their own; there are no options."""
        super().reset(seed=seed)
        if options and options.get("vary"):
            raise InvalidSetting(
                "nothing varies in grid_world: it is the paper's, and a control; planar_push and robot_push have "
                "factors of variation."
            )
        self._place(starting_cells(self.np_random), np.ones(1 + OBJECTS, np.bool_))
        return self.render(), {}

    def step(self, action: int) -> tuple[UInt8[np.ndarray, "h w 3"], float, bool, bool, dict[str, Any]]:
        """Move the agent; a move off the grid changes nothing and ``info["illegal"]`` says so."""
        legal = bool(self.legal_actions()[action])
        if legal:
            cells, there = advance(self._cells[None], self._there[None], np.array([action]))
            self._place(cells[0], there[0])
        return self.render(), 0.0, False, False, {"illegal": not legal}

    def render(self) -> UInt8[np.ndarray, "h w 3"]:
        """The present frame."""
        return self._frame.copy()

    def legal_actions(self) -> Bool[np.ndarray, " a"]:
        """Which moves stay on the grid."""
        legal: Bool[np.ndarray, " a"] = legal_moves(self._cells[:1])[0]
        return legal

    def agent(self) -> ObjectStates:
        """The green square."""
        return _states(self._cells[:1], self._there[:1], self._centers[:1])

    def objects(self) -> ObjectStates:
        """The circles and triangles; ``pixel`` is the mean of the pixels that a thing covers."""
        return _states(self._cells[1:], self._there[1:], self._centers[1:])

    def masks(self) -> UInt8[np.ndarray, "h w"]:
        """What each pixel shows: 0 background, 1 agent, 2 + k object k."""
        return self._masks.copy()

    def _place(self, cells: Int[np.ndarray, "k 2"], there: Bool[np.ndarray, " k"]) -> None:
        """Put everything where it is now, and draw it."""
        self._cells, self._there = cells, there
        frames, masks, centers = draw(cells[None], there[None])
        self._frame: UInt8[np.ndarray, "h w 3"] = frames[0]
        self._masks: UInt8[np.ndarray, "h w"] = masks[0]
        self._centers: Float[np.ndarray, "k 2"] = centers[0]

    @classmethod
    def generate(
        cls, seeds: Sequence[int], *, frames: int, policy: str, parameters: Mapping[str, Any]
    ) -> Iterator[Episode]:
        """The episodes of ``seeds``, all played at once; equal to stepping with ``RandomPolicy``."""
        cls(**parameters)  # refuses what the constructor refuses
        if policy != cls.default_policy:
            raise InvalidSetting(f"grid_world is recorded by {cls.default_policy!r}, not {policy!r}.")
        cells = np.stack([starting_cells(gymnasium.utils.seeding.np_random(seed)[0]) for seed in seeds])
        there = np.ones(cells.shape[:2], np.bool_)
        draws = np.stack([policy_generator(seed).random(frames - 1) for seed in seeds])
        cells_then, there_then, actions = [cells], [there], list[Int[np.ndarray, " n"]]()
        for moment in range(frames - 1):
            legal = legal_moves(cells[:, 0])
            chosen = (draws[:, moment] * legal.sum(axis=-1)).astype(np.int64)
            action = np.argmax(legal.cumsum(axis=-1) > chosen[:, None], axis=-1)
            cells, there = advance(cells, there, action)
            actions.append(action)
            cells_then.append(cells)
            there_then.append(there)
        every_action = np.array(actions, np.int64).reshape(frames - 1, len(seeds))
        every_cell, all_there = np.stack(cells_then), np.stack(there_then)
        for row, seed in enumerate(seeds):
            yield _episode(every_cell[:, row], all_there[:, row], every_action[:, row], seed)


def _episode(
    cells: Int[np.ndarray, "t n 2"], there: Bool[np.ndarray, "t n"], actions: Int[np.ndarray, "t-1"], seed: int
) -> Episode:
    frames, masks, centers = draw(cells, there)
    pushed = (np.diff(cells[:, 1:], axis=0) != 0).any(axis=-1) & there[:-1, 1:]
    return Episode(
        frames=frames,
        labels=EpisodeLabels(
            actions=actions,
            pushed=pushed.any(axis=-1),
            agent=_states(cells[:, :1], there[:, :1], centers[:, :1]),
            objects=_states(cells[:, 1:], there[:, 1:], centers[:, 1:]),
            masks=masks,
        ),
        seed=seed,
        ended="truncated",
    )


gymnasium.register(id="dmbench/GridWorld-v0", entry_point="recorders.grid_world:GridWorld")
