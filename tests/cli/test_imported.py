"""A recording of somebody else's, from the file to the report: with its actions, and as video alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from dmbench_command import Outcome, dmbench
from jaxtyping import UInt8
from PIL import Image
from storage.foreign import foxglove_file, ros_file, ros_image, steady

MOVES = {"up": (0, -8), "down": (0, 8), "left": (-8, 0), "right": (8, 0)}
FRAMES = 80


def scene() -> tuple[UInt8[np.ndarray, "t h w 3"], list[str]]:
    """A red square that is moved over a table, and the names of the moves."""
    generator = np.random.default_rng(0)
    frames = np.full((FRAMES, 64, 64, 3), (60, 90, 120), np.uint8)
    place, names = np.array([24, 24]), list[str]()
    for frame in frames:
        x, y = place
        frame[y : y + 8, x : x + 8] = (220, 40, 40)
        possible = [name for name, move in MOVES.items() if ((place + move >= 0) & (place + move <= 56)).all()]
        names.append(str(generator.choice(possible)))
        place = place + MOVES[names[-1]]
    return frames, names


def recorded_by_foxglove(folder: Path) -> Path:
    frames, names = scene()
    times = steady(FRAMES)
    return foxglove_file(folder / "lab.mcap", frames, times, actions=list(zip(times, names, strict=True)))


def recorded_by_ros(folder: Path) -> Path:
    frames, names = scene()
    ros_file(
        folder / "bag",
        [
            message
            for t_ns, frame, name in zip(steady(FRAMES), frames, names, strict=True)
            for message in (
                ("/camera", "sensor_msgs/msg/Image", t_ns, ros_image(t_ns, 64, 64, "rgb8", 192, frame.tobytes())),
                ("/action", "std_msgs/msg/String", t_ns, {"data": name}),
            )
        ],
    )
    return folder / "bag"


@pytest.fixture
def typed(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):  # type: ignore[no-untyped-def]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))

    def run(*words: str | Path) -> Outcome:
        return dmbench([str(word) for word in words], capsys, monkeypatch)

    return run


@pytest.mark.slow
@pytest.mark.parametrize("write", [recorded_by_foxglove, recorded_by_ros])
def test_with_its_actions(write, typed, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    words = ("--actions", "/action", "--size", "64", "--frames-per-episode", "8", "--out", "data/lab")
    imported = typed("data", "import", write(tmp_path), *words)
    assert "actions, held out as labels: down, left, right, up" in imported.out, imported.err
    trained = typed("train", "dmotion", "--preset", "tiny", "--set", "epochs=0.2")
    assert "labels used: 4 of" in trained.out, trained.err
    scored = typed("score")
    assert scored.code == 0, scored.err
    assert "MSE with the true motion" in scored.out
    assert "positions: where the agent and the objects are is not known" in scored.out
    assert "agent_moves" not in scored.out  # nobody told where the agent is
    assert "position error" not in scored.out
    (seen,) = json.loads(typed("score", "--json").out)["reports"]
    assert seen["figures"]["mse"]["n"] > 0
    saved = typed("view", "lab", "--save", "lab.rrd")
    assert saved.code == 0, saved.err
    assert (tmp_path / "lab.rrd").stat().st_size > 0


def test_pictures_alone_are_not_advised_to_take_actions(typed, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    folder = tmp_path / "recordings" / "a"
    folder.mkdir(parents=True)
    for number in range(4):
        Image.new("RGB", (16, 16), (60 * number, 0, 0)).save(folder / f"{number}.png")
    imported = typed("data", "import", str(tmp_path / "recordings"), "--size", "16", "--hz", "10")
    assert "  no actions: what an action leads to cannot be scored\n" in imported.out


@pytest.mark.slow
def test_as_video_alone(typed, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    words = ("--size", "64", "--frames-per-episode", "8", "--out", "data/lab")
    imported = typed("data", "import", recorded_by_foxglove(tmp_path), *words)
    assert "no actions: what an action leads to cannot be scored; with '--actions TOPIC' it can" in imported.out

    assert "so there is nothing to demonstrate" in typed("train", "dmotion", "--labels", "one-shot").sentence()
    assert "--labels 100%" in typed("train", "ed-cnn").sentence()
    trained = typed("train", "dmotion", "--preset", "tiny", "--set", "epochs=0.2")
    assert "labels used: 0, there are none" in trained.out, trained.err
    scored = typed("score")
    assert scored.code == 0, scored.err
    assert "MSE with the true motion" in scored.out
    assert "actions: not known; frames are drawn with the motion read off the true frames" in scored.out
    (report,) = json.loads(typed("score", "--json").out)["reports"]
    assert set(report["figures"]) == set(report["reference"]["copy_last"]) == {"mse_true_motion"}
    assert "MSE with the true motion" in typed("score", "--all").out
    saved = typed("view", "lab", "--save", "lab.rrd")
    assert saved.code == 0, saved.err
