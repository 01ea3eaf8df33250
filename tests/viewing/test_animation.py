"""An animation's frames, read back from the file, are those of the data set and those that the model imagines."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dmbench_command import dmbench
from jaxtyping import UInt8
from made_up_report import write_made_up
from PIL import Image, ImageSequence
from pushed_squares import SPEC

from dmotion_bench.errors import UsageError, ViewerError
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.specs import SplitName
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing.animation import FRAME_MS, LAST_MS, animate, write_animation
from dmotion_bench.viewing.captions import GAP, LINE, SIDE, captioned
from dmotion_bench.viewing.imagination import GIVEN, imagine
from dmotion_bench.workspace import Workspace

SCALE = SIDE // SPEC.width
STEPS = 5


def _tile(picture: Image.Image, column: int, row: int) -> UInt8[np.ndarray, "h w 3"]:
    """The frame in a place of an animation's picture, as small as it was."""
    left = GAP + column * (SIDE + GAP)
    top = LINE + row * (LINE + SIDE) + LINE
    return np.asarray(picture.convert("RGB"))[top : top + SIDE : SCALE, left : left + SIDE : SCALE]


@pytest.mark.slow
def test_rows_are_the_recorded_frames_and_those_that_each_model_imagines(
    run: Run, other_run: Run, dataset: Dataset
) -> None:
    episodes = dataset.split("train")[:2].tolist()
    pictures = animate({"one": run, "other": other_run}, dataset, episodes, steps=STEPS)
    assert len(pictures) == GIVEN + STEPS
    assert pictures[0].size == (GAP + 2 * (SIDE + GAP), 2 * LINE + 3 * (LINE + SIDE))
    for column, episode in enumerate(episodes):
        video, labels = dataset.video(episode), dataset.labels(episode)
        imagined = [imagine(one.model, video, labels, dataset.spec).imagined.frames for one in (run, other_run)]
        assert not np.array_equal(*imagined)
        for time, picture in enumerate(pictures):
            np.testing.assert_array_equal(_tile(picture, column, 0), video[time])
            for row, frames in enumerate(imagined, start=1):
                expected = video[time] if time < GIVEN else frames[time - GIVEN]
                np.testing.assert_array_equal(_tile(picture, column, row), expected)


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """The words of each picture, in the order of the pictures."""
    pictures: list[dict[str, Any]] = []

    def take(titles: Any, rows: Any, below: str, *, notes: Any = ()) -> Image.Image:
        pictures.append({"titles": titles, "rows": [words for words, _ in rows], "below": below, "notes": notes})
        return captioned(titles, rows, below, notes=notes)

    monkeypatch.setattr("dmotion_bench.viewing.animation.captioned", take)
    return pictures


def test_the_step_is_counted_from_what_is_given(run: Run, dataset: Dataset, said: list[dict[str, Any]]) -> None:
    animate({"dmotion": run}, dataset, dataset.split("test")[:1].tolist(), steps=2)
    assert [one["below"] for one in said] == ["given, 1 of 2", "given, 2 of 2", "step 1", "step 2"]


@pytest.mark.slow
def test_an_episode_that_is_not_a_test_episode_is_named_so(
    run: Run, dataset: Dataset, said: list[dict[str, Any]]
) -> None:
    parts: tuple[SplitName, ...] = ("test", "validation", "train")
    test, validation, train = (int(dataset.split(part)[0]) for part in parts)
    animate({"dmotion": run}, dataset, [test, validation, train], {train: "worst, MSE 3"}, steps=1)
    told = [f"episode {test}", f"episode {validation} (validation)", f"episode {train} (worst, train)"]
    assert said[0]["titles"] == told
    elsewhere = Run(run.path, {**run.manifest, "spec": {**run.manifest["spec"], "fingerprint": "another"}})
    animate({"dmotion": elsewhere}, dataset, [train], steps=1)
    assert said[-1]["titles"] == [f"episode {train}"]  # of a data set that the run was not trained on


