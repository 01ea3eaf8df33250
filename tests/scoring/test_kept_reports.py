"""What was scored before: nothing is scored twice, and nothing stale is kept."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from dmotion_bench.cli.report_table import show_report
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.prediction import Execution
from dmotion_bench.scoring.report import SCORING_VERSION, read_report
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import Metric, ScoreSettings
from dmotion_bench.scoring.shared_samples import SharedSamples

QUICK = ScoreSettings(horizon=3, resamples=100)

MakeRun = Callable[..., Run]


@pytest.mark.slow
def test_figures_that_are_kept_say_by_which_versions_they_were_made(
    make_run: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, here = make_run(tmp_path / "run"), {"dmbench": "0.2", "torch": "1.0"}
    monkeypatch.setattr("dmotion_bench.scoring.run_report.versions", lambda: dict(here))

    def score(torch: str, metric: Metric) -> dict[str, str]:
        here["torch"] = torch
        return dict(score_run(run.path, metrics=(metric,), settings=QUICK).versions)

    assert score("1.0", "prediction") == {"dmbench": "0.2", "torch": "1.0"}
    assert score("2.0", "rollout") == {"dmbench": "0.2", "torch": "2.0", "torch (prediction)": "1.0"}
    mixed = score("3.0", "rollout")
    assert mixed == {"dmbench": "0.2", "torch": "3.0", "torch (prediction)": "1.0"}
    show_report(read_report(run.path / "report"), run.path)
    assert "scored earlier, with other versions: torch (prediction) 1.0" in capsys.readouterr().out
    assert score("3.0", "prediction") == {"dmbench": "0.2", "torch": "3.0"}


class Work:
    """Counts what is done."""

    def __init__(self) -> None:
        self.done: list[str] = []

    def __call__(self, what: str, done: int, total: int) -> None:
        assert 0 < done <= total
        if done == total:
            self.done.append(what)


@pytest.mark.slow
def test_a_report_without_control_is_kept_where_the_environment_is_not_installed(
    make_run: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path / "run")
    first = score_run(run.path, settings=QUICK)
    monkeypatch.setattr("dmotion_bench.entry_points.registered", lambda _: ())

    assert score_run(run.path, settings=QUICK) == first


@pytest.mark.slow
def test_what_is_up_to_date_is_kept_and_what_is_not_is_scored_again(
    make_run: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DMBENCH_CACHE", str(tmp_path / "cache"))  # in the usual one others left references
    path = make_run(tmp_path / "run").path

    def score(settings: ScoreSettings = QUICK, *metrics: str) -> list[str]:
        work = Work()
        score_run(
            path,
            metrics=metrics or ("prediction", "rollout"),
            settings=settings,
            how=Execution(progress=work),
            renew=False,
        )
        return work.done

    assert score(QUICK, "prediction") == ["references", "single steps"]
    only_single = read_report(path / "report")
    assert score() == ["rollouts of copy_last", "rollouts of model"]
    both = read_report(path / "report")
    assert score() == []
    assert both.settings["metrics"] == ["prediction", "rollout"]
    assert both.figures["mse"] == only_single.figures["mse"]
    assert {name for name in both.figures if "rollout" not in name} == set(only_single.figures)
    shorter = ScoreSettings(horizon=2, resamples=100)
    assert score(shorter) == ["rollouts of copy_last", "rollouts of model"]  # single steps have no horizon
    assert score(QUICK, "prediction") == []
    assert {"mse", "rollout_mse[2]"} <= set(read_report(path / "report").figures)
    assert "rollout_mse[3]" not in read_report(path / "report").figures
    again = ["single steps", "rollouts of model"]  # the references' samples stay in the data set's cache
    assert score(ScoreSettings(horizon=2, resamples=50)) == again
    with (path / "report/samples.parquet").open("ab") as handle:
        handle.write(b"changed")
    assert score(ScoreSettings(horizon=2, resamples=50)) == again


@pytest.mark.slow
def test_new_weights_make_a_report_stale(make_run: MakeRun, tmp_path: Path) -> None:
    score_run(make_run(tmp_path / "run").path, settings=QUICK, renew=False)
    (tmp_path / "run/run.json").unlink()

    changed = score_run(make_run(tmp_path / "run", offset=0.5).path, settings=QUICK, renew=False)

    assert changed.figures["mse"]["mean"] > changed.reference["copy_last"]["mse"]["mean"]


@pytest.mark.slow
def test_references_are_scored_once_for_many_runs(make_run: MakeRun, tmp_path: Path) -> None:
    shared, work = SharedSamples(on_disk=False), Work()
    how = Execution(progress=work)
    reports = [
        score_run(make_run(tmp_path / str(seed), seed=seed).path, settings=QUICK, how=how, shared=shared)
        for seed in range(2)
    ]

    assert work.done.count("references") == work.done.count("rollouts of copy_last") == 1
    assert reports[0].reference == reports[1].reference


@pytest.mark.slow
def test_a_report_that_names_code_is_of_the_version_that_the_code_stands_for(make_run: MakeRun, tmp_path: Path) -> None:
    """Reports of before versions were named open, and are scored again only if their code was another."""
    now = score_run(make_run(tmp_path / "run").path, settings=QUICK)
    file = tmp_path / "run/report/report.json"
    stored = json.loads(file.read_text())
    assert stored.pop("scoring_version") == SCORING_VERSION
    assert stored.pop("planning") == {}
    stored["settings"]["control_code"] = "0.1.0+4fa30b762c67"

    file.write_text(json.dumps(stored | {"code": "0.1.0+f4b222bec15f"}))
    known = read_report(file.parent)
    assert known is not None
    assert known.settings == now.settings | {"control_version": 1}
    assert score_run(tmp_path / "run", settings=QUICK, renew=False) == known

    file.write_text(json.dumps(stored | {"code": "0.1.0+c526c1fffaf4"}))
    older = read_report(file.parent)
    assert older is not None
    assert older.scoring_version == "0.1.0+c526c1fffaf4"
    assert score_run(tmp_path / "run", settings=QUICK, renew=False).scoring_version == SCORING_VERSION
