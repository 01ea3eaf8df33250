"""What an import tells of times and commands that are not read as they were recorded."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import h5py
import numpy as np
import pytest
from storage.foreign import compressed, video

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.advice import advice, no_episode
from dmotion_bench.storage.imports.commands import DiscreteCommands
from dmotion_bench.storage.imports.continuous_commands import ContinuousCommands, Reduce
from dmotion_bench.storage.imports.imported_actions import constant_advice, pace_advice
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import Segment, Survey, steady_times
from dmotion_bench.storage.imports.timeline import resample

ASSUMED = "the files do not say how many pictures a second they have; 10 was assumed. Say it with '--source-hz'."


def told(*times: np.ndarray, **options: float) -> tuple[str, ...]:
    """The advice about recordings with pictures at these times [ns]."""
    surveys = [Survey(camera="c", height=8, width=8, segments=[Segment(times_ns=one)]) for one in times]
    return advice(surveys, [], 10, 10, ImportOptions(**options))  # type: ignore[arg-type]


def at(hz: float, count: int = 300) -> np.ndarray:
    return steady_times(count, hz, Path("a"))


@pytest.mark.parametrize("asked", [None, 25.0])
def test_a_rate_of_pictures_that_nobody_knows_is_said_to_be_assumed(tmp_path: Path, asked: float | None) -> None:
    (tmp_path / "in").mkdir()
    for number, frame in enumerate(video(12)):
        (tmp_path / "in" / f"{number}.png").write_bytes(compressed(frame, "png"))
    report = import_recordings([tmp_path / "in"], tmp_path / "out", ImportOptions(size=32, source_hz=asked))
    assert (ASSUMED in report.advice) == (asked is None)


@pytest.mark.parametrize("known", [None, "control_freq", "source_hz"])
def test_a_rate_of_hdf5_that_nobody_knows_is_said_to_be_assumed(tmp_path: Path, known: str | None) -> None:
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["data/demo_0/obs/camera"] = video(4)
        if known == "control_freq":
            file["data"].attrs["env_args"] = '{"env_kwargs": {"control_freq": 10}}'
    options = ImportOptions(size=32, source_hz=10 if known == "source_hz" else None)
    report = import_recordings([tmp_path / "a.hdf5"], tmp_path / "out", options)
    assert (ASSUMED in report.advice) == (known is None)


@pytest.mark.parametrize(
    ("rate", "hz", "said"),
    [
        (
            15,
            10,
            "15 Hz read at 10 Hz makes some steps 2 pictures long and others 1; '--hz 7.5' or '--hz 15' does not.",
        ),
        (24, 10, "24 Hz read at 10 Hz makes some steps 3 pictures long and others 2; '--hz 8' or '--hz 12' does not."),
        (14.985, 10, "15 Hz read at 10 Hz makes"),
        (12.5, 5, "12.5 Hz read at 5 Hz makes"),
    ],
)
def test_a_rate_that_does_not_divide_makes_uneven_steps(rate: float, hz: float, said: str) -> None:
    (sentence,) = told(at(rate), at(30), hz=hz)
    assert sentence.startswith(said)
    for better in sentence.split("'--hz ")[1:]:
        assert told(at(rate), hz=float(better.partition("'")[0])) == ()


def test_steps_are_even_enough() -> None:
    rounded_to_ms = np.rint(at(30) / 1e6).astype(np.int64) * 10**6
    jittering = at(10) + np.random.default_rng(0).integers(-5_000_000, 5_000_000, 300)
    lossy = np.delete(at(30), np.arange(5, 300, 9))
    variable = np.cumsum(np.random.default_rng(0).integers(20_000_000, 80_000_000, 300))
    assert told(at(30), at(60), at(29.97), at(45), at(8), at(10), rounded_to_ms, jittering, lossy, variable) == ()
    (piece,) = resample(at(45), hz=10, max_gap_s=None, most=1000)
    assert set(np.diff(piece.frames)) == {4, 5}  # within a third


def test_what_is_told_of_a_recording_does_not_hide_why_there_is_no_episode() -> None:
    short = Survey(camera="c", height=8, width=8, segments=[Segment(times_ns=at(10, 2))], told=["it blinks."])
    said = str(no_episode([short, short], ImportOptions()))
    assert said.endswith("at 10 Hz: the longest recording has 2 of them. it blinks.")
    assert advice([short], [], 10, 10, ImportOptions()) == ("it blinks.",)


def test_gaps_that_end_episodes_are_told_of() -> None:
    once, twice = np.delete(at(10), range(100, 110)), np.delete(at(10), [*range(50, 55), *range(100, 110)])
    (one,) = told(once)
    assert one.startswith(
        "pictures are missing in 1 place, for 1.1 s, and an episode ends at each; '--max-gap SECONDS'"
    )
    (three,) = told(once, twice)
    assert three.startswith("pictures are missing in 3 places, for 0.6 to 1.1 s, and an episode ends at each;")
    assert told(once, max_gap_s=0.5) == ()
    gaps = len(resample(twice, hz=10, max_gap_s=None, most=1000)) - 1
    assert gaps == 2


@pytest.mark.parametrize(("per_step", "said"), [(1, ""), (2, "each action stands for 2 commands"), (5, "5 commands")])
@pytest.mark.parametrize("of_pictures", [True, False])
def test_commands_that_are_not_kept_are_told_of(per_step: int, said: str, of_pictures: bool) -> None:
    times = at(10 * per_step)
    (piece,) = resample(times, hz=10, max_gap_s=None, most=1000)
    commands = ContinuousCommands(times_ns=times, values=np.ones((300, 1)), names=("v",), of_pictures=of_pictures)
    options = ImportOptions(actions="/a")
    sentences = pace_advice([(piece, commands)], options)
    assert len(sentences) == (per_step > 1)
    assert said in "".join(sentences)
    assert not sentences or "'--action-reduce sum' adds displacements, 'mean' averages velocities" in sentences[0]
    for reduce in (Reduce.SUM, Reduce.MEAN):
        assert pace_advice([(piece, commands)], dataclasses.replace(options, action_reduce=reduce)) == ()


@pytest.mark.parametrize(
    ("said_each", "is_told"),
    [
        (["0", "1", "2"], True),  # the same one is always kept
        (["0", "1", "2", "3"], True),
        (["0", "0", "0", "1", "1", "1"], False),  # as programs repeat what is in force
        (["up"], False),
    ],
)
def test_choices_that_are_not_kept_are_told_of_where_they_differ(said_each: list[str], is_told: bool) -> None:
    times = at(30)
    (piece,) = resample(times, hz=10, max_gap_s=None, most=1000)
    commands = DiscreteCommands(times_ns=times, names=(said_each * 300)[:300])
    sentences = pace_advice([(piece, commands)], ImportOptions(actions="/a"))
    assert len(sentences) == is_told
    for sentence in sentences:
        assert sentence == (
            "each action stands for 3 commands, of which the one in force halfway is kept, and in 98 of 98 steps "
            "others are left out that differ; '--hz 30' keeps all."
        )
    (whole,) = resample(times, hz=30, max_gap_s=None, most=1000)
    assert pace_advice([(whole, commands)], ImportOptions(actions="/a", hz=30)) == ()


def continuous(*names: str) -> Continuous:
    return Continuous(names=names, low=(-9.0,) * len(names), high=(9.0,) * len(names), units=("",) * len(names))


def test_numbers_that_never_change_are_told_of() -> None:
    first, second = np.array([[0.0, 1, 0.5], [0, 2, 0.5]]), np.array([[0.0, 1, 0.5]])
    twist = continuous("linear.y", "angular.z", "gain")
    (two,) = constant_advice(twist, [first, None, second])
    assert two == (
        "linear.y is 0, gain is 0.5 in all actions, so they tell nothing; leave them out with "
        "'--action-fields angular.z'."
    )
    (one,) = constant_advice(twist, [first, np.array([[0.0, 1, 1.5]])])
    assert one.startswith("linear.y is 0 in all actions, so it tells nothing; leave it out with '--action-fields ang")
    assert constant_advice(twist, [first + np.arange(2)[:, None]]) == ()
    assert constant_advice(twist, [second]) == ()  # a single action says nothing about others
    assert constant_advice(Discrete(("stay", "go")), [np.zeros(3, np.int64), np.ones(3, np.int64)]) == ()
    assert constant_advice(None, [None]) == ()


def test_many_numbers_that_never_change_are_counted() -> None:
    many = continuous(*(f"joint,{number}" for number in range(12)))
    values = np.zeros((3, 12))
    values[1, 0] = 1
    (sentence,) = constant_advice(many, [values])
    assert "joint,10 is 0 ... (11 numbers in all) in all actions" in sentence
    assert sentence.endswith("leave them out with '--action-fields'.")


def test_actions_none_of_which_changes_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["data/demo_0/obs/camera"] = video(4)
        file["data/demo_0/actions"] = np.tile([0.0, 1.5], (4, 1))
    options = ImportOptions(size=32, actions="actions")
    with pytest.raises(
        RecordingImportError, match=r"actions\.0 is 0, actions\.1 is 1\.5 in all .* '--action-fields', "
    ):
        import_recordings([tmp_path / "a.hdf5"], tmp_path / "out", options)
    assert not (tmp_path / "out").exists()
