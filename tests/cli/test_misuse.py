"""What cannot be parsed: a sentence that repeats what was given, says what is allowed, and names the help."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import typer
from dmbench_command import Outcome, dmbench

from dmotion_bench.cli import misuse

Command = Callable[..., Outcome]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    return lambda *words: dmbench(words, capsys, monkeypatch)


@pytest.mark.parametrize(
    ("words", "given", "rule"),
    [
        (("train", "dmotion", "--threads", "0"), "'--threads' is '0'", "1"),
        (("train", "dmotion", "--threads", "two"), "'--threads' is 'two'", "integer"),
        (("data", "import", "a", "--hz", "nan"), "'--hz' is 'nan'", "1000"),
        (("leaderboard", "check", "--differing", "1.5"), "'--differing' is '1.5'", "1"),
        (("leaderboard", "serve", "--port", "x\x1b[31m"), "'--port' is 'x\\x1b[31m'", "integer"),
    ],
)
def test_a_value_that_cannot_be_is_repeated(run: Command, words: tuple[str, ...], given: str, rule: str) -> None:
    outcome = run(*words)
    assert outcome.code == 2
    said = outcome.sentence()
    assert said.startswith(f"dmbench: {given}; it should be ")
    command = " ".join(words[: 1 + (words[0] in ("data", "leaderboard"))])
    assert said.endswith(f"{rule}. See 'dmbench {command} -h'.\n")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("train", "dmotion", "--thread", "2"), "no such option: --thread (Possible options: "),
        (("trian",), "no such command 'trian'. Did you mean 'train'? See 'dmbench -h'."),
        (("record",), "missing argument 'environment'. See 'dmbench record -h'."),
        (("train", "dmotion", "--seed"), "option '--seed' requires an argument."),
    ],
)
def test_what_is_no_command_costs_one_sentence(run: Command, words: tuple[str, ...], said: str) -> None:
    outcome = run(*words)
    assert outcome.code == 2
    assert outcome.sentence().startswith(f"dmbench: {said}")


@pytest.mark.parametrize("words", [(), ("data",), ("leaderboard",)])
def test_nothing_behind_a_group_of_commands_is_answered_with_its_help(run: Command, words: tuple[str, ...]) -> None:
    outcome = run(*words)
    assert outcome.code == 2
    assert outcome.err.startswith(f"Usage: {' '.join(['dmbench', *words])} ")
    assert outcome.err.rstrip() == run(*words, "--help").out.rstrip()


def test_version_and_help_end_well(run: Command) -> None:
    assert [run(word).code for word in ("--version", "--help")] == [0, 0]


def test_clicks_own_errors_of_an_older_typer_are_sentences_too() -> None:
    error = typer.BadParameter("0 is not in the range x>=1.", param_hint="'--frames'")
    assert isinstance(error, misuse.Misuse)
    assert misuse.told(error) == "invalid value for '--frames': 0 is not in the range x>=1."
