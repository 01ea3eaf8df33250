"""``dmbench data import`` and ``export``, as they are typed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer
from storage.foreign import foxglove_file, steady, video
from typer.testing import CliRunner, Result

from dmotion_bench.cli import data
from dmotion_bench.errors import DmbenchError, UnknownName
from dmotion_bench.storage.dataset import Dataset


@pytest.fixture
def workspace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    return tmp_path


def typed(*words: str | Path) -> Result:
    app = typer.Typer()
    data.register(app)
    return CliRunner().invoke(app, ["data", *map(str, words)], catch_exceptions=True)


@pytest.mark.slow
def test_in_and_out_again(workspace: Path) -> None:
    times = steady(30, hz=20)
    actions = [(t_ns, "stop") for t_ns in times]
    file = foxglove_file(workspace / "Run 1.mcap", video(30, 24, 32), times, actions=actions)
    done = typed("import", file, "--size", "16", "--actions", "/action", "--frames-per-episode", "5")

    folder = workspace / "data" / "imported-Run-1"
    assert done.exit_code == 0
    assert "3 episodes, 15 frames of 16x16 pixels at 10 Hz, from 30 pictures of 32x24 at 20.0 Hz" in done.stdout
    assert "actions, held out as labels: stop" in done.stdout
    assert "dmbench train dmotion --data imported-Run-1'" in done.stdout
    assert len(Dataset.open(folder)) == 3

    exported = typed("export", folder, "--json")
    assert json.loads(exported.stdout) | {"video_bytes": 0} == {
        "path": str(workspace / "exports" / "imported-Run-1-lerobot"),
        "episodes": 3,
        "frames": 15,
        "labels": True,
        "codec": "h264",
        "video_bytes": 0,
        "mse": 0.0,
        "largest_error": 0,
        "lossless": True,
    }
    again = typed("import", workspace / "exports" / "imported-Run-1-lerobot", "--size", "16", "--json")
    assert json.loads(again.stdout)["episodes"] == 3


@pytest.mark.slow
def test_one_clip_is_told_how_to_become_enough_episodes(workspace: Path) -> None:
    file = foxglove_file(workspace / "a.mcap", video(60, 16, 16), steady(60))
    done = typed("import", file, "--size", "16")
    assert (
        "need at least 10 episodes, here are 1: cut them shorter with '--frames-per-episode 6 --out DIR'" in done.stdout
    )
    again = typed("import", file, "--size", "16", "--frames-per-episode", "6", "--out", workspace / "more", "--json")
    assert json.loads(again.stdout)["episodes"] == 10
    (told,) = json.loads(again.stdout)["advice"]
    assert told.startswith("all episodes are parts of one recording, so test episodes are parts of what is trained on")

    short = typed("import", foxglove_file(workspace / "b.mcap", video(6, 16, 16), steady(6)), "--size", "16")
    assert "here are 1: import more recordings." in short.stdout


@pytest.mark.slow
def test_what_the_pictures_are_and_what_a_frame_shows_of_them(workspace: Path) -> None:
    (workspace / "in").mkdir()
    for name, hz in (("a", 10), ("b", 20)):
        in_ms = [round(t_ns / 1e6) * 10**6 for t_ns in steady(31, hz=hz)]
        foxglove_file(workspace / "in" / f"{name}.mcap", video(31, 24, 32), in_ms)
    thirty = [round(t_ns / 1e6) * 10**6 for t_ns in steady(31, hz=30)]
    file = foxglove_file(workspace / "c.mcap", video(31, 24, 32), thirty)
    cropped = "  frames show the middle 24x24 of 32x24 pixels; '--fit pad' keeps all\n"

    assert f"from 62 pictures of 32x24 at 10 to 20 Hz\n{cropped}" in typed("import", workspace / "in").stdout
    assert f"from 31 pictures of 32x24 at 30.0 Hz\n{cropped}" in typed("import", file).stdout
    assert "frames show" not in typed("import", file, "--fit", "pad", "--out", workspace / "padded").stdout
    in_pairs = foxglove_file(workspace / "d.mcap", video(12, 16, 16), sorted([*steady(6), *steady(6)]))
    square = typed("import", in_pairs).stdout
    assert "from 12 pictures of 16x16 at 22.0 Hz\n" in square
    assert "frames show" not in square


@pytest.mark.slow
def test_video_without_labels_is_exported_alone(workspace: Path) -> None:
    typed("import", foxglove_file(workspace / "a.mcap", video(6, 16, 16), steady(6)), "--size", "16")
    done = typed("export", "--codec", "av1")
    assert "1 episode, 6 frames\n" in done.stdout
    assert "loses an MSE of" in done.stdout


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--fit", "cropp"], "no fit named 'cropp'; did you mean 'crop'?"),
        (["--clock", "wall"], "no clock named 'wall'; known: header, log"),
        (["--camera", "/front"], "has no topic '/front' for '--camera'"),
    ],
)
def test_what_is_wrong_is_said(workspace: Path, words: list[str], sentence: str) -> None:
    file = foxglove_file(workspace / "a.mcap", video(6), steady(6))
    failed = typed("import", file, *words)
    assert isinstance(failed.exception, DmbenchError)
    assert sentence in str(failed.exception)
    assert not (workspace / "data").exists()


def test_an_unknown_format_is_said(workspace: Path) -> None:
    failed = typed("export", "--format", "rlds")
    assert isinstance(failed.exception, UnknownName)
    assert "no format named 'rlds'; known: lerobot" in str(failed.exception)
