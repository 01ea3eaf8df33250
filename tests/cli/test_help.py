"""The help of every command is a golden file, and asking for it loads nothing heavy.

After a change that is meant, write the file anew: ``DMBENCH_WRITE_GOLDEN=1 python -m pytest tests/cli/test_help.py``.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
import typer
from click.testing import CliRunner

from dmotion_bench.api.settings import EXECUTORS
from dmotion_bench.cli import options
from dmotion_bench.cli.app import app, register_commands
from dmotion_bench.errors import UnknownName
from dmotion_bench.execution.executors import make_executor

GOLDEN = Path(__file__).parent / "help.txt"


def _paths(command: click.Command, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    yield path
    for name, inner in getattr(command, "commands", {}).items():
        yield from _paths(inner, (*path, name))


@pytest.fixture(scope="module")
def parser() -> click.Command:
    """The command line, which takes a moment to build."""
    register_commands()
    return typer.main.get_command(app)


def test_the_help_of_every_command_is_as_written_down(parser: click.Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("TERM", "dumb")
    pages = []
    for path in _paths(parser):
        result = CliRunner().invoke(parser, [*path, "--help"], prog_name="dmbench", terminal_width=100)
        assert result.exit_code == 0, result.output
        pages.append(f"$ dmbench {' '.join([*path, '--help'])}\n{result.output.rstrip()}\n")
    text = "\n".join(pages)
    if os.environ.get("DMBENCH_WRITE_GOLDEN"):
        GOLDEN.write_text(text)
    assert text == GOLDEN.read_text()


@pytest.mark.slow
def test_asking_for_help_loads_no_torch_and_no_simulator() -> None:
    code = (
        "import sys\n"
        "from dmotion_bench.cli import main\n"
        "sys.argv = ['dmbench', '--help']\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert not end.code, end.code\n"
        "heavy = {'torch', 'pybullet', 'pymunk', 'rerun', 'pyarrow', 'lightning_fabric'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)


def test_the_listed_names_are_those_that_there_are() -> None:
    """The names that ``--help`` lists stand in ``cli/options.py``, so that asking for help loads nothing heavy."""
    from dmotion_bench.planning.agents import REFERENCES
    from dmotion_bench.planning.columns import COLUMNS
    from dmotion_bench.registry import objective_names, solver_names
    from dmotion_bench.scoring.settings import METRICS

    assert list(options.PLANNERS) == solver_names()
    assert list(options.OBJECTIVES) == objective_names()
    assert tuple(COLUMNS) == options.COLUMNS
    assert (options.REFERENCES, options.METRICS) == (REFERENCES, METRICS)
    with pytest.raises(UnknownName, match=f"known: {', '.join(sorted(EXECUTORS))}"):
        make_executor("?")


@pytest.mark.parametrize("command", ["score", "plan"])
@pytest.mark.parametrize(
    ("option", "names"), [("--planner", options.PLANNERS), ("--objective, --cost", options.OBJECTIVES)]
)
def test_help_lists_what_a_choice_allows(
    parser: click.Command, command: str, option: str, names: tuple[str, ...]
) -> None:
    result = CliRunner().invoke(parser, [command, "--help"], prog_name="dmbench", terminal_width=100)
    assert f"{option} [{'|'.join(names)}]" in result.output
