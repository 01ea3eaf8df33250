"""``dmbench score``: what it prints, what it refuses, what it goes on after."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest
import typer
from click.testing import Result
from known_model import spec_with
from typer.testing import CliRunner

from dmotion_bench.api.scoring import score_runs
from dmotion_bench.cli import score as command
from dmotion_bench.errors import RunError, RunMismatch, RunMissing, StorageFull, UnknownName, UsageError
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.report import Report
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.side_by_side import ScoreJob, ScoreOutcome

FIGURE = {"mean": 15.04, "std": 90.0, "low": 12.5, "high": 18.0, "n": 700}
SPEC = spec_with(preset="small", dataset="grid_world-small")
PUBLISHED = {"mean": 14.3, "std": 99.8, "low": None, "high": None, "n": None}


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    """Calls the command in a workspace with the runs a, b and broken; scoring itself is tested elsewhere."""
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    for name in ("a", "b", "broken"):
        Run.create_or_open(tmp_path / "runs" / name, SPEC, dataset_path=tmp_path, versions={}).write()
    app = typer.Typer()
    app.callback()(lambda: None)
    command.register(app)

    def score_run(
        path: Path, *, metrics: tuple[str, ...], settings: ScoreSettings, data: Path | None = None, **_: object
    ) -> Report:
        if path.name == "broken":
            raise RunMissing("the run 'broken' is not finished")
        if data is not None and path.name == "b":
            raise RunMismatch("'b' was trained in another environment")
        own = {"trained_on": {"name": "grid_world-small", "fingerprint": "f"}}
        mse = FIGURE | {"mean": {"a": 15.04, "b": 11.0}[path.name]}
        return Report(
            run=path.name,
            model="dmotion",
            arch="compact",
            preset="small",
            seed=0,
            labels={"asked": "one-shot", "given": {"demonstrations": 4}, "total": 4},
            dataset={"name": data.name if data else "grid_world-small", "environment": "grid_world", "fingerprint": "f"}
            | (own if data else {}),
            weights="w",
            settings={"metrics": metrics, "horizon": settings.horizon, "split": settings.split},
            training={"epochs": 1},
            versions={},
            figures={"mse": mse, "psnr": FIGURE, "rollout_mse[5]": FIGURE},
            reference={"copy_last": {"mse": FIGURE | {"mean": 1848.0}}, "paper": {"mse": PUBLISHED}},
            remarks={"paper": "Yuan et al. 2021"},
        )

    monkeypatch.setattr("dmotion_bench.api.scoring.score_run", score_run)
    return lambda *words: CliRunner().invoke(app, ["score", *words])


def test_json_has_the_names_that_scripts_rely_on(run: Callable[..., Result]) -> None:
    result = run("a", "--json")

    (report,) = json.loads(result.stdout)["reports"]
    assert set(report) == {"run", "model", "arch", "dataset", "labels", "seed", "figures", "reference"}
    assert (Path(report["run"]).name, report["dataset"], report["labels"]) == ("a", "grid_world-small", "one-shot")
    assert set(report["figures"]["mse"]) == {"mean", "std", "low", "high", "n"}
    assert report["reference"]["paper"]["mse"]["mean"] == 14.3


@pytest.fixture
def shifted(tmp_path: Path) -> str:
    (tmp_path / "data/shifted").mkdir(parents=True)
    (tmp_path / "data/shifted/dataset.json").write_text("{}")
    return "shifted"


def test_another_data_set_is_named_with_what_the_run_was_trained_on(run: Callable[..., Result], shifted: str) -> None:
    table = run("a", "--data", shifted).stdout
    assert "a: dmotion on shifted (trained on grid_world-small), test episodes" in table
    assert "runs/a/report/on/shifted/" in table.replace("\n", "")
    (report,) = json.loads(run("a", "--data", shifted, "--json").stdout)["reports"]
    assert (report["dataset"], report["trained_on"]) == ("shifted", "grid_world-small")


def test_of_all_runs_those_that_do_not_fit_the_data_are_left_out(
    run: Callable[..., Result], shifted: str, tmp_path: Path
) -> None:
    (tmp_path / "runs/broken/run.json").unlink()
    result = run("--all", "--workers", "1", "--data", shifted)
    assert result.exit_code == 0
    assert "a (trained on grid_world-small)" in result.stdout
    assert "left out: 'b' was trained in another environment" in result.stderr


def test_the_table_shows_ours_beside_the_papers(run: Callable[..., Result]) -> None:
    lines = run("a", "--metrics", "prediction").stdout.splitlines()

    (row,) = (line for line in lines if line.split()[:2] == ["MSE", "15.0"])
    assert row.split() == ["MSE", "15.0", "±", "90.0", "12.5", "to", "18.0", "700", "14.3", "±", "99.8", "1,848"]
    assert any("PSNR [dB]" in line for line in lines)


def test_a_missing_interval_is_explained_where_episodes_are_too_few(
    run: Callable[..., Result], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "too few episodes" not in run("a").stdout
    monkeypatch.setitem(FIGURE, "episodes", 2)
    assert "too few episodes" not in run("a").stdout
    monkeypatch.setitem(FIGURE, "low", None)
    monkeypatch.setitem(FIGURE, "high", None)
    lines = run("a").stdout.splitlines()
    assert "  95% interval: too few episodes for an interval: 2, it takes 5" in [line.rstrip() for line in lines]
    (row,) = (line for line in lines if line.split()[:2] == ["MSE", "15.0"])
    assert row.split() == ["MSE", "15.0", "±", "90.0", "700", "2", "14.3", "±", "99.8", "1,848"]
    monkeypatch.setitem(FIGURE, "episodes", 7)  # as of codes, whose figures have no interval at all
    assert "too few episodes" not in run("a").stdout


def test_many_runs_stand_in_one_table_the_best_first(run: Callable[..., Result]) -> None:
    result = run("a", "b")

    firsts = [line.split()[0] for line in result.stdout.splitlines() if line.strip()]
    assert result.exit_code == 0
    assert firsts.index("b") < firsts.index("a") < firsts.index("copy")


def test_a_model_whose_code_was_changed_is_named_once(run: Callable[..., Result], tmp_path: Path) -> None:
    assert "code of the model" not in run("a", "b").stderr
    for name in ("a", "b"):
        file = tmp_path / "runs" / name / "run.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | {"code": {"baselines.dmotion": "0" * 64}}))
    result = run("a", "b")
    assert result.exit_code == 0
    assert result.stderr.count("the code of the model 'dmotion' was changed since") == 1


def test_all_goes_on_after_a_run_that_fails(run: Callable[..., Result]) -> None:
    result = run("--all", "--workers", "1", "--json")

    assert [Path(report["run"]).name for report in json.loads(result.stdout)["reports"]] == ["a", "b"]
    assert isinstance(result.exception, RunError)
    assert "1 of 3 runs could not be scored" in str(result.exception)
    assert "broken: the run 'broken' is not finished" in str(result.exception)


def test_a_full_disk_ends_it(run: Callable[..., Result], monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def full(path: Path, **_: object) -> Report:
        asked.append(path.name)
        raise StorageFull("no space left on the device; free some.")

    monkeypatch.setattr("dmotion_bench.api.scoring.score_run", full)
    result = run("--all", "--workers", "1")

    assert isinstance(result.exception, StorageFull)
    assert asked == ["a"]


@pytest.mark.parametrize(("words", "runs", "renews"), [(["a"], ["a"], True), (["--all"], ["a", "b", "broken"], False)])
def test_workers_share_named_runs_as_well_as_all(
    run: Callable[..., Result],
    shifted: str,
    monkeypatch: pytest.MonkeyPatch,
    words: list[str],
    runs: list[str],
    renews: bool,
) -> None:
    asked = list[ScoreJob]()

    def score(jobs: Sequence[ScoreJob], _executor: object, *, progress: Path) -> Iterator[ScoreOutcome]:
        assert progress.is_dir()
        asked.extend(jobs)
        yield from (ScoreOutcome(run=job.run, error="it does not fit.", unfit=True) for job in jobs)

    monkeypatch.setattr("dmotion_bench.api.side_by_side.score_side_by_side", score)
    result = run(*words, "--workers", "2", "--data", shifted)
    assert [job.run.name for job in asked] == runs
    assert {job.renew for job in asked} == {renews}
    if renews:  # who names a run wants to know why it is not scored
        assert "a: it does not fit." in str(result.exception)
    else:
        assert result.exit_code == 0
        assert "left out: it does not fit." in result.stderr


@pytest.mark.parametrize(("groups", "workers"), [(1, None), (3, 2)])
def test_the_control_of_one_run_of_all_is_shared_among_the_processors(
    run: Callable[..., Result], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, groups: int, workers: int | None
) -> None:
    for other in ("b", "broken"):
        shutil.rmtree(tmp_path / "runs" / other)
    given = list[int | None]()

    def executor(_: str, workers: int | None, **_options: object) -> object:
        given.append(workers)
        return object()

    def score(jobs: Sequence[ScoreJob], *_: object, **_options: object) -> Iterator[ScoreOutcome]:
        yield from (ScoreOutcome(run=job.run, error="it has no tasks.") for job in jobs)

    monkeypatch.setattr("dmotion_bench.api.side_by_side.available_workers", lambda _: 2)
    monkeypatch.setattr("dmotion_bench.api.side_by_side.control_shares", lambda job: [job] * groups)
    monkeypatch.setattr("dmotion_bench.api.side_by_side.make_executor", executor)
    monkeypatch.setattr("dmotion_bench.api.side_by_side.score_side_by_side", score)
    result = run("--all", "--metrics", "control")
    if workers is None:  # as the run that is named
        assert (given, result.stdout) == ([], run("a", "--metrics", "control").stdout)
    else:
        assert given == [workers]
        assert "a: it has no tasks." in str(result.exception)


def test_two_runs_of_one_name_that_fail_are_two_failures(run: Callable[..., Result], tmp_path: Path) -> None:
    shutil.copytree(tmp_path / "runs/broken", tmp_path / "elsewhere/broken")
    both = [tmp_path / "runs/broken", tmp_path / "elsewhere/broken"]

    _, failures = score_runs(both, None, ScoreSettings())
    told = str(run(*map(str, both)).exception)

    assert list(failures) == both
    assert told.startswith("2 of 2 runs could not be scored:")
    assert all(f"  {path}: the run 'broken' is not finished" in told for path in both)


def test_a_run_that_is_named_twice_is_scored_once(run: Callable[..., Result]) -> None:
    assert run("a", "a").stdout == run("a").stdout


def test_one_run_that_fails_says_why(run: Callable[..., Result]) -> None:
    assert isinstance(run("broken").exception, RunMissing)


@pytest.mark.parametrize(
    ("words", "error", "sentence"),
    [
        (["a", "--metrics", "predicton"], UnknownName, "did you mean 'prediction'"),
        (["a", "--metrics", ""], UsageError, "names no group"),
        (["oracle"], UsageError, "score it with '--metrics control'"),
        (["oracle", "--metrics", "prediction", "--column", "generic"], UsageError, "score it with '--metrics control'"),
        (["oracle", "--metrics", "control", "--split", "test", "--device", "cpu"], UsageError, "--split and --device."),
        (["oracle", "--column", "generic", "--batch-size", "8"], UsageError, "leave out --batch-size."),
        (["a", "--planner", "icem"], UsageError, "--planner would change nothing without control"),
        (
            ["a", "--metrics", "rollout", "--tasks", "2", "--objective", "tracked"],
            UsageError,
            "--objective and --tasks",
        ),
        (["--all", "--planner-set", "samples=30"], UsageError, "--planner-set would change nothing"),
        (["a", "oracle", "--metrics", "control"], UsageError, "name only references, or only runs"),
        (["a", "--data", "grid"], UnknownName, "no data set named 'grid'"),
        (["a", "--metrics", "control", "--planner", "cen"], UnknownName, "did you mean 'cem'"),
        (["a", "--split", "train"], UnknownName, "known: test, validation"),
        (["a", "--precision", "fp16"], UnknownName, "bf16"),
        (["a", "--device", "tpu"], UnknownName, "did you mean 'cpu'"),
        (["a", "--all"], UsageError, "not both"),
        (["a", "--executor", "slurn"], UnknownName, "did you mean 'slurm'"),
        (["c"], UnknownName, "no run named 'c'"),
        ([], UsageError, "several runs are here"),
    ],
)
def test_wrong_usage(run: Callable[..., Result], words: list[str], error: type[Exception], sentence: str) -> None:
    result = run(*words)

    assert isinstance(result.exception, error)
    assert sentence in str(result.exception)


def test_no_runs_at_all(run: Callable[..., Result], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path / "empty"))

    for words in ([], ["--all"]):
        assert "dmbench train dmotion" in str(run(*words).exception)
