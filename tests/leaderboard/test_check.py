"""A sound entry holds; whatever is changed in what it says is found."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
import torch
from known_model import Known

from dmotion_bench.errors import UsageError
from dmotion_bench.learning.runs.run import Conditions, Run
from dmotion_bench.scoring.figures import figures_of
from dmotion_bench.scoring.references import published_results
from dmotion_bench.scoring.score import Scores, score_run
from dmotion_bench.scoring.settings import METRICS
from dmotion_bench.scoring.shared_samples import SharedSamples
from dmotion_bench.scoring.statistics import Estimate
from dmotion_bench.workspace import Workspace
from leaderboard.build import entry_of_run
from leaderboard.check import CheckSettings, check_entry, check_paths
from leaderboard.entry import Entry, published_entry, schema_text
from leaderboard.entry_file import read_entries, write_entry
from leaderboard.paper import label_count
from leaderboard.rescored import same_scores
from leaderboard.verdict import Findings

from .conftest import SETTINGS

pytestmark = pytest.mark.slow

Changed = Callable[..., Entry]
QUICK = CheckSettings(score=False)
RUN = "dmotion-grid_world-tiny-s0"


def test_a_sound_entry_holds(workspace: Workspace, sound: Entry, shared: SharedSamples) -> None:
    verdict = check_entry(sound, workspace, shared=shared)

    assert verdict.findings == ()
    assert verdict.holds
    assert verdict.figures == len(sound.figures)
    assert verdict.samples == sound.content["samples"]["rows"]


def test_a_quick_check_counts_the_figures_that_it_computes_from_the_samples(workspace: Workspace, sound: Entry) -> None:
    verdict = check_entry(sound, workspace, QUICK)

    assert (verdict.holds, verdict.figures, verdict.samples) == (True, len(sound.figures), 0)


def _figures(entry: Entry, name: str, **parts: Any) -> dict[str, Any]:
    figures = copy.deepcopy(dict(entry.figures))
    figures[name] |= parts
    return figures


@pytest.mark.parametrize("part", ["mean", "std", "low", "high", "n"])
@pytest.mark.parametrize("name", ["mse", "ssim", "position_error", "rollout_mse[2]"])
def test_every_part_of_every_figure_counts(
    workspace: Workspace, sound: Entry, changed: Changed, name: str, part: str
) -> None:
    value = sound.figures[name][part]
    bent = value + 1 if part == "n" else (1e-6 if value is None else value * (1 + 1e-6) + 1e-6)

    verdict = check_entry(changed(figures=_figures(sound, name, **{part: bent})), workspace, QUICK)

    assert any(name in finding and part in finding for finding in verdict.findings)


def test_a_model_whose_code_was_changed_since_the_training_is_named(workspace: Workspace, sound: Entry) -> None:
    said = "the code of the model was changed since the training (baselines.dmotion)"
    file = workspace.runs / RUN / "run.json"
    before = check_entry(sound, workspace, QUICK)
    file.write_text(json.dumps(json.loads(file.read_text()) | {"code": {"baselines.dmotion": "0" * 64}}))

    verdict = check_entry(sound, workspace, QUICK)

    assert not any(said in remark for remark in before.remarks)
    assert any(said in remark for remark in verdict.remarks)
    assert verdict.findings == before.findings == ()


def test_an_interval_over_fewer_episodes_than_today_still_holds_and_counts(
    workspace: Workspace, changed: Changed, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the first entries have them; what is published today is not thrown over by another rule."""
    entry = changed()
    of_six = partial(figures_of, fewest=6)  # the entry has intervals over 5
    monkeypatch.setattr("leaderboard.comparison.figures_of", lambda *of, **how: of_six(*of, **how))
    assert entry.figures["mse"]["low"] is not None

    assert check_entry(entry, workspace, QUICK).holds
    bent = changed(figures=_figures(entry, "mse", low=entry.figures["mse"]["low"] * 1.001))
    assert any("mse.low" in finding for finding in check_entry(bent, workspace, QUICK).findings)


def test_an_entry_has_the_five_parts_of_a_figure(sound: Entry) -> None:
    figures = [sound.figures, *sound.content["reference"].values()]
    assert {tuple(figure) for own in figures for figure in own.values()} == {("mean", "std", "low", "high", "n")}


