"""``dmbench leaderboard``: what it prints, what it passes on, what it refuses."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import typer
from click.testing import Result
from typer.testing import CliRunner

from dmotion_bench import registry
from dmotion_bench.api import leaderboard
from dmotion_bench.cli import leaderboard as command
from dmotion_bench.errors import DmbenchError, RunError, UnknownName, UsageError
from dmotion_bench.scoring.statistics import Estimate
from leaderboard.build import Built
from leaderboard.comparison import Difference
from leaderboard.server import LeaderboardServer
from leaderboard.verdict import Verdict

ROOT = Path(__file__).parents[2]


@dataclass
class Parts:
    """Stands in for the leaderboard's package; keeps what it was asked."""

    asked: list[tuple[Any, ...]] = field(default_factory=list)

    def build(self, runs: list[Path], entries: list[Path], out: Path, *, on_progress: Any) -> Built:
        self.asked.append((runs, entries, out))
        return Built(
            page=out / "index.html",
            measured=2,
            published=22,
            left_out={"a": "it is not scored"},
            doubtful=("b-1.json",),
        )

    def check(
        self, paths: list[Path], workspace: Any, *, quick: bool, differing: float, draw: int | None, on_progress: Any
    ) -> list[Verdict]:
        self.asked.append((paths, quick, differing, draw))
        return [
            Verdict(entry="good", findings=(), remarks=("old",), figures=5, samples=70),
            Verdict(entry="bad", findings=("mse.mean is said to be 1 and is 2",)),
            Verdict(entry="away", findings=(), missing=("weights: no run",)),
        ][: 1 if quick else 3]

    def compare(
        self, first: Path, second: Path, dataset: Any, split: str, *, warn: Callable[[str], None]
    ) -> list[Difference]:
        self.asked.append((first, second, split))
        warn("control of 'a' and 'b' cannot be compared.")
        clear = Estimate(mean=-2.0, std=1.0, low=-3.0, high=-1.0, n=70)
        unclear = Estimate(mean=0.1, std=1.0, low=-1.0, high=1.2, n=70)
        of_two = Estimate(mean=-0.3, std=0.1, low=None, high=None, n=7, episodes=2)
        return [
            Difference(figure="mse", first=10.0, second=12.0, difference=clear),
            Difference(figure="position_error", first=1.1, second=1.0, difference=unclear),
            Difference(figure="miss_rate_objects", first=0.1, second=0.1, difference=unclear),
            Difference(figure="ssim", first=0.6, second=0.9, difference=of_two),
            *(
                Difference(figure=f"rollout_mse[{ahead}]", first=1.0, second=1.0, difference=unclear)
                for ahead in range(1, 5)
            ),
        ]


@pytest.fixture
def parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Parts:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    for name in ("a", "b"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "run.json").write_text("{}")
    parts = Parts()
    for home in (registry, leaderboard):
        monkeypatch.setattr(home, "leaderboard_part", lambda name: getattr(parts, name))
    return parts


@pytest.fixture
def run() -> Callable[..., Result]:
    app = typer.Typer()
    app.callback()(lambda: None)
    command.register(app)
    return lambda *words: CliRunner().invoke(app, ["leaderboard", *words])


def test_build_takes_all_runs_and_says_what_it_left_out(
    run: Callable[..., Result], parts: Parts, tmp_path: Path
) -> None:
    result = run("build")

    assert parts.asked == [([tmp_path / "runs/a", tmp_path / "runs/b"], [], tmp_path / "reports/leaderboard")]
    assert result.stdout.endswith("index.html: 2 measured and 22 published results\n")
    assert result.stderr.startswith("left out a: it is not scored\nleft in place: b-1.json has the name")


def test_build_takes_named_runs_and_others_entries(run: Callable[..., Result], parts: Parts, tmp_path: Path) -> None:
    result = run("build", "b", "--entries", "x.json", "--entries", "y", "--out", "site", "--json")

    assert parts.asked == [([tmp_path / "runs/b"], [Path("x.json"), Path("y")], Path("site"))]
    assert json.loads(result.stdout)["measured"] == 2
    assert isinstance(run("build", "c").exception, UnknownName)


def test_check_tells_what_does_not_hold_and_fails(run: Callable[..., Result], parts: Parts, tmp_path: Path) -> None:
    missing = run("check").exception
    assert isinstance(missing, UsageError)
    assert "build it with 'dmbench leaderboard build'" in str(missing)
    (tmp_path / "reports/leaderboard/entries").mkdir(parents=True)
    result = run("check")

    assert parts.asked == [([tmp_path / "reports/leaderboard/entries"], False, 0.0, None)]
    assert "holds          good (5 figures, 70 samples)" in result.stdout
    assert "DOES NOT HOLD  bad" in result.stdout
    assert "    mse.mean is said to be 1 and is 2" in result.stdout
    assert "not checked    away" in result.stdout
    assert isinstance(result.exception, RunError)
    assert str(result.exception) == "1 of 3 entries does not hold; 1 of 3 could not be checked here."


