"""``dmbench train``: what it prints, where it goes on, and what it says when it cannot."""

from __future__ import annotations

import json
import shutil
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from dmbench_command import Outcome, dmbench, finish, start_dmbench
from storage.foreign import foxglove_file, steady, video
from walking_square import record_walks

from dmotion_bench.cli import main
from dmotion_bench.interrupts import INTERRUPTED
from dmotion_bench.learning.runs.checkpoint import load
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.training.loop import train
from dmotion_bench.learning.training.state import StepReport

pytestmark = pytest.mark.slow

Command = Callable[..., Outcome]
QUICK = ("--set", "batch_size=4", "--set", "epochs=0.2")
LONGER = ("--set", "batch_size=4", "--set", "epochs=2")


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    return lambda *words: dmbench(words, capsys, monkeypatch)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    return record_walks(tmp_path / "data" / "walk-small")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace with the data set and a quickly trained run; read only."""
    root = tmp_path_factory.mktemp("trained")
    record_walks(root / "data" / "walk-small")
    _train(root, *QUICK, "--out", str(root / "run"))
    return root


@pytest.fixture(scope="module")
def whole(trained: Path) -> Run:
    """A longer training that nothing interrupted."""
    _train(trained, *LONGER, "--out", str(trained / "whole"))
    return Run.open(trained / "whole")


def _train(workspace: Path, *words: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DMBENCH_WORKSPACE", str(workspace))
        patch.setattr("sys.argv", ["dmbench", "train", "dmotion", *words])
        with pytest.raises(SystemExit) as left:
            main()
    assert not left.value.code


@pytest.fixture
def run_folder(trained: Path, data: Path, tmp_path: Path) -> Path:
    """A copy of the run, to spoil."""
    return shutil.copytree(trained / "run", tmp_path / "runs" / "a")


def test_json_has_the_names_that_scripts_rely_on(run: Command, data: Path, tmp_path: Path) -> None:
    outcome = run("train", "dmotion", *QUICK, "--out", str(tmp_path / "run"), "--json")
    assert (outcome.code, outcome.err) == (0, "")
    result = json.loads(outcome.out)
    assert set(result) == {"run", "model", "steps", "triplets_per_s", "seconds", "labels", "threads", "precision"}
    assert (result["model"], result["labels"]) == ("dmotion", 4)
    again = json.loads(run("train", "dmotion", *QUICK, "--out", str(tmp_path / "run"), "--json").out)
    assert again == result


def test_the_folders_name_says_what_sets_the_run_apart(run: Command, data: Path, tmp_path: Path) -> None:
    run("train", "dmotion", *QUICK[2:], "--seed", "3", "--labels", "2-shot")
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["dmotion-walk-small-2-shot-epochs_0.2-s3"]
    listed = json.loads(run("list", "runs", "--json").out)["runs"]
    assert [row["labels"] for row in listed] == ["2-shot"]


@pytest.mark.parametrize(
    ("words", "says", "code"),
    [
        (("dmotoin",), "no model named 'dmotoin'; did you mean 'dmotion'?", 2),
        (("dmotion", "--preset", "smal"), "no preset named 'smal'; did you mean 'small'?", 2),
        (("dmotion", "--arch", "papr"), "did you mean 'paper'?", 2),
        (("dmotion", "--set", "epoch=3"), "no setting named 'epoch'; did you mean 'epochs'?", 2),
        (("dmotion", "--set", "epochs=three"), "epochs is 'three'; it must be a number.", 2),
        (("dmotion", "--labels", "some"), "no label budget 'some'", 2),
        (("dmotion", "--labels", "900-shot"), "fewer than 900 demonstrations", 1),
        (("dmotion", "--split", "paperr"), "did you mean 'paper'?", 2),
        (("dmotion", "--data", "walk-smal"), "no data set named 'walk-smal'; did you mean 'walk-small'?", 2),
        (("dmotion", "--resume"), "nothing to resume", 1),
        (("dmotion", "--set", "arch=paper"), "give '--arch paper'", 2),
        (("dmotion", "--set", "epochs=inf"), "epochs is 'inf'; it must be finite.", 2),
        (("dmotion", "--set", "blur=nan"), "blur is 'nan'; it must be finite.", 2),
        (("dmotion", "--set", "validations=0"), "validations is 0; it must be above zero.", 2),
        (("dmotion", "--out", "o" * 300), "File name too long; name another path", 1),
    ],
)
def test_a_wrong_word_costs_a_sentence(run: Command, data: Path, words: tuple[str, ...], says: str, code: int) -> None:
    outcome = run("train", *words)
    assert outcome.code == code
    assert says in outcome.sentence()


def test_a_file_in_the_way_is_said(run: Command, data: Path) -> None:
    outcome = run("train", "dmotion", *QUICK, "--out", str(data / "dataset.json"))
    assert outcome.code == 1
    assert "dataset.json" in outcome.sentence()


def test_a_finished_run_whose_weights_are_damaged_is_trained_anew(run: Command, run_folder: Path) -> None:
    best = run_folder / "best.safetensors"
    weights = best.read_bytes()
    best.write_bytes(weights[: len(weights) // 2])

    outcome = run("train", "dmotion", *QUICK, "--out", str(run_folder))

    assert outcome.code == 0
    assert best.read_bytes() == weights


def test_without_labels_nothing_says_what_an_action_does(run: Command, data: Path, tmp_path: Path) -> None:
    trained = run("train", "dmotion", *QUICK, "--labels", "none", "--out", str(tmp_path / "run"))
    assert "with '--labels one-shot' tells it, without training again" in trained.out
    for command in (("score",), ("plan", "--json")):
        outcome = run(command[0], str(tmp_path / "run"), *command[1:])
        assert outcome.code == 1
        assert "trained with '--labels none'" in outcome.sentence()


@pytest.mark.parametrize(
    ("name", "value"),
    [("seed", "zero"), ("height", None), ("model", 3), ("training", []), ("config", {"blur": "wide"})],
)
def test_a_run_that_holds_other_types_is_said_to_be_corrupt(
    run: Command, run_folder: Path, name: str, value: object
) -> None:
    manifest = run_folder / "run.json"
    content = json.loads(manifest.read_text())
    content["spec"][name] = value
    manifest.write_text(json.dumps(content))

    outcome = run("score", "a")

    assert outcome.code in (1, 2)
    assert "cannot be read" in outcome.sentence()
    assert run("list", "runs").code == 0


@pytest.mark.parametrize(("name", "value"), [("result", []), ("dataset_path", 3), ("spec", None), ("result", ...)])
def test_a_run_that_lacks_something_is_said_to_be_corrupt(
    run: Command, run_folder: Path, name: str, value: object
) -> None:
    manifest = run_folder / "run.json"
    content = json.loads(manifest.read_text()) | {name: value}
    manifest.write_text(json.dumps({key: one for key, one in content.items() if one is not ...}))

    outcome = run("score", "a")

    assert outcome.code == 1
    assert f"cannot be read: run.{name} is" in outcome.sentence()
    assert run("list", "runs").code == 0


def test_weights_that_another_code_cannot_read_are_not_trained_over(
    run: Command, run_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What changed is the model's class, not the file: the training is not to be lost."""
    weights = run_folder / "best.safetensors"
    written = weights.stat().st_mtime_ns
    monkeypatch.setattr("baselines.dmotion.DMotion.load_state_dict", lambda *_: 1 / 0)

    assert run("train", "dmotion", *QUICK, "--out", str(run_folder)).code == 0
    assert weights.stat().st_mtime_ns == written