def test_no_figure_is_left_out(workspace: Workspace, sound: Entry, changed: Changed) -> None:
    for name in list(sound.figures)[::9]:
        figures = {other: figure for other, figure in sound.figures.items() if other != name}
        assert not check_entry(changed(figures=figures), workspace, QUICK).holds, name
    added = dict(sound.figures) | {"agent_iou": sound.figures["ssim"]}
    assert not check_entry(changed(figures=added), workspace, QUICK).holds


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"model": "clasp"}, "model: "),
        ({"arch": "paper"}, "arch: "),
        ({"seed": 7}, "seed: "),
        ({"preset": "paper"}, "preset: "),
        ({"run": "another"}, "run: "),
        ({"versions": {"python": "2.7"}}, "versions: "),
        ({"remarks": {}}, "remarks: "),
        ({"training": {"seconds": 0.5}}, "training.seconds: "),
        ({"training": {}}, "training.seconds: "),
        ({"training": {}}, "training: "),
        ({"protocol": "dmbench-2"}, "protocol: the entry says 'dmbench-2', it is 'dmbench-1'"),
        ({"labels": {"asked": "one-shot", "given": {"demonstrations": 4}, "total": 0}}, "labels.total: "),
        ({"labels": {"asked": "none", "given": {"demonstrations": 4}, "total": 4}}, "labels.asked: "),
        ({"by_episode": {}}, "by_episode: "),
        ({"reference": {}}, "reference.copy_last"),
    ],
)
def test_what_the_entry_says_of_itself_counts(
    workspace: Workspace, changed: Changed, content: dict[str, Any], said: str
) -> None:
    findings = check_entry(changed(**content), workspace, QUICK).findings

    assert any(finding.startswith(said) for finding in findings), findings


def test_what_earlier_reports_did_not_say_of_a_training_may_be_missing_there_alone(
    workspace: Workspace, sound: Entry
) -> None:
    folder = workspace.runs / RUN
    manifest = json.loads((folder / "run.json").read_text())
    manifest["result"]["threads"] = 1
    (folder / "run.json").write_text(json.dumps(manifest))
    assert check_entry(sound, workspace, QUICK).findings == ()  # its report says nothing of them either

    report = json.loads((folder / "report/report.json").read_text())
    report["training"]["threads"] = 1
    (folder / "report/report.json").write_text(json.dumps(report))
    findings = check_entry(sound, workspace, QUICK).findings
    assert [one.startswith("training: the entry says ") for one in findings] == [True]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"weights": "0" * 64}, "weights: no run"),
        ({"code": "0.1.0+000000000000"}, "version: the entry was scored by version '0.1.0+0000"),
        ({"scoring_version": 7}, "version: the entry was scored by version 7, this is version 1"),
        ({"dataset": {"name": "away", "environment": "grid_world", "fingerprint": "0" * 64}}, "data set: none"),
    ],
)
def test_what_is_not_here_makes_an_entry_neither_sound_nor_wrong(
    workspace: Workspace, changed: Changed, content: dict[str, Any], said: str
) -> None:
    verdict = check_entry(changed(**content), workspace, QUICK)

    assert (verdict.findings, verdict.holds) == ((), False)
    assert [one.startswith(said) for one in verdict.missing] == [True]


@pytest.mark.parametrize(
    ("where", "part", "said"),
    [
        ("dataset", {"name": "grid_world-paper"}, "dataset.name: "),
        ("dataset", {"environment": "robot_push"}, "dataset.environment: "),
        ("dataset", {"version": 3}, "dataset.version: the entry says 3, it is 2"),
        ("samples", {"sha256": "0" * 64}, "samples.sha256: "),
        ("samples", {"rows": 3}, "samples.rows: "),
        ("settings", {"resamples": 3}, "settings.resamples is 3"),
        ("settings", {"resamples": 10**12}, "settings.resamples is"),
        ("settings", {"protocol": "paper"}, "settings.protocol: "),
        ("settings", {"precision": "int8"}, "settings.precision is"),
        ("settings", {"control_column": "x" * 300}, "settings.control_column is 'xxx"),  # longer than a file's name
    ],
)
def test_hashes_and_settings_count(
    workspace: Workspace, sound: Entry, changed: Changed, where: str, part: dict[str, Any], said: str
) -> None:
    findings = check_entry(changed(**{where: sound.content[where] | part}), workspace, QUICK).findings

    assert any(finding.startswith(said) for finding in findings), findings


def test_the_sums_by_episode_count(workspace: Workspace, sound: Entry, changed: Changed) -> None:
    sums = copy.deepcopy(dict(sound.by_episode))
    sums["mse"]["sum"][0] *= 1.0001

    assert not check_entry(changed(by_episode=sums), workspace, QUICK).holds


def test_a_reference_s_figure_counts(workspace: Workspace, sound: Entry, changed: Changed) -> None:
    reference = copy.deepcopy(dict(sound.content["reference"]))
    for name in ("copy_last", "paper"):
        bent = copy.deepcopy(reference)
        bent[name]["mse"]["mean"] *= 2
        findings = check_entry(changed(reference=bent), workspace, QUICK).findings
        assert any(finding.startswith(f"reference.{name}") for finding in findings)


def test_the_model_is_no_reference_beside_itself(workspace: Workspace, sound: Entry, changed: Changed) -> None:
    reference = dict(sound.content["reference"]) | {"model": {"mse": dict(sound.figures["mse"]) | {"mean": 1e6}}}

    verdict = check_entry(changed(reference=reference), workspace, QUICK)

    assert verdict.findings == ("reference.model: the model is no reference",)


