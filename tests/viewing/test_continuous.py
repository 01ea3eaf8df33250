"""Scenes of data with continuous actions: curves of their numbers, and lanes of what else happens."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from rrd_contents import curve, layout_of

from dmotion_bench.learning.runs.run import Run
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing.comparison import comparison_scene
from dmotion_bench.viewing.dataset import dataset_scene
from dmotion_bench.viewing.run import run_scene
from dmotion_bench.viewing.scene import Scene, write_scene

SCENES: dict[str, tuple[Callable[[list[Run], Dataset], Scene], str]] = {
    "data set": (lambda runs, dataset: dataset_scene(dataset, [0]), "$origin/pushed/**"),
    "run": (lambda runs, dataset: run_scene(runs[0], dataset, [0]), "$origin/moved"),
    "comparison": (lambda runs, dataset: comparison_scene(runs, dataset, [0]), "$origin/moved"),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", SCENES)
def test_actions_are_curves_above_the_lanes(kind: str, moved_runs: list[Run], moved: Dataset, rrd: Path) -> None:
    make, lanes = SCENES[kind]
    write_scene(make(moved_runs, moved), rrd)
    actions = moved.labels(0).actions
    for place in range(2):
        assert [value for _, value in curve(rrd, f"/episode_0/action/{place}")] == actions[:, place].tolist()

    layout = layout_of(rrd)
    views = {
        str(parts["ViewBlueprint:display_name"][0]): (entity, parts["ViewBlueprint:space_origin"][0])
        for entity, parts in layout.items()
        if "ViewBlueprint:display_name" in parts
    }
    assert views["Actions"][1] == "/episode_0/action"
    assert layout[f"{views['What happens'][0]}/ViewContents"]["ViewContents:query"] == [lanes]
    beside = [parts.get("ContainerBlueprint:contents", []) for parts in layout.values()]
    together = {views["Actions"][0].removeprefix("/"), views["What happens"][0].removeprefix("/")}
    assert any(set(contents) == together for contents in beside)
