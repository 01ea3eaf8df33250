"""From what a person asks for to a recipe: an environment, how large, what to change."""

from __future__ import annotations

from dmotion_bench.errors import UnknownName
from dmotion_bench.recording.session import SHARD_EPISODES
from dmotion_bench.registry import environment_class
from dmotion_bench.specs import DatasetRecipe, Preset


def recipe_for(
    environment: str,
    preset: Preset = Preset.SMALL,
    *,
    episodes: int | None = None,
    frames: int | None = None,
    tasks: int | None = None,
    seed: int = 0,
) -> DatasetRecipe:
    """The recipe of a preset, with what is given instead of the preset's numbers.

    Raises:
        UnknownName: There is no such environment, or it has no such preset.
    """
    kind = environment_class(environment)
    if preset not in kind.recording:
        raise UnknownName(f"preset of {environment}", preset.value, [known.value for known in kind.recording])
    usual = kind.recording[preset]
    return DatasetRecipe(
        environment=environment,
        policy=kind.default_policy,
        seed=seed,
        episodes=usual.episodes if episodes is None else episodes,
        frames=usual.frames if frames is None else frames,
        tasks=usual.tasks if tasks is None else tasks,
        shard_episodes=SHARD_EPISODES,
    )
