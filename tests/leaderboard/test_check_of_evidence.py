"""What an entry rests on: whatever is changed in its samples, its weights, its data or its pictures is found."""

from __future__ import annotations

import copy
import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
import torch

from dmotion_bench.errors import CacheNotWritable, StorageFull
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.scoring.figures import figures_of
from dmotion_bench.scoring.report import write_report
from dmotion_bench.scoring.samples import SCHEMA, read_samples
from dmotion_bench.scoring.shared_samples import SharedSamples
from dmotion_bench.scoring.soundness import TOGETHER
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.shard import file_facts
from dmotion_bench.storage.tables import EPISODES
from dmotion_bench.workspace import Workspace
from leaderboard import check
from leaderboard.build import entry_of_run
from leaderboard.check import CheckSettings, check_entry
from leaderboard.entry import Entry
from leaderboard.pictures import from_png, to_png
from leaderboard.rescored import same_samples
from leaderboard.verdict import Findings

pytestmark = pytest.mark.slow

Changed = Callable[..., Entry]
QUICK = CheckSettings(score=False)
RUN = "dmotion-grid_world-tiny-s0"


def _rewritten(run: Path, change: Callable[[list[dict[str, Any]]], None]) -> Entry:
    """A run whose samples were changed and whose report was made to agree, hash, figures and all."""
    from dmotion_bench.scoring.report import read_report
    from dmotion_bench.scoring.samples import read_samples

    folder = run / "report"
    table, report = read_samples(folder / "samples.parquet"), read_report(folder)
    assert report is not None
    rows = table.to_pylist()
    change(rows)
    forged = pa.Table.from_pylist(rows, table.schema)
    figures = {name: one.to_json() for name, one in figures_of(forged, "model", resamples=200).items()}
    write_report(folder, type(report)(**(vars(report) | {"figures": figures})), forged)
    return entry_of_run(run)


def _first(rows: list[dict[str, Any]], metric: str, predictor: str) -> dict[str, Any]:
    return next(row for row in rows if (row["metric"], row["predictor"]) == (metric, predictor))


@pytest.mark.parametrize("metric", ["prediction", "rollout"])
def test_a_single_forged_sample_is_found_by_scoring_anew(
    workspace: Workspace, shared: SharedSamples, metric: str
) -> None:
    def better(rows: list[dict[str, Any]]) -> None:
        _first(rows, metric, "model")["mse"] *= 0.5

    forged = _rewritten(workspace.runs / RUN, better)

    assert check_entry(forged, workspace, QUICK).holds  # all agrees: hash, figures, sums
    findings = check_entry(forged, workspace, shared=shared).findings
    assert any("1 of" in finding and f"{metric} of model" in finding for finding in findings), findings


def test_forged_probes_are_found_by_scoring_anew(workspace: Workspace, sound: Entry) -> None:
    """The means may stand, and only what the interval is made of be smoothed."""
    rows = read_samples(workspace.runs / RUN / "report" / "samples.parquet").to_pylist()
    generator = np.random.default_rng(0)
    for row in rows:
        if (row["metric"], row["predictor"]) == ("prediction", "model"):
            row["state_probe_object_place"] = (1e-3 * generator.random(2)).tolist()
    scored = pa.Table.from_pylist(rows, SCHEMA)

    def found(change: Callable[[list[float]], list[float] | None]) -> list[str]:
        stored = [row | {"state_probe_object_place": change(row["state_probe_object_place"] or [])} for row in rows]
        check = Findings(entry=sound)
        same_samples(check, pa.Table.from_pylist(stored, SCHEMA), scored, 0.0, ())
        return check.wrong

    assert found(lambda own: own) == []
    assert found(lambda own: [one * 1.001 for one in own]) == []
    assert found(lambda own: None) == []  # from before there were such probes
    (said,) = found(lambda own: [5e-4 for _ in own])
    assert "of what probes and codes came to differ from the new scoring" in said


def test_samples_that_were_dropped_are_found(workspace: Workspace, shared: SharedSamples) -> None:
    def drop_the_worst(rows: list[dict[str, Any]]) -> None:
        mine = [row for row in rows if row["predictor"] == "model" and row["metric"] == "prediction"]
        rows.remove(max(mine, key=lambda row: row["mse"]))

    findings = check_entry(_rewritten(workspace.runs / RUN, drop_the_worst), workspace, shared=shared).findings

    assert any("of other frames" in finding for finding in findings)


