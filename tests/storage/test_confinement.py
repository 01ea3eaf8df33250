"""Whatever a decoder does in its own process is a sentence in this one."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmotion_bench.errors import RecordingImportError, RecordingNotFetched, RecordingTruncated
from dmotion_bench.storage.imports.confinement import ConfinedRecording, Confinement
from dmotion_bench.storage.imports.limits import MIB, ImportLimits
from dmotion_bench.storage.imports.options import ImportOptions

READER = (sys.executable, "-P", str(Path(__file__).parent / "misbehaving_reader.py"))
OPTIONS = ImportOptions(size=77, limits=ImportLimits(reader_bytes=256 * MIB, reader_seconds=1))


@pytest.fixture
def confinement() -> Iterator[Confinement]:
    with Confinement(OPTIONS, READER) as started:
        yield started


def opened(confinement: Confinement, name: str) -> ConfinedRecording:
    return confinement.open(Path("/nowhere") / name, "video")


def test_what_is_read_there_arrives_here(confinement: Confinement) -> None:
    recording = opened(confinement, "fine")
    survey = recording.survey()
    assert (survey.camera, survey.height, survey.width, survey.hints) == ("eye", 2, 3, ["look closer."])
    assert survey.told == ["it blinks."]
    first, second = survey.segments
    assert (first.times_ns.tolist(), second.times_ns.tolist()) == ([3, 7], [5, 9, 11])
    assert first.commands is None
    assert second.commands is not None
    assert second.commands.times_ns.tolist() == [5, 9]
    assert (second.commands.names, second.commands.vocabulary) == (["b", "a"], ["b", "a", "c"])
    assert recording.unreadable == 3
    assert recording.sha256() == "ab"

    pictures = list(recording.pictures(1, np.array([0, 4])))
    assert [int(picture[0, 0, 0]) for picture in pictures] == [10, 14]
    assert pictures[0].shape == (2, 3, 3)
    assert [int(one[0, 0, 0]) for one in opened(confinement, "other").pictures(0, np.array([1]))] == [1]


def test_the_process_loads_no_simulators_interface(tmp_path: Path) -> None:
    """Importing dmbench loads Gymnasium elsewhere, which takes a third of the time in which a reader starts."""
    told = tmp_path / "loaded.txt"
    reads = f"import pathlib, sys; pathlib.Path({str(told)!r}).write_text(' '.join(sys.modules))"
    command = (sys.executable, "-P", "-c", f"import dmotion_bench.storage.imports.sources; {reads}")
    with Confinement(OPTIONS, command) as confinement, pytest.raises(RecordingImportError, match="code 0"):
        opened(confinement, "any")
    loaded = told.read_text().split()
    assert "dmotion_bench.storage.imports.sources" in loaded
    assert "gymnasium" not in loaded


@pytest.mark.parametrize("waits", [False, True])
@pytest.mark.parametrize(
    ("does", "sentence"),
    [
        (
            "import nothing_here",
            r"'/nowhere/any' ended before it read anything \(code 1\); .* says why: .*nothing_here",
        ),
        (
            "import os, resource; resource.setrlimit(resource.RLIMIT_CORE, (0, 0)); os.abort()",
            r"'/nowhere/any' makes its decoder crash \(SIGABRT\)",
        ),
    ],
)
def test_a_process_that_ends_at_once_is_a_sentence(
    does: str, sentence: str, waits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if waits:  # it is gone before anything is sent to it
        monkeypatch.setattr("dmotion_bench.storage.imports.confinement.subprocess.Popen", Ended)
    with Confinement(OPTIONS, (sys.executable, "-c", does)) as confinement:
        for _ in range(2):
            with pytest.raises(RecordingImportError, match=sentence):
                opened(confinement, "any")
            confinement.close()


class Ended(subprocess.Popen[bytes]):
    """A process that has ended once it is started."""

    def __init__(self, *given: Any, **named: Any) -> None:
        super().__init__(*given, **named)
        self.wait()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("crash", r"'/nowhere/crash' makes its decoder crash \(SIGSEGV\): it is damaged, or made to do so"),
        ("abort", r"makes its decoder crash \(SIGABRT\)"),
        ("busy", "keeps its decoder busy for more than 1 s without another picture"),
        ("sticky", "keeps its decoder busy for more than 1 s without another picture"),
        ("greedy", "takes more than 256 MiB of memory to be decoded; .*'--max-memory 512'"),
        ("crowded", "takes more than 256 MiB of memory to be decoded; .*'--max-memory 512'"),
        ("surprise", "the recording cannot be read: LookupError: "),
        ("writes", "cannot be read: (OSError|FileNotFoundError|PermissionError)"),
    ],
)
def test_misbehaviour_is_a_sentence(confinement: Confinement, name: str, sentence: str) -> None:
    with pytest.raises(RecordingImportError, match=sentence) as caught:
        opened(confinement, name).survey()
    assert len(str(caught.value)) < 400
    assert "\x1b" not in str(caught.value)


@pytest.mark.slow
def test_no_file_can_be_written(tmp_path: Path) -> None:
    with Confinement(OPTIONS, READER) as confinement, pytest.raises(RecordingImportError, match="OSError"):
        confinement.open(tmp_path / "writes", "video").survey()
    assert [file.stat().st_size for file in tmp_path.iterdir()] in ([], [0])


@pytest.mark.slow
def test_errors_keep_their_kind(confinement: Confinement) -> None:
    with pytest.raises(RecordingTruncated, match=r"the end is missing\."):
        opened(confinement, "truncated").survey()
    with pytest.raises(RecordingNotFetched, match=r"it was not fetched\."):
        opened(confinement, "elsewhere").survey()
    with pytest.raises(RecordingTruncated, match=r"no video of 77 pixels\."):
        opened(confinement, "refused")


@pytest.mark.slow
def test_progress_buys_time_and_ctrl_c_is_not_for_the_reader(confinement: Confinement) -> None:
    assert len(opened(confinement, "interrupted").survey().segments) == 2
    told: list[int] = []

    def enough(pictures: int) -> None:
        told.append(pictures)
        if len(told) == 8:  # more than the one second that a picture may take
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        opened(confinement, "hang").survey(enough)


def test_a_crash_between_two_pictures(confinement: Confinement) -> None:
    pictures = opened(confinement, "late").pictures(0, np.array([0, 1, 2, 3]))
    assert [int(next(pictures)[0, 0, 0]) for _ in range(2)] == [0, 1]
    with pytest.raises(RecordingImportError, match="SIGABRT"):
        next(pictures)


def test_the_process_ends_with_the_import() -> None:
    with Confinement(OPTIONS, READER) as confinement:
        opened(confinement, "fine")
        process = confinement._process
        assert process is not None
        os.kill(process.pid, 0)
    assert process.returncode is not None
    assert confinement._process is None