def test_no_data_set_and_several_are_said(run: Command, tmp_path: Path) -> None:
    outcome = run("train", "dmotion")
    assert outcome.code == 1
    assert "dmbench record" in outcome.sentence()
    for name in ("walk-a", "walk-b"):
        record_walks(tmp_path / "data" / name)
    outcome = run("train", "dmotion")
    assert outcome.code == 2
    assert "walk-a" in outcome.err
    assert "walk-b" in outcome.err


def test_too_few_episodes_are_said(run: Command, tmp_path: Path) -> None:
    record_walks(tmp_path / "data" / "walk-few", episodes=2)
    assert "record at least 10" in run("train", "dmotion").sentence()
    frames = foxglove_file(tmp_path / "clip.mcap", video(9), steady(9))
    assert run("data", "import", str(frames), "--size", "32").code == 0
    refused = run("train", "dmotion", "--data", "imported-clip").sentence()
    assert "import at least 10: cut the recordings shorter with '--frames-per-episode'" in refused


def test_without_labels_one_demonstration_is_too_much(run: Command, data: Path) -> None:
    shutil.rmtree(data / "labels")
    outcome = run("train", "dmotion", *QUICK)
    assert outcome.code == 1
    assert "labels" in outcome.sentence()
    assert run("train", "dmotion", *QUICK, "--labels", "none").code == 0


