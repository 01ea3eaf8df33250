"""``--live`` and ``--live-to``: what goes on is written while it goes on, and nothing changes by it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from dmbench_command import dmbench
from rrd_contents import curve, values

from dmotion_bench.learning.training.samples import samples_of
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import Preset


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("workspace")


@pytest.fixture(autouse=True)
def _here(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(workspace))


@pytest.mark.slow
def test_a_recording_a_training_and_following_them_afterwards(
    workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    recording, training = tmp_path / "recording.rrd", tmp_path / "training.rrd"
    words = ["record", "grid_world", "--preset", "tiny", "--workers", "1", "--live-to", str(recording)]
    outcome = dmbench(words, capsys, monkeypatch)
    assert outcome.code == 0
    assert outcome.out.endswith(f"{recording}\nOpen it with 'dmbench view {recording}' or 'rerun {recording}'.\n")
    assert values(recording, "/recording/camera", "Image:buffer")

    words = ["train", "dmotion", "--preset", "tiny", "--live-to", str(training), "--json"]
    said = dmbench(words, capsys, monkeypatch)
    assert said.code == 0
    assert f"Open it with 'dmbench view {training}' or" in said.err  # the object is alone on stdout
    run = Path(json.loads(said.out)["run"])
    rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    losses = [(row["step"], row["loss"]) for row in rows if "loss" in row]
    assert curve(training, "/training/losses/loss") == losses
    pictures = values(training, "/training/samples", "Image:buffer")
    assert [step for step, _ in pictures] == list(samples_of(run))

    for path in (run, workspace / "data" / "grid_world-tiny"):
        again = tmp_path / f"{path.name}.rrd"
        assert dmbench(["view", str(path), "--live", "--save", str(again)], capsys, monkeypatch).code == 0
        assert again.is_file()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["train", "dmotion", "--live-to", "film.mp4"], "--live-to 'film.mp4' must end in .rrd"),
        (["train", "--all", "--live"], "leave out --live"),
        (["view", "grid_world-tiny", "grid_world-tiny", "--live", "--save", "a.rrd"], "only runs can be shown side by"),
    ],
)
def test_mistakes(
    words: list[str], sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    record_dataset(tmp_path / "data/grid_world-tiny", recipe_for("grid_world", Preset.TINY))
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    said = dmbench(words, capsys, monkeypatch)
    assert said.code == 2
    assert sentence in said.sentence()