def test_a_row_says_that_its_model_was_told_the_true_motions(
    run: Run, dataset: Dataset, said: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    animate({"dmotion": run}, dataset, [0], steps=1)
    monkeypatch.setattr("dmotion_bench.viewing.animation.labels_if_any", lambda dataset, episode: None)
    animate({"dmotion": run}, dataset, [0], steps=1)
    assert said[0]["rows"] == ["real", "imagined by dmotion"]
    assert said[-1]["rows"] == ["real", "imagined by dmotion, told the true motions"]


def test_an_episode_that_ends_earlier_says_so_and_keeps_its_last_frame(
    run: Run, dataset: Dataset, said: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    video, labels = {0: dataset.video(0), 1: dataset.video(1)[:4]}, dataset.labels(0)
    shortened = {0: labels, 1: replace(labels, actions=labels.actions[:3])}
    monkeypatch.setattr(dataset, "video", video.get)
    monkeypatch.setattr(dataset, "labels", shortened.get)
    pictures = animate({"dmotion": run}, dataset, [0, 1], steps=STEPS)
    assert [one["notes"] for one in said] == [["", ""]] * 4 + [["", "ended at step 2"]] * (STEPS - 2)
    assert len({picture.size for picture in pictures}) == 1
    np.testing.assert_array_equal(_tile(pictures[-1], 1, 0), video[1][-1])


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_a_file_has_all_pictures_and_begins_again(run: Run, dataset: Dataset, tmp_path: Path, suffix: str) -> None:
    pictures = animate({"dmotion": run}, dataset, [0], steps=STEPS)
    write_animation(pictures, tmp_path / f"a{suffix}")
    with Image.open(tmp_path / f"a{suffix}") as file:
        assert file.info["loop"] == 0
        durations, difference = [], []
        for frame, picture in zip(ImageSequence.Iterator(file), pictures, strict=True):
            shown = _tile(frame, 0, 0).astype(int)  # decodes the frame, which is what says how long it is shown
            durations.append(frame.info["duration"])
            difference.append(np.abs(shown - _tile(picture, 0, 0)).mean())
    assert durations == [FRAME_MS] * (len(pictures) - 1) + [LAST_MS]
    assert max(difference) < 3  # of 255: a palette of 256 colours, or a lossy code


def test_a_file_that_cannot_be_written_is_named(run: Run, dataset: Dataset) -> None:
    with pytest.raises(ViewerError, match="cannot be written"):
        write_animation(animate({"dmotion": run}, dataset, [0], steps=1), Path(__file__) / "a.gif")


def test_pictures_larger_than_their_format_allows_are_refused(tmp_path: Path) -> None:
    wide = [Image.new("RGB", (16_384, 8))] * 2
    with pytest.raises(UsageError, match=r"16,384 x 8 pixels, and a .webp has at most 16,383 on a side"):
        write_animation(wide, tmp_path / "a.webp")
    assert not list(tmp_path.iterdir())
    write_animation(wide, tmp_path / "a.gif")


@pytest.fixture
def _in_workspace(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(workspace.root))
    monkeypatch.delenv("DISPLAY", raising=False)


@pytest.fixture
def _scored(run: Run) -> Iterator[None]:
    folder = write_made_up(run, {1: [10.0, 30.0], 4: [90.0, 10.0], 5: [1.0, 3.0]})
    yield
    shutil.rmtree(folder)


@pytest.mark.slow
@pytest.mark.usefixtures("_in_workspace", "_scored")
def test_the_command_shows_the_worst_the_middle_and_the_best_episode(
    run: Run, dataset: Dataset, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "new" / "a.webp"
    said = dmbench(["view", run.name, "--save", str(file), "--steps", "2"], capsys, monkeypatch)
    assert (said.code, said.out) == (0, f"{file}\n")
    write_animation(
        animate({"dmotion": run}, dataset, [4, 1, 5], {4: "worst", 1: "middle", 5: "best"}, steps=2),
        tmp_path / "b.webp",
    )
    assert file.read_bytes() == (tmp_path / "b.webp").read_bytes()


@pytest.mark.usefixtures("_in_workspace")
@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["squares-tiny", "--save", "a.gif"], "an animation shows what finished runs imagine"),
        (["RUN", "--save", "a.gif", "--web"], "an animation shows what finished runs imagine"),
        (["RUN", "--save", "a.rrd", "--steps", "3"], "--steps is for an animation"),
        (["RUN", "--save", "a.png"], "must end in .rrd for Rerun, or in .gif or .webp"),
    ],
)
def test_mistakes_are_told_in_a_sentence(
    run: Run, words: list[str], sentence: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said = dmbench(["view", *(run.name if word == "RUN" else word for word in words)], capsys, monkeypatch)
    assert said.code == 2
    assert sentence in said.sentence()
