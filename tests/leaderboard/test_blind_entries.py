"""Entries of models that draw no frames: their states are ranked, and were not in the first releases."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from known_model import Known, write_run
from torch import Tensor

from dmotion_bench.scoring.score import score_run
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace
from leaderboard.build import entry_of_run
from leaderboard.check import check_entry

from .conftest import SETTINGS


class Blind(Known):
    needs_pixels = False


class Ranked(Blind):
    def embedding(self, state: tuple[Tensor, Tensor]) -> Tensor:
        return state[1]


@pytest.mark.slow
@pytest.mark.parametrize(("scored_as", "remarks"), [(Ranked, 0), (Blind, 1)])
def test_an_entry_of_a_model_without_frames_holds_with_and_without_ranks(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch, scored_as: type[Any], remarks: int
) -> None:
    run = write_run(workspace.runs / "blind", Dataset.open(workspace.data / "grid_world-tiny"), offset=0.3)
    monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: scored_as)
    score_run(Path(run.path), metrics=("rollout",), settings=SETTINGS)
    entry = entry_of_run(run.path)
    monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Ranked)

    verdict = check_entry(entry, workspace)

    assert verdict.holds, verdict.findings
    assert ("rollout_hit_at_1[1]" in entry.figures) == (scored_as is Ranked)
    assert sum("ranks of states" in remark for remark in verdict.remarks) == remarks
