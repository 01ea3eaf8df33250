"""``dmbench view`` as a user types it."""

from __future__ import annotations

import contextlib
import select
import signal
import subprocess
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from dmbench_command import dmbench, finish, never_ending, start_dmbench
from pushed_squares import write_squares
from rrd_contents import tabs_of

from dmotion_bench.storage.dataset import Dataset


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("workspace")
    write_squares(root / "data" / "squares-tiny")
    return root


@pytest.fixture(autouse=True)
def _here(workspace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(workspace))
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")


def test_what_is_a_file_already_is_not_saved_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.rrd").touch()
    said = dmbench(["view", str(tmp_path / "a.rrd"), "--save", str(tmp_path / "b.rrd")], capsys, monkeypatch)
    assert said.code == 2
    assert "is a Rerun file already" in said.sentence()
    said = dmbench(["view", str(tmp_path / "a.rrd"), "--split", "test"], capsys, monkeypatch)
    assert said.code == 2
    assert "a.rrd' is shown as it is; name neither an episode nor a split" in said.sentence()


@pytest.mark.parametrize("live", [[], ["--live"]])
def test_save_writes_a_file_and_says_how_to_open_it(
    live: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "new folder" / "out.rrd"
    said = dmbench(["view", "squares-tiny", "--save", str(file), *live], capsys, monkeypatch)
    assert said.code == 0
    assert said.out.splitlines()[0] == str(file)
    assert f"rerun '{file}'" in said.out
    assert live or tabs_of(file) == [f"Episode {number}" for number in range(3)]


def test_episodes_and_splits_can_be_chosen(
    workspace: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "out.rrd"
    words = ["view", "squares-tiny", "--save", str(file)]
    assert dmbench([*words, "--episode", "7", "--episode", "2"], capsys, monkeypatch).code == 0
    assert tabs_of(file) == ["Episode 7", "Episode 2"]
    assert dmbench([*words, "--split", "test"], capsys, monkeypatch).code == 0
    test = Dataset.open(workspace / "data" / "squares-tiny").split("test")
    assert tabs_of(file) == [f"Episode {number}" for number in test]


@pytest.mark.parametrize(
    ("words", "code", "sentence"),
    [
        (["sqares-tiny"], 2, "did you mean 'squares-tiny'"),
        (["squares-tiny", "squares-tiny"], 2, "only runs can be shown side by side"),
        (["squares-tiny", "--data", "squares-tiny"], 2, "--data shows one finished run on another data set"),
        (["squares-tiny", "--split", "tset"], 2, "did you mean 'test'"),
        (["squares-tiny", "--save", "out.mp4"], 2, "must end in .rrd"),
        (["squares-tiny", "--save", "out.rrd", "--episode", "10"], 2, "it has 0 to 9"),
        (["squares-tiny", "--live", "--episode", "0"], 2, "what is followed live is shown as it is"),
        (["squares-tiny"], 1, "'--web'"),
        (["squares-tiny", "--save", f"{__file__}/out.rrd"], 1, "cannot be written"),
    ],
)
def test_mistakes_are_told_in_a_sentence(
    words: list[str], code: int, sentence: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said = dmbench(["view", *words], capsys, monkeypatch)
    assert said.code == code
    assert sentence in said.sentence()


@pytest.mark.slow
def test_a_file_that_cannot_grow_leaves_nothing(workspace: Path, tmp_path: Path) -> None:
    file = tmp_path / "out.rrd"
    process = start_dmbench(
        ["view", "squares-tiny", "--save", str(file)],
        workspace,
        file_bytes=4096,
    )
    said = finish(process)
    assert said.code == 1
    assert said.err.splitlines()[-1].startswith(f"dmbench: {str(file)!r} could not be written")
    assert list(tmp_path.iterdir()) == []


def viewers_of(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """The processes that serve the page whose address the command prints, once it answers."""
    assert process.stdout is not None
    assert process.stderr is not None
    assert select.select([process.stdout], [], [], 60)[0]
    url = process.stdout.readline().strip()
    assert url.startswith("http://127.0.0.1:"), process.stderr.read()
    with urllib.request.urlopen(url, timeout=30) as answer:
        assert answer.status == 200
    viewers = psutil.Process(process.pid).children(recursive=True)
    assert viewers
    return viewers


def assert_nobody_serves(viewers: list[psutil.Process]) -> None:
    assert not never_ending(viewers)


@pytest.mark.slow
@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM])
def test_the_web_page_is_served_until_the_command_is_ended(workspace: Path, sign: signal.Signals) -> None:
    process = start_dmbench(["view", "squares-tiny", "--web"], workspace, start_new_session=True)
    try:
        viewers = viewers_of(process)
        process.send_signal(sign)
        assert process.wait(timeout=60) == (0 if sign == signal.SIGINT else 143)
    finally:
        process.kill()
        process.communicate()
    assert_nobody_serves(viewers)


@contextlib.contextmanager
def following_on_a_page(workspace: Path, folder: Path) -> Iterator[tuple[subprocess.Popen[str], list[psutil.Process]]]:
    """A command that follows a run that was begun, and the processes of its viewer."""
    run = folder / "runs" / "begun"
    run.mkdir(parents=True)
    (run / "run.json").write_text("{}")
    process = start_dmbench(["view", str(run), "--live", "--web"], workspace, start_new_session=True)
    try:
        assert process.stderr is not None
        assert select.select([process.stderr], [], [], 60)[0]
        assert process.stderr.readline().startswith("http://127.0.0.1:")
        viewers = psutil.Process(process.pid).children(recursive=True)
        time.sleep(1)  # it follows
        yield process, viewers
    finally:
        process.kill()
        process.communicate()
    assert_nobody_serves(viewers)


@pytest.mark.slow
@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_following_on_a_page_ends_when_the_command_is_ended(
    workspace: Path, tmp_path: Path, sign: signal.Signals
) -> None:
    with following_on_a_page(workspace, tmp_path) as (process, _):
        process.send_signal(sign)
        assert process.wait(timeout=30) == (0 if sign == signal.SIGINT else 128 + sign)


@pytest.mark.slow
def test_following_ends_when_the_viewer_is_closed(workspace: Path, tmp_path: Path) -> None:
    with following_on_a_page(workspace, tmp_path) as (process, viewers):
        for viewer in reversed(viewers):
            viewer.terminate()
        assert process.wait(timeout=30) == 0


@pytest.mark.slow
def test_a_killed_command_leaves_no_viewer_behind(workspace: Path) -> None:
    process = start_dmbench(["view", "squares-tiny", "--web"], workspace)
    viewers = viewers_of(process)
    process.kill()
    finish(process)
    assert_nobody_serves(viewers)