def test_a_share_of_differing_samples_can_be_allowed(workspace: Workspace, shared: SharedSamples) -> None:
    def round_otherwise(rows: list[dict[str, Any]]) -> None:
        _first(rows, "prediction", "model")["found"][0] ^= True

    forged = _rewritten(workspace.runs / RUN, round_otherwise)

    strict, lenient = (
        check_entry(forged, workspace, CheckSettings(differing=share), shared=shared) for share in (0, 0.01)
    )
    assert not strict.holds
    assert lenient.holds
    assert any("1 of" in remark for remark in lenient.remarks)


def test_changed_samples_beside_an_honest_entry_are_found(workspace: Workspace, sound: Entry) -> None:
    path = workspace.runs / RUN / "report/samples.parquet"
    raw = bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 1
    path.write_bytes(raw)

    assert any(finding.startswith("samples.sha256") for finding in check_entry(sound, workspace, QUICK).findings)


def test_missing_samples_are_found(workspace: Workspace, sound: Entry) -> None:
    (workspace.runs / RUN / "report/samples.parquet").unlink()

    assert any(finding.startswith("samples: there is no") for finding in check_entry(sound, workspace, QUICK).findings)


def test_other_weights_under_the_same_hash_are_found(workspace: Workspace, sound: Entry) -> None:
    other = checkpoint.with_prefix("model", {"offset": torch.tensor([0.01])})
    path = workspace.runs / RUN / "best.safetensors"
    checkpoint.save(path, other, checkpoint.load(path)[1])

    findings = check_entry(sound, workspace).findings
    assert any("other weights than those that the training wrote" in finding for finding in findings)


@pytest.mark.parametrize("kind", ["video", "labels"])
def test_a_changed_data_set_is_found(workspace: Workspace, sound: Entry, kind: str) -> None:
    path = next((workspace.data / "grid_world-tiny" / kind).iterdir())
    raw = bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 1
    path.write_bytes(raw)

    findings = check_entry(sound, workspace, QUICK).findings
    assert any(f"{kind}/{path.name} is not what was recorded" in finding for finding in findings)


def test_labels_that_the_run_miscounts_as_its_entry_does_are_found(workspace: Workspace, changed: Changed) -> None:
    manifest = json.loads((workspace.runs / RUN / "run.json").read_text())
    manifest["result"]["labels_total"] = 1
    (workspace.runs / RUN / "run.json").write_text(json.dumps(manifest))
    forged = changed(labels={"asked": "one-shot", "given": {"demonstrations": 4}, "total": 1})

    findings = check_entry(forged, workspace, QUICK).findings
    assert findings == ("labels.total, the sum of labels.given: the entry says 1, it is 4",)


def test_labels_that_are_not_what_the_budget_gives_are_found(
    workspace: Workspace, changed: Changed, shared: SharedSamples
) -> None:
    """The run says the same as its entry, and the sum is right."""
    manifest = json.loads((workspace.runs / RUN / "run.json").read_text())
    manifest["result"] |= {"labels": {"demonstrations": 3}, "labels_total": 3}
    (workspace.runs / RUN / "run.json").write_text(json.dumps(manifest))
    forged = changed(labels={"asked": "one-shot", "given": {"demonstrations": 3}, "total": 3})

    assert check_entry(forged, workspace, QUICK).holds
    findings = check_entry(forged, workspace, shared=shared).findings
    assert findings == (
        "labels.given, by the budget one-shot and the data set: the entry says {'demonstrations': 3}, it is "
        "{'demonstrations': 4}",
    )


def test_a_report_of_validation_episodes_that_calls_itself_the_test_s_is_found(workspace: Workspace) -> None:
    validation = Dataset.open(workspace.data / "grid_world-tiny").split("validation").tolist()

    def of_validation(rows: list[dict[str, Any]]) -> None:
        of = dict(zip(sorted({row["episode"] for row in rows}), validation, strict=False))
        for row in rows:
            row["episode"] = of.get(row["episode"], row["episode"])

    findings = check_entry(_rewritten(workspace.runs / RUN, of_validation), workspace, QUICK).findings
    assert len(findings) == 1
    assert findings[0].startswith(f"samples: episode {validation[0]}, ")


