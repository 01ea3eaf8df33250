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
from typer.testing import CliRunner

from dmotion_bench.cli.app import app, register_commands

GOLDEN = Path(__file__).parent / "help.txt"


def _paths(command: click.Command, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    yield path
    for name, inner in getattr(command, "commands", {}).items():
        yield from _paths(inner, (*path, name))


def test_the_help_of_every_command_is_as_written_down(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("TERM", "dumb")
    register_commands()
    pages = []
    for path in _paths(typer.main.get_command(app)):
        result = CliRunner().invoke(app, [*path, "--help"], prog_name="dmbench", terminal_width=100)
        assert result.exit_code == 0, result.output
        pages.append(f"$ dmbench {' '.join([*path, '--help'])}\n{result.output.rstrip()}\n")
    text = "\n".join(pages)
    if os.environ.get("DMBENCH_WRITE_GOLDEN"):
        GOLDEN.write_text(text)
    assert text == GOLDEN.read_text()


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