def test_check_is_silent_about_sound_entries(run: Callable[..., Result], parts: Parts) -> None:
    result = run("check", "e.json", "--quick", "--differing", "0.01", "--draw", "3", "--json")

    assert parts.asked == [([Path("e.json")], True, 0.01, 3)]
    assert result.exit_code == 0
    (verdict,) = json.loads(result.stdout)["verdicts"]
    sound = {"holds": True, "entry": "good", "findings": [], "missing": [], "remarks": ["old"]}
    assert verdict == sound | {"figures": 5, "samples": 70, "weights": None, "seed": None, "run": None}


def test_compare_says_better_only_where_the_interval_does(run: Callable[..., Result], parts: Parts) -> None:
    result = run("compare", "a", "b")
    lines = [line.strip() for line in result.stdout.splitlines()]

    (mse,) = (line.split() for line in lines if line.startswith("MSE ") and "ahead" not in line)
    (position,) = (line.split() for line in lines if line.startswith("position error"))
    assert mse == ["MSE", "10.0", "12.0", "-2.00", "-3.00", "to", "-1.00", "first"]
    assert position[-1] == "tied"
    (ssim,) = (line for line in lines if line.startswith("SSIM"))
    assert ssim.endswith("unknown: 2 episodes")
    assert [line[:11] for line in lines if " ahead" in line] == ["MSE 1 ahead", "MSE 2 ahead", "MSE 4 ahead"]
    assert not any("miss_rate_objects" in line for line in lines)
    assert any("miss_rate_objects" in line for line in run("compare", "a", "b", "--all").stdout.splitlines())
    assert result.stderr == "left out: control of 'a' and 'b' cannot be compared.\n"


def test_compare_takes_the_split_that_both_were_scored_on(run: Callable[..., Result], parts: Parts) -> None:
    assert run("compare", "a", "b").exit_code == run("compare", "a", "b", "--split", "validation").exit_code == 0
    assert [split for _, _, split in parts.asked] == ["test", "validation"]
    assert run("compare", "a", "b", "--split", "train").exit_code != 0


def test_compare_takes_all_trainings_whose_names_differ_in_the_seed(
    run: Callable[..., Result], parts: Parts, tmp_path: Path
) -> None:
    for name in ("c-s10", "c-s2", "c-b-s0", "c-s2x"):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "run.json").write_text("{}")
    result = run("compare", "a", "c")
    as_json = json.loads(run("compare", "a", "c", "--json").stdout)

    trainings = [tmp_path / "runs" / name for name in ("c-s2", "c-s10")]
    assert [asked[:2] for asked in parts.asked] == [([tmp_path / "runs/a"], trainings)] * 2
    assert "a against c (2 trainings, s2 to s10)" in result.stdout
    assert "intervals over episodes and trainings" in " ".join(result.stdout.split())
    assert (as_json["first"], as_json["second"]) == (str(tmp_path / "runs/a"), list(map(str, trainings)))


def test_compare_refuses_a_run_against_itself(run: Callable[..., Result], parts: Parts, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "runs/a")
    for other in ("a", str(tmp_path / "runs/a"), str(tmp_path / "link")):
        error = run("compare", "a", other).exception
        assert isinstance(error, UsageError)
        assert "is named on both sides; name two models" in str(error)
    assert not parts.asked


def test_compare_as_json(run: Callable[..., Result], parts: Parts) -> None:
    found = json.loads(run("compare", "a", "b", "--json").stdout)

    assert [one["better"] for one in found["differences"]][:4] == ["first", None, None, None]
    said = ["first", "tied", "tied", "unknown: 2 episodes"]
    assert [one["verdict"] for one in found["differences"]][:4] == said
    assert set(found["differences"][0]["difference"]) == {"mean", "std", "low", "high", "n"}


def test_every_part_is_an_entry_point_that_exists() -> None:
    points = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"][registry.LEADERBOARD]

    assert set(points) == {"build", "check", "compare", "results", "serve"}
    for value in points.values():
        module, _, attribute = value.partition(":")
        assert callable(getattr(import_module(module), attribute))


def test_the_port_that_is_served_is_said(
    run: Callable[..., Result], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DMBENCH_QUIET", raising=False)
    monkeypatch.setattr(LeaderboardServer, "serve_forever", lambda self: None)
    (tmp_path / "index.html").write_text("")
    said = run("serve", str(tmp_path), "--port", "0").output
    found = re.search(r"http://127\.0\.0\.1:(\d+)/", said)
    assert found is not None
    assert f"'ssh -L {found[1]}:127.0.0.1:{found[1]} HOST'" in said


def test_a_missing_package_is_said(run: Callable[..., Result], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "registered", lambda group: [])

    result = run("serve")

    assert isinstance(result.exception, DmbenchError)
    assert "pip install" in str(result.exception)