def test_an_interruption_says_how_to_go_on_and_the_same_command_does(
    run: Command, data: Path, whole: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("train", "dmotion", *LONGER, "--out", str(tmp_path / "run"))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")  # bits depend on the number of threads; the tests have one
    process = start_dmbench(words, tmp_path)
    metrics = tmp_path / "run" / "metrics.jsonl"
    deadline = time.monotonic() + 100
    while not (metrics.exists() and metrics.read_text().count("\n") > 3) and time.monotonic() < deadline:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    outcome = finish(process)
    assert outcome.code == 130
    assert "run the same command again" in outcome.sentence()
    stopped = Run.open(tmp_path / "run")
    assert stopped.result is None
    assert stopped.last.exists()
    assert run(*words).code == 0
    assert Run.open(tmp_path / "run").result["weights"] == whole.result["weights"]


def test_who_is_asked_to_end_says_the_same_with_another_code(
    run: Command, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def train_until_asked(run: Run, data: Any, fabric: Any, on_step: Callable[[StepReport], None], *rest: Any) -> Any:
        def asked(report: StepReport) -> None:
            on_step(report)
            if report.step == 3:
                signal.raise_signal(signal.SIGTERM)

        return train(run, data, fabric, asked, *rest)

    monkeypatch.setattr("dmotion_bench.api.training.train_steps", train_until_asked)
    outcome = run("train", "dmotion", *QUICK, "--out", str(tmp_path / "run"))
    assert outcome.code == 143
    assert outcome.sentence() == f"dmbench: {INTERRUPTED}\n"
    assert Run.open(tmp_path / "run").result is None
    assert load(tmp_path / "run" / "last.safetensors")[1]["step"] == 3


def test_a_full_disk_costs_a_sentence_and_no_checkpoint(
    run: Command, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import errno

    def full(path: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    with monkeypatch.context() as patched:
        patched.setattr("dmotion_bench.learning.runs.checkpoint.write_atomically", full)
        outcome = run("train", "dmotion", *QUICK, "--out", str(tmp_path / "run"))
    assert outcome.code == 1
    assert "no space left on the device" in outcome.sentence()
    assert run("train", "dmotion", *QUICK, "--out", str(tmp_path / "run")).code == 0


def test_a_truncated_checkpoint_is_said(run: Command, run_folder: Path) -> None:
    best = run_folder / "best.safetensors"
    best.write_bytes(best.read_bytes()[:1000])
    outcome = run("score", str(run_folder))
    assert outcome.code == 1
    assert "cannot be read" in outcome.sentence()


def test_the_frames_of_a_data_set_that_is_read_only_are_kept_elsewhere(
    run: Command, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DMBENCH_CACHE", "")  # and put back afterwards
    (data / "cache").touch()  # nobody can write a cache there, not even root
    words = ("train", "dmotion", *QUICK, "--out", str(tmp_path / "run"))
    outcome = run(*words)
    assert outcome.code == 1
    assert "name another folder with '--cache DIR', or in the variable DMBENCH_CACHE" in outcome.sentence()
    assert run(*words, "--cache", str(tmp_path / "elsewhere")).code == 0
    assert run("score", str(tmp_path / "run"), "--cache", str(tmp_path / "elsewhere")).code == 0
    assert len([*(tmp_path / "elsewhere").glob("*.arrow")]) == 1
    assert not (data / "cache").read_bytes()


@pytest.mark.parametrize("out", ["", ".", "/"])
def test_a_folder_of_other_things_is_left_alone(
    run: Command, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, out: str
) -> None:
    (tmp_path / "project").mkdir()
    (tmp_path / "project" / "notes.txt").touch()
    monkeypatch.chdir(tmp_path / "project")
    outcome = run("train", "dmotion", *QUICK, "--out", out)
    assert outcome.code == 2
    assert "is not empty and holds no run; name another folder" in outcome.sentence()
    assert [file.name for file in (tmp_path / "project").iterdir()] == ["notes.txt"]
