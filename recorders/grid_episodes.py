"""Episodes of random actions on the grid, all played at once: equal to stepping, and faster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from gymnasium.utils import seeding
from jaxtyping import Bool, Int

from dmotion_bench.recording.rollout import policy_generator
from dmotion_bench.specs import Episode, EpisodeLabels, Scalar
from recorders.distractors import Picture, Video
from recorders.grid_drawing import Version
from recorders.grid_rules import PUSHED, act, agents_among, legal_actions, starting_cells
from recorders.grid_things import HEADINGS, draw, heading, states

Distraction = Callable[[np.random.Generator], tuple[Mapping[str, Scalar], Video | None]]


def played_at_once(
    seeds: Sequence[int], frames: int, things: int, version: Version, distraction: Distraction
) -> Iterator[Episode]:
    """The episodes of these seeds, of so many frames, by the policy ``random``.

    Args:
        seeds: Each decides an episode.
        frames: Of each episode.
        things: How many there are on the grid.
        version: How they are drawn.
        distraction: The values of factors and the video of an episode, from what its cells were drawn from.
    """
    generators = [seeding.np_random(seed)[0] for seed in seeds]
    cells = np.stack([starting_cells(generator, things) for generator in generators])
    there = np.ones(cells.shape[:2], np.bool_)
    draws = np.stack([policy_generator(seed).random(frames - 1) for seed in seeds])
    cells_then, there_then, actions = [cells], [there], list[Int[np.ndarray, " n"]]()
    for moment in range(frames - 1):
        legal = legal_actions(cells, there)
        chosen = (draws[:, moment] * legal.sum(axis=-1)).astype(np.int64)
        action = np.argmax(legal.cumsum(axis=-1) > chosen[:, None], axis=-1)
        cells, there = act(cells, there, action)
        actions.append(action)
        cells_then.append(cells)
        there_then.append(there)
    every_action = np.array(actions, np.int64).reshape(frames - 1, len(seeds))
    every_cell, all_there = np.stack(cells_then), np.stack(there_then)
    for row, seed in enumerate(seeds):
        episode = _episode(every_cell[:, row], all_there[:, row], every_action[:, row], seed, version)
        values, video = distraction(generators[row])
        yield episode if video is None else _distracted(episode, values, video)


def _distracted(episode: Episode, values: Mapping[str, Scalar], video: Video) -> Episode:
    """An episode as its video shows it."""
    labels, agents = episode.labels, episode.labels.agent.pixel.shape[1]
    frames, masks = np.empty_like(episode.frames), np.empty_like(labels.masks)
    things = [labels.agent.pixel[:, :1], labels.objects.pixel, labels.agent.pixel[:, 1:]]
    pixel = np.concatenate(things, axis=1)
    things = [labels.agent.visible[:, :1], labels.objects.visible, labels.agent.visible[:, 1:]]
    visible = np.concatenate(things, axis=1)
    acting = list(agents_among(pixel.shape[1]))
    for moment, (frame, mask) in enumerate(zip(episode.frames, labels.masks, strict=True)):
        drawn = Picture(frame=frame, masks=mask, pixel=pixel[moment].copy(), visible=visible[moment].copy())
        if moment:
            video.step(heading(int(labels.actions[moment - 1]), agents), HEADINGS)
        seen = video.show(drawn) if moment else video.begin(drawn)
        pixel[moment], visible[moment] = seen.pixel, seen.visible
        frames[moment], masks[moment] = seen.frame, seen.masks
    agent = replace(labels.agent, pixel=pixel[:, acting], visible=visible[:, acting])
    objects = replace(labels.objects, pixel=pixel[:, PUSHED], visible=visible[:, PUSHED])
    shown = replace(labels, agent=agent, objects=objects, masks=masks, factors=values)
    return replace(episode, frames=frames, labels=shown)


def _episode(
    cells: Int[np.ndarray, "t n 2"],
    there: Bool[np.ndarray, "t n"],
    actions: Int[np.ndarray, "t-1"],
    seed: int,
    version: Version,
) -> Episode:
    frames, masks, centers, visible = draw(cells, there, version)
    pushed = (np.diff(cells[:, PUSHED], axis=0) != 0).any(axis=-1) & there[:-1, PUSHED]
    acting = list(agents_among(cells.shape[1]))
    return Episode(
        frames=frames,
        labels=EpisodeLabels(
            actions=actions,
            pushed=pushed.any(axis=-1),
            agent=states(cells[:, acting], there[:, acting], centers[:, acting], visible[:, acting]),
            objects=states(cells[:, PUSHED], there[:, PUSHED], centers[:, PUSHED], visible[:, PUSHED]),
            masks=masks,
        ),
        seed=seed,
        ended="truncated",
    )
