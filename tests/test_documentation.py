"""The documentation's commands: each is one that ``dmbench`` understands, and the road through them is walked."""

from __future__ import annotations

import json
import re
import shlex
from contextlib import suppress
from pathlib import Path

import click
import pytest
import typer
from dmbench_command import Outcome, dmbench

from dmotion_bench.cli.app import app, register_commands
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.settings import with_settings
from dmotion_bench.registry import model_class, model_names
from dmotion_bench.specs import Preset

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])


def _commands(page: Path) -> list[str]:
    """Every ``dmbench ...`` in a code block's line or between backticks, without comments."""
    text = page.read_text()
    blocks = re.findall(r"^```[a-z]*\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = [line.removeprefix("$ ") for block in blocks for line in block.splitlines()]
    spans = re.findall(r"`(dmbench [^`\n]+)`", text)
    return [line.split("  #")[0].strip() for line in [*lines, *spans] if line.startswith("dmbench ")]


def _is_example(command: str) -> bool:
    """Whether it can be parsed: no ellipsis, no alternatives, no placeholder in capital letters for a subcommand."""
    return not re.search(r"\.\.\.|\[|\||<", command)


@pytest.mark.parametrize(
    "setting", sorted(set(re.findall(r"--set (\w+=[\w.]+)", (ROOT / "docs" / "baselines.md").read_text())))
)
def test_every_setting_of_the_baselines_page_is_one_of_their_models(setting: str) -> None:
    understood = []
    for name in model_names():
        model = model_class(name)
        with suppress(InvalidSetting):
            with_settings([setting], model.configure("compact"), model.training_defaults(Preset.SMALL, "compact"))
            understood.append(name)
    assert understood


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_of_the_documentation_is_understood(page: Path) -> None:
    register_commands()
    for line in filter(_is_example, _commands(page)):
        words = shlex.split(line)[1:]
        command: click.Command = typer.main.get_command(app)
        while isinstance(command, click.Group) and words:
            assert words[0] in command.commands, f"{page.name}: {line}"
            command, words = command.commands[words[0]], words[1:]
        if words or not isinstance(command, click.Group):
            try:
                command.make_context("dmbench", words)
            except click.exceptions.Exit:
                continue  # --help and --version
            except click.UsageError as error:
                pytest.fail(f"{page.name}: {line}: {error.format_message()}")


def test_the_readmes_road_leads_from_nothing_to_a_report_and_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))

    def run(*words: str) -> Outcome:
        outcome = dmbench(words, capsys, monkeypatch)
        assert (outcome.code, outcome.err) == (0, ""), outcome.err
        return outcome

    recorded = json.loads(run("record", "grid_world", "--preset", "tiny", "--json").out)
    assert (recorded["episodes"], recorded["frames"]) == (20, 240)
    assert "sound" in run("data", "check", recorded["dataset"]).out
    trained = json.loads(run("train", "dmotion", "--set", "epochs=0.2", "--json").out)
    assert trained["labels"] == 4
    (report,) = json.loads(run("score", "--horizon", "4", "--json").out)["reports"]
    assert {"mse", "psnr", "ssim", "position_error_paper", "rollout_mse[4]"} <= set(report["figures"])
    assert report["figures"]["mse"]["n"] == 2 * 10
    run("view", trained["run"], "--save", str(tmp_path / "run.rrd"))
    assert (tmp_path / "run.rrd").stat().st_size > 10_000
    for kind in ("environments", "models", "datasets", "runs"):
        assert json.loads(run("list", kind, "--json").out)[kind]
    assert json.loads(run("info", "--json").out)["runs"] == [Path(trained["run"]).name]