def test_published_rows_are_held_against_the_table() -> None:
    row = published_results()[0]
    entry = published_entry(row, label_count(row.environment, row.labels))
    figures = {"mse": dict(entry.figures["mse"]) | {"mean": 1.0}}
    nowhere = Workspace(Path("/nowhere"))

    assert check_entry(entry, nowhere).holds
    assert not check_entry(Entry(dict(entry.content) | {"figures": figures}), nowhere).holds
    assert not check_entry(Entry(dict(entry.content) | {"source": "me"}), nowhere).holds
    other = check_entry(Entry(dict(entry.content) | {"model": "another"}), nowhere)
    assert not other.holds  # nobody can tell
    assert not other.findings
    assert "nothing to hold it against" in other.missing[0]


def test_folders_files_and_runs_can_be_checked(workspace: Workspace, sound: Entry, tmp_path: Path) -> None:
    folder = tmp_path / "entries"
    sent = write_entry(sound, folder)
    (folder / "broken.json").write_text("{")

    verdicts = check_paths([folder, Path(RUN)], workspace, quick=True)

    assert [verdict.entry for verdict in verdicts] == ["broken.json", f"{RUN}, {sent.name}", RUN]
    assert [verdict.holds for verdict in verdicts] == [False, True, True]


def test_the_weights_of_one_training_are_not_those_of_a_second(workspace: Workspace) -> None:
    copied = workspace.runs / "another-training"
    shutil.copytree(workspace.runs / RUN, copied)
    for file in ("run.json", "report/report.json"):
        text = (copied / file).read_text()
        assert '"seed": 0,' in text
        (copied / file).write_text(text.replace('"seed": 0,', '"seed": 1,', 1).replace(RUN, copied.name))

    alone = check_paths([copied], workspace, quick=True)
    both = check_paths([workspace.runs / RUN, copied], workspace, quick=True)

    assert [verdict.findings for verdict in alone] == [()]
    assert not any(verdict.holds for verdict in both)
    said = "weights: {} has the same and calls them a training with seed {}, here it is {}; they are one training"
    assert [verdict.findings for verdict in both] == [(said.format(copied.name, 1, 0),), (said.format(RUN, 0, 1),)]


def test_the_folder_of_a_page_stands_for_its_entries(tmp_path: Path) -> None:
    rows = published_results()[:2]
    for row in rows:
        write_entry(published_entry(row, label_count(row.environment, row.labels)), tmp_path / "site" / "entries")
    (tmp_path / "site" / "schema.json").write_text(schema_text())
    nowhere = Workspace(tmp_path / "nowhere")

    assert [verdict.holds for verdict in check_paths([tmp_path / "site"], nowhere)] == [True, True]
    assert [len(read_entries(tmp_path / "site" / inner)) for inner in ("", "entries")] == [2, 2]
    with pytest.raises(UsageError, match=r"there is no entry '.*gone\.json'"):
        check_paths([tmp_path / "site" / "entries" / "gone.json"], nowhere)


def test_a_check_computes_with_the_run_s_number_of_threads(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[int] = []

    class Counting(Known):
        def predict(self, previous: torch.Tensor, current: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
            seen.append(torch.get_num_threads())
            return super().predict(previous, current, action)

    run = Run.open(workspace.runs / RUN)
    run.begin(Conditions(threads=2, precision="float32"))
    run.finish({**(run.result or {}), "threads": 2})
    score_run(run.path, settings=SETTINGS)
    entry = entry_of_run(run.path)
    assert entry.content["training"]["threads"] == 2

    monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Counting)
    assert check_entry(entry, workspace).holds
    assert set(seen) == {2}

    monkeypatch.setenv("OMP_THREAD_LIMIT", "1")
    verdict = check_entry(entry, workspace)
    assert verdict.findings == ()
    assert [missing for missing in verdict.missing if missing.startswith("threads: the run computes with 2 threads")]
    assert check_entry(entry, workspace, CheckSettings(score=False)).holds


def test_figures_that_came_later_may_be_missing_and_are_held_to_what_they_are(
    workspace: Workspace, sound: Entry, changed: Changed
) -> None:
    """An entry from before there were probes still holds; a probe's score that it states must be the one found."""

    def probe(mean: float) -> Estimate:
        return Estimate(mean=mean, std=0.1, low=mean - 0.1, high=mean + 0.1, n=50)

    def found(entry: Entry) -> list[str]:
        figures = {name: Estimate(**figure) for name, figure in entry.content["figures"].items()}
        mine = {name: one for name, one in figures.items() if not name.startswith("control")}
        later = {"probe_mlp[movers]": probe(0.001), "state_probe[agent_place]": probe(0.9)}
        check = Findings(entry=entry)
        same_scores(check, Scores(samples=pa.table({}), figures=mine | later, reference={}), METRICS)
        return check.wrong

    assert found(sound) == []
    for name, mean, holds in (
        ("probe_mlp[movers]", 0.004, True),
        ("probe_mlp[movers]", 0.4, False),
        ("state_probe[agent_place]", 0.905, True),
        ("state_probe[agent_place]", 0.5, False),
    ):
        stated = changed(figures={**sound.figures, name: probe(mean).to_json()})
        assert (found(stated) == []) == holds