def test_a_broken_contract_that_report_and_entry_conceal_is_found(
    workspace: Workspace, sound: Entry, shared: SharedSamples, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a model that looks at the other frames of a batch, figures are no better than its author wants."""
    monkeypatch.setattr("dmotion_bench.scoring.score.is_built_in", lambda *_: False)
    assert check_entry(sound, workspace, shared=shared).holds
    monkeypatch.setattr("dmotion_bench.scoring.score.unsound_prediction", lambda *_: TOGETHER)

    [finding] = check_entry(sound, workspace, shared=shared).findings
    assert finding.startswith(
        "remarks.contract: the entry says None, it is 'the model breaks it: predict gives a frame"
    )


@pytest.mark.parametrize("error", [StorageFull("no space left."), CacheNotWritable("the cache can be kept nowhere.")])
def test_what_this_machine_lacks_is_not_held_against_an_entry(
    workspace: Workspace, sound: Entry, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(check, "score_model", fail)
    verdict = check_entry(sound, workspace)
    assert (verdict.findings, verdict.missing) == ((), (f"this machine: {error}",))


def test_a_data_set_without_its_labels_leaves_an_entry_unchecked(workspace: Workspace, sound: Entry) -> None:
    shutil.rmtree(workspace.data / "grid_world-tiny" / "labels")
    verdict = check_entry(sound, workspace, QUICK)
    assert verdict.findings == ()
    assert [one.partition(":")[0] for one in verdict.missing] == ["labels"]


def test_a_run_without_a_report_is_not_checked(workspace: Workspace) -> None:
    shutil.rmtree(workspace.runs / RUN / "report")
    [verdict] = check.check_paths([Path(RUN)], workspace)
    assert verdict.findings == ()
    assert "has no whole report; score it with" in verdict.missing[0]


def test_a_forged_table_of_a_data_set_is_found(workspace: Workspace, sound: Entry) -> None:
    """Its fingerprint says nothing of the tables: only the recordings do."""
    dataset = Dataset.open(workspace.data / "grid_world-tiny")
    table = pq.read_table(dataset.path / EPISODES)
    place = table.schema.get_field_index("seed")
    forged = table.set_column(place, table.schema.field(place), pc.add(table["seed"], 1))
    pq.write_table(forged, dataset.path / EPISODES, compression="zstd")
    tables = {**dataset.manifest.tables, EPISODES: file_facts(dataset.path / EPISODES)}
    dataclasses.replace(dataset.manifest, tables=tables).write(dataset.path)
    assert Dataset.open(dataset.path).fingerprint == dataset.fingerprint

    [finding] = check_entry(sound, workspace, QUICK).findings
    assert finding.startswith(
        "data set: grid_world-tiny/episodes.parquet describes other episodes than video/shard-0000"
    )
    assert "dmbench data repair" in finding


def test_a_copy_of_the_data_set_under_another_name_is_not_taken_for_it(workspace: Workspace, sound: Entry) -> None:
    shutil.copytree(workspace.data / "grid_world-tiny", workspace.data / "a-copy")
    assert check_entry(sound, workspace, QUICK).holds

    shutil.rmtree(workspace.data / "grid_world-tiny")
    findings = check_entry(sound, workspace, QUICK).findings
    assert findings == ("dataset.name: the entry says 'grid_world-tiny', it is 'a-copy'",)


def test_a_changed_frame_cache_is_found(workspace: Workspace, sound: Entry) -> None:
    (path,) = (workspace.data / "grid_world-tiny/cache").glob("*.arrow")
    raw = bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 255
    path.write_bytes(raw)

    assert any("cache/" in finding for finding in check_entry(sound, workspace, QUICK).findings)


@pytest.mark.parametrize("which", ["current", "truth", "predicted"])
def test_a_retouched_picture_is_found(
    workspace: Workspace, sound: Entry, changed: Changed, shared: SharedSamples, which: str
) -> None:
    pictures = copy.deepcopy(list(sound.pictures))
    frame = from_png(pictures[0][which]).copy()
    frame[40:44, 40:44] ^= 128
    pictures[0] = dict(pictures[0]) | {which: to_png(frame)}

    findings = check_entry(changed(pictures=pictures), workspace, shared=shared).findings

    assert any(repr(which) in finding for finding in findings)


def test_pictures_of_chosen_steps_are_found(
    workspace: Workspace, sound: Entry, changed: Changed, shared: SharedSamples
) -> None:
    verdict = check_entry(changed(pictures=list(sound.pictures)[1:]), workspace, shared=shared)

    assert any(finding.startswith("pictures: of other steps") for finding in verdict.findings)


def test_a_forged_picture_before_the_true_one_of_its_step_is_found(
    workspace: Workspace, sound: Entry, changed: Changed, shared: SharedSamples
) -> None:
    other = dict(sound.pictures[0]) | {"truth": sound.pictures[0]["current"]}

    verdict = check_entry(changed(pictures=[other, *sound.pictures]), workspace, shared=shared)

    assert verdict.findings == ("pictures: a step stands there twice",)
