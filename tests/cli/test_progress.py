"""What is said of a long piece of work where stderr is no terminal."""

from __future__ import annotations

import io
import re
from dataclasses import replace

import pytest
from rich.console import Console
from rich.progress import Progress

from dmotion_bench.cli.progress import FIRST_SECONDS, QUIET, SECONDS, ProgressDisplay, bar_columns, duration, note
from dmotion_bench.execution.job_progress import JobProgress


class Clock:
    """Tells the time that it was set to."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_a_line_comes_soon_and_then_now_and_then(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(QUIET)
    clock = Clock()
    with ProgressDisplay(clock) as display:
        task = display.add_task("training dmotion", total=None, status="reading the data")
        for second in range(61):
            clock.now = 100.0 + second
            display.update(task, completed=10 * second, total=3000, status=f"loss {second}")
    lines = capsys.readouterr().err.splitlines()
    times = [FIRST_SECONDS + SECONDS * number for number in range(4)]
    assert lines == [
        f"training dmotion: {10 * second:.0f} of 3,000, loss {second:.0f}, {duration(300 - second)} left"
        for second in times
    ]
    assert lines[0].endswith("4 min 55 s left")


def test_the_rate_is_of_this_sitting(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(QUIET)
    clock = Clock()
    with ProgressDisplay(clock) as display:
        task = display.add_task("training dmotion")
        display.update(task, completed=900, total=1000)  # resumed
        clock.now += 10
        display.update(task, completed=910)
    assert capsys.readouterr().err == "training dmotion: 910 of 1,000, 1 min 30 s left\n"


def test_each_part_of_the_work_has_a_rate_of_its_own(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(QUIET)
    clock = Clock()
    with ProgressDisplay(clock) as display:
        for second, (done, part) in enumerate([(400, "a reference"), (1000, "a reference"), (4, "the model")]):
            clock.now = 100.0 + second
            display.tell(JobProgress(what="scoring a", done=done, total=1000, status=part))
        clock.now = 112.0
        display.tell(JobProgress(what="scoring a", done=104, total=1000, status="the model"))
        clock.now = 142.0
        display.tell(JobProgress(what="scoring a", done=404, total=1000, status="the model"))
    assert capsys.readouterr().err.splitlines() == [
        "scoring a: 104 of 1,000, the model, 1 min 30 s left",
        "scoring a: 404 of 1,000, the model, 1 min 0 s left",
    ]


def test_one_bar_tells_of_one_thing_after_the_other(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(QUIET)
    clock = Clock()
    with ProgressDisplay(clock) as display:
        display.tell(JobProgress(what="training a", done=0, total=None, status="reading the data"))
        for second in range(11):
            clock.now = 100.0 + second
            display.tell(JobProgress(what="training a", done=900 + second, total=1000))  # resumed
        clock.now = 130.0
        display.tell(JobProgress(what="scoring a", done=0, total=4))
    assert capsys.readouterr().err.splitlines() == [
        "training a: 905 of 1,000, 1 min 35 s left",
        "scoring a: 0 of 4",
    ]


def test_work_of_unknown_size_is_told_without_a_guess(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(QUIET)
    clock = Clock()
    with ProgressDisplay(clock) as display:
        task = display.add_task("measuring")
        clock.now += FIRST_SECONDS
        display.update(task, status="record[grid_world]")
        clock.now += SECONDS
        display.update(task, status="")
    assert capsys.readouterr().err == "measuring: record[grid_world]\nmeasuring\n"


def test_of_many_jobs_the_number_and_the_slowest_are_told(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(QUIET)
    clock = Clock()
    jobs = {str(n): JobProgress(what=f"model {n}", done=100 - n, total=200) for n in range(64)}
    with ProgressDisplay(clock) as display:
        task = display.add_task("training", total=200)
        for running in (5, 64):
            clock.now += SECONDS
            display.show_jobs(task, dict(list(jobs.items())[:running]))
        clock.now += SECONDS
        display.show_jobs(task, {name: replace(job, total=None) for name, job in jobs.items()})
    assert capsys.readouterr().err.splitlines() == [
        "training: 0 of 200, model 0 50%; model 1 50%; model 2 49%; model 3 48%; model 4 48%",
        "training: 0 of 200, 64 run, the slowest model 63 18%",
        "training: 0 of 200, 64 run",
    ]


def test_a_note_is_written_to_a_file_unless_quiet_is_asked_for(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    note("training lapo: diverged.")
    assert capsys.readouterr().err == ""
    monkeypatch.delenv(QUIET)
    note("training lapo\x1b[2J: diverged.")
    assert capsys.readouterr().err == "training lapo\\x1b[2J: diverged.\n"


def test_nothing_is_written_where_quiet_is_asked_for(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(QUIET, "1")
    clock = Clock()
    with ProgressDisplay(clock) as display:
        task = display.add_task("measuring")
        clock.now += FIRST_SECONDS
        display.update(task, status="record[grid_world]")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("width", [60, 80, 200])
def test_a_line_fits_the_terminal_and_the_times_stay_whole(width: int) -> None:
    console = Console(width=width, file=io.StringIO(), force_terminal=True)
    progress = Progress(*bar_columns(width), console=console, get_time=lambda: 3600.0)
    status = "train loss 0.1234, 5678 triplets/s"
    progress.add_task("training dmotion", total=14_000, completed=4_321, status=status, unit="steps")
    with console.capture() as captured:
        console.print(progress.get_renderable())
    (line,) = re.sub(r"\x1b\[[0-9;]*m", "", captured.get()).splitlines()
    assert len(line) <= width
    assert "4321/14000" in line
    assert line.split()[-2:] == ["0:00:00", "-:--:--"]
    assert (status in line) == (width == 200)


def test_what_is_counted_is_named(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(QUIET)
    clock = Clock()
    with ProgressDisplay(clock) as display:
        display.tell(JobProgress(what="training a", done=0, total=None, status="reading the data"))
        clock.now += FIRST_SECONDS
        display.tell(JobProgress(what="training a", done=4, total=18, status="loss 3", unit="steps"))
    assert capsys.readouterr().err == "training a: 4 of 18 steps, loss 3\n"
