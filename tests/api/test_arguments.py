"""Arguments of functions in Python: bounds as on the command line, and NumPy's whole numbers."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from api.test_use_cases import bytes_of

import dmotion_bench as dm
from dmotion_bench.errors import DmbenchError, UsageError
from dmotion_bench.registry import model_class

untyped: Any = dm
"""For arguments of kinds that a type checker would refuse."""

REFUSED: dict[str, tuple[Callable[[], Any], str]] = {
    "a true seed": (lambda: dm.record("grid_world", "tiny", seed=True, out="new"), "seed is True; it must be a whole"),
    "half a seed": (
        lambda: untyped.record("grid_world", "tiny", seed=1.5, out="new"),
        "seed is 1.5; it must be a whole",
    ),
    "seed": (lambda: dm.record("grid_world", "tiny", seed=-1, out="new"), "a whole number from 0 to 9007199254740991"),
    "one frame": (lambda: dm.record("grid_world", "tiny", frames=1, out="new"), "frames is 1; .* of 3 or more"),
    "two frames": (lambda: dm.record("grid_world", "tiny", frames=2, out="new"), "frames is 2; .* of 3 or more"),
    "episodes": (lambda: dm.record("grid_world", "tiny", episodes=0, out="new"), "episodes is 0; .* of 1 or more"),
    "tasks": (lambda: dm.record("grid_world", "tiny", tasks=-1, out="new"), "tasks is -1; .* of 0 or more"),
    "size": (lambda: dm.record("gym:CartPole-v1", "tiny", size=8, out="new"), "size is 8; .* from 16 to 1024"),
    "skip": (lambda: dm.record("gym:CartPole-v1", "tiny", frame_skip=0, out="new"), "frame_skip is 0; .* of 1 or"),
    "workers": (lambda: dm.record("grid_world", "tiny", workers=0, out="new"), "workers is 0; .* of 1 or more"),
    "threads": (lambda: dm.train("lapo", threads=0, out="new"), "threads is 0; .* from 1 to 1024"),
    "loaders of decoded frames": (
        lambda: dm.train("lapo", loaders=2, out="new"),
        "'--loaders 2' is for a training that reads the compressed files; add '--stream'",
    ),
    "loaders": (lambda: dm.train("lapo", loaders=0, out="new"), "loaders is 0; .* from 1 to 1024"),
    "true seed": (lambda: untyped.train("lapo", seed=np.bool_(1), out="new"), r"seed is .*True.*; it must be a whole"),
    "device": (lambda: dm.train("lapo", device=torch.device("meta"), out="new"), "no device named 'meta'"),
    "no steps": (lambda: dm.view("tiny", save="new.gif", steps=0), "steps is 0; .* of 1 or more"),
    "fewer steps": (lambda: dm.view("tiny", save="new.gif", steps=-3), "steps is -3; .* of 1 or more"),
    "episode": (
        lambda: untyped.view("tiny", save="new.rrd", episodes=3),
        r"episodes is 3; give a list .* such as \[0\]",
    ),
    "episode's name": (lambda: untyped.view("tiny", save="new.rrd", episodes="3"), "episodes is '3'; give a list"),
    "half an episode": (lambda: untyped.view("tiny", save="new.rrd", episodes=[0.5]), "episode is 0.5; it must be"),
    "plan's seed": (lambda: dm.plan("random", seed=-1), "seed is -1; .* of 0 or more"),
    "plan's task": (lambda: dm.plan("random", task=-1), "task is -1; .* of 0 or more"),
    "plan's steps": (lambda: dm.plan("random", steps=0), "steps is 0; .* of 1 or more"),
    "demo's seed": (lambda: dm.demo("new", seed=True), "seed is True; it must be a whole"),
    "batch": (lambda: dm.score("tiny", batch_size=0), "batch_size is 0; .* of 1 or more"),
    "a reference": (lambda: dm.score("oracle", "control"), r"'oracle' is a reference .*dm\.plan\('oracle'\)"),
    "half a step": (lambda: untyped.score("tiny", horizon=2.5), "horizon is 2.5; .* of 1 or more"),
    "planner scored": (lambda: dm.score("tiny", planner="icem"), "planner would change nothing without control"),
    "tasks scored": (lambda: dm.score("tiny", "control", tasks=0), "tasks is 0; .* of 1 or more"),
    "a text": (lambda: untyped.open_dataset().video("0"), "episode is '0'; it must be a whole number"),
    "none": (lambda: dm.open_dataset().labels(-1), "has no episode -1; it has 0 to 19"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", REFUSED)
def test_numbers_out_of_the_command_line_s_bounds_are_refused(workspace: Path, name: str) -> None:
    call, said = REFUSED[name]
    with pytest.raises(UsageError, match=said):
        call()
    assert not [*workspace.glob("new*")]


OTHER_KINDS: dict[str, tuple[Callable[[], Any], str]] = {
    "a number as a run": (lambda: untyped.load_run(5), "5 stands for no run; give one name, or one path"),
    "runs as a run": (lambda: untyped.score(["tiny"], "prediction"), r"\['tiny'\] stands for no run; give one name"),
    "a number to view": (lambda: untyped.view(5, save="new.rrd"), "5 stands for no"),
    "a number as data": (lambda: untyped.train("lapo", 5, out="new"), "5 stands for no data set"),
    "a number of metrics": (
        lambda: untyped.score("tiny", 3),
        "metrics names 3; a group of figures is a word: prediction",
    ),
    "no metric": (lambda: untyped.score("tiny", [None]), "metrics names None; a group of figures is a word"),
    "a planner's setting": (
        lambda: untyped.score("tiny", "control", planner_settings=[3]),
        "a setting is 3; it can be a text such as 'epochs=5'",
    ),
    "settings": (
        lambda: untyped.record("grid_world", "tiny", out="new", settings=3),
        "a setting is 3; it can be a text",
    ),
    "a share as a text": (
        lambda: untyped.leaderboard_check("tiny", differing="0.1"),
        "differing is '0.1'; it must be a sh",
    ),
    "no share": (lambda: untyped.leaderboard_check("tiny", differing=None), "differing is None; it must be a share"),
    "a number to check": (lambda: untyped.leaderboard_check(7), "7 stands for no entry or run"),
    "a file as a page": (
        lambda: dm.leaderboard_build("tiny", out="data/grid_world-tiny/dataset.json"),
        "dataset.json' is a file; name a folder for the page",
    ),
    "a number as a folder": (lambda: untyped.record("grid_world", "tiny", out=3), "3 stands for no folder"),
    "a number as a run's folder": (lambda: untyped.train("lapo", out=3), "3 stands for no folder"),
    "a number as a workspace": (lambda: untyped.demo(3), "3 stands for no folder"),
    "a number as a recording": (lambda: untyped.import_recordings(3, out="new"), "3 stands for no recording"),
    "a number as an import": (lambda: untyped.import_recordings("data", out=3), "3 stands for no folder"),
    "a number as an export": (lambda: untyped.export_dataset(out=3), "3 stands for no folder"),
    "a number as a plan": (lambda: untyped.plan("random", save=3), "3 stands for no file"),
    "a number as other data": (lambda: untyped.view("tiny", save="new.rrd", data=3), "3 stands for no data set"),
    "a text as a bar": (
        lambda: untyped.record("grid_world", "tiny", progress="bar"),
        "progress is 'bar'; give a function, True for a bar, or None",
    ),
    "a number as a split": (lambda: untyped.open_dataset().split(1), "no split named 1; known: test, train"),
    "a number as a file": (lambda: untyped.view("tiny", save=5), "5 stands for no file; give one name"),
    "a number to publish": (lambda: untyped.share_push(5, "new"), "5 stands for no run, data set, entry or hash"),
    "a number to fetch": (lambda: untyped.share_pull(5, "new"), "5 stands for no run, data set, entry or hash"),
    "no place": (lambda: untyped.share_push("tiny", None), "None stands for no place to share in"),
    "a number as a name": (lambda: untyped.register_model(5, model_class("lapo")), "5 cannot be a name here"),
    "a number as a table": (lambda: untyped.reproduce(5, dry_run=True), "5 is no table; give a table's name"),
    "a number of models": (lambda: untyped.reproduce("paper", models=5), "no model of this table named 5; known"),
    "a number as a world": (lambda: untyped.reproduce("paper", worlds=[5]), "no world of this table named 5; known"),
    "a number as speeds": (
        lambda: untyped.reproduce("paper", speeds=5, dry_run=True),
        "5 stands for no file of speeds",
    ),
    "a split's protocol": (
        lambda: untyped.open_dataset().triplets("test", protocol="Paper"),
        "no protocol named 'Paper'; did you mean 'paper'",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHER_KINDS)
def test_what_is_of_another_kind_costs_a_sentence(workspace: Path, name: str) -> None:
    call, said = OTHER_KINDS[name]
    with pytest.raises(DmbenchError, match=said):
        call()
    assert not [*workspace.glob("new*")]


@pytest.mark.slow
def test_whole_numbers_may_be_numpy_s(workspace: Path) -> None:
    recorded = untyped.record(
        "grid_world",
        "tiny",
        seed=np.int64(3),
        episodes=np.int32(4),
        frames=np.uint8(6),
        out="data/four",
    )
    dm.record("grid_world", "tiny", seed=3, episodes=4, frames=6, out="data/same")
    assert (recorded.episodes, recorded.frames) == (4, 24)
    assert bytes_of(workspace / "data" / "four") == bytes_of(workspace / "data" / "same") != {}
    run = untyped.train(
        "lapo", "grid_world-tiny", seed=np.int64(5), device=torch.device("cpu"), settings={"epochs": 0.1}
    )
    assert dm.load_run(run).spec.seed == 5
    assert len(untyped.open_dataset("four").video(np.int64(0))) == 6
