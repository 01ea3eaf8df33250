"""``--json``: one object on stdout, and whatever else is printed meanwhile on stderr."""

from __future__ import annotations

import io
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from dmotion_bench.cli import main
from dmotion_bench.cli.options import AsJson
from dmotion_bench.cli.stdout import own_stdout, print_json

app = typer.Typer()


@app.command()
def loud(as_json: AsJson = False, fails: bool = False) -> None:
    """Prints in all ways that there are."""
    sys.stdout.write("by Python\n")
    os.write(1, b"by the system\n")
    subprocess.run([sys.executable, "-c", "print('by a process')"], check=True)
    if fails:
        raise RuntimeError("it broke")
    if as_json:
        with own_stdout():
            subprocess.run([sys.executable, "-c", "print('chosen')"], check=True)
        print_json({"done": True})
    sys.stdout.write("afterwards\n")


@app.command()
def quiet() -> None:
    """Has no such option."""


def test_the_object_is_alone_whoever_else_prints(capfd: pytest.CaptureFixture[str]) -> None:
    app(["loud", "--json"], standalone_mode=False)
    sys.stdout.write("after the command\n")
    printed = capfd.readouterr()
    assert printed.out == 'chosen\n{"done": true}\nafter the command\n'
    assert set(printed.err.split("\n")) == {"by Python", "by the system", "by a process", "afterwards", ""}


def test_what_is_printed_is_json_also_where_a_number_is_none(capfd: pytest.CaptureFixture[str]) -> None:
    """A lossless video has an endless PSNR."""
    print_json({"psnr": math.inf, "each": [1.5, math.nan], "pair": (-math.inf, 2, True, None, "NaN")})
    assert json.loads(capfd.readouterr().out, parse_constant=pytest.fail) == {
        "psnr": None,
        "each": [1.5, None],
        "pair": [None, 2, True, None, "NaN"],
    }


def test_without_the_option_nothing_is_changed(capfd: pytest.CaptureFixture[str]) -> None:
    app(["loud"], standalone_mode=False)
    printed = capfd.readouterr()
    assert set(printed.out.split("\n")) == {"by Python", "by the system", "by a process", "afterwards", ""}
    assert not printed.err


def test_stdout_is_given_back_when_the_command_fails(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RuntimeError, match="it broke"):
        app(["loud", "--json", "--fails"], standalone_mode=False)
    sys.stdout.write("after the command\n")
    assert capfd.readouterr().out == "after the command\n"


def test_a_stream_that_somebody_put_in_place_of_stdout_gets_the_object() -> None:
    outcome = CliRunner().invoke(app, ["loud", "--json"])
    assert json.loads(outcome.stdout) == {"done": True}
    assert "by Python" in outcome.stderr


@pytest.mark.slow
def test_a_package_that_prints_when_it_is_imported_does_not_spoil_a_list(tmp_path: Path) -> None:
    facts = tmp_path / "loud-1.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: loud\nVersion: 1\n")
    (facts / "entry_points.txt").write_text("[dmbench.models]\nloud = loud:Loud\n")
    module = (
        "print('welcome to loud')\nfrom baselines.jepa import LatentWorldModel\nclass Loud(LatentWorldModel): ...\n"
    )
    (tmp_path / "loud.py").write_text(module)
    listing = subprocess.run(
        [sys.executable, "-m", "dmotion_bench", "list", "models", "--json"],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])},
        capture_output=True,
        text=True,
        check=True,
    )
    assert "loud" in {one["model"] for one in json.loads(listing.stdout)["models"]}
    assert "welcome to loud" in listing.stderr


def test_what_the_encoding_of_stdout_lacks_spoils_no_output(monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, encoding="ascii"))
    monkeypatch.setattr(sys, "argv", ["dmbench", "--version"])
    with pytest.raises(SystemExit):
        main()
    sys.stdout.write("2 \u00b1 1\n")
    Console(highlight=False).print("R\u00b2")
    sys.stdout.flush()
    assert written.getvalue().splitlines()[1:] == [b"2 ? 1", b"R?"]
