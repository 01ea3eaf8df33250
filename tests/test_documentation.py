"""The documentation: its commands are understood, its links lead somewhere, its results are those of the entries."""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from contextlib import suppress
from pathlib import Path

import click
import pytest
import typer
from dmbench_command import Outcome, dmbench
from PIL import Image

from dmotion_bench.cli.app import app, register_commands
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.settings import with_settings
from dmotion_bench.registry import model_class, model_names
from dmotion_bench.specs import Preset
from leaderboard.results import write_results

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
EVERY_PAGE = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")])
README = ROOT / "README.md"
MODELS = sorted((ROOT / "docs" / "models").glob("*.md"))
WITH_RESULTS = [README, ROOT / "docs" / "results.md", *MODELS]
MOST_WORDS, MOST_CHARACTERS, MOST_BYTES = 900, 120, 2_000_000


def _page_name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def _without_code(page: Path) -> str:
    """A page's text without code blocks and what stands between backticks."""
    return re.sub(r"`[^`\n]+`", "", re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL))


def _anchors(page: Path) -> set[str]:
    """The anchors that GitHub gives to a page's headings."""
    headings = re.findall(
        r"^#+ (.+)$", re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL), re.MULTILINE
    )
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def _lines(file: Path) -> set[str]:
    """The anchors that GitHub and the site give to the lines of a source."""
    return {f"L{number}" for number in range(1, len(file.read_text().splitlines()) + 1)}


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


SETTINGS = [re.findall(r"--set (\w+=[\w.]+)", page.read_text()) for page in (ROOT / "docs" / "baselines.md", *MODELS)]


@pytest.mark.parametrize("setting", sorted({one for page in SETTINGS for one in page}))
def test_every_setting_of_the_models_pages_is_one_of_their_models(setting: str) -> None:
    understood = []
    for name in model_names():
        model = model_class(name)
        with suppress(InvalidSetting):
            with_settings([setting], model.configure("compact"), model.training_defaults(Preset.SMALL, "compact"))
            understood.append(name)
    assert understood


@pytest.fixture(scope="module")
def parser() -> click.Command:
    """The command line, which takes a moment to build."""
    register_commands()
    return typer.main.get_command(app)


@pytest.mark.parametrize("page", EVERY_PAGE, ids=_page_name)
def test_every_command_of_the_documentation_is_understood(page: Path, parser: click.Command) -> None:
    for line in filter(_is_example, _commands(page)):
        words, command = shlex.split(line)[1:], parser
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


@pytest.mark.parametrize("page", EVERY_PAGE, ids=_page_name)
def test_every_link_leads_somewhere(page: Path) -> None:
    text = _without_code(page)
    targets = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r"^\[[^\]]+\]: (\S+)$", text, re.MULTILINE)
    defined = set(re.findall(r"^\[([^\]]+)\]: ", text, re.MULTILINE))
    assert set(re.findall(r"\]\[([^\]]+)\]", text)) <= defined
    for target in targets:
        if re.match(r"https?://", target):
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.is_relative_to(ROOT), target
        assert file.exists(), target
        assert not anchor or anchor in (_anchors(file) if file.suffix == ".md" else _lines(file)), target


@pytest.mark.parametrize("page", [page for page in EVERY_PAGE if page.name != "CHANGELOG.md"], ids=_page_name)
def test_lines_are_short(page: Path) -> None:
    """But for the rows of generated tables, which cannot be broken."""
    text = re.sub(
        r"<!-- results:.*?<!-- /results -->",
        lambda table: "\n" * table[0].count("\n"),
        page.read_text(),
        flags=re.DOTALL,
    )
    long = [number for number, line in enumerate(text.splitlines(), start=1) if len(line) > MOST_CHARACTERS]
    assert not long, f"lines of {_page_name(page)} with more than {MOST_CHARACTERS} characters: {long}"


def test_the_readme_is_one_page() -> None:
    text = re.sub(r"^```.*?^```|<!--.*?-->", "", README.read_text(), flags=re.MULTILINE | re.DOTALL)
    assert len(text.split()) <= MOST_WORDS


@pytest.mark.slow
def test_results_in_pages_are_those_of_the_entries() -> None:
    differing = write_results(ROOT / "docs" / "leaderboard", WITH_RESULTS, check=True)
    assert not differing, "write them with 'make results'"


@pytest.mark.parametrize("page", WITH_RESULTS, ids=_page_name)
def test_no_result_is_typed_by_hand(page: Path) -> None:
    text = re.sub(r"<!-- results:.*?<!-- /results -->", "", _without_code(page), flags=re.DOTALL)
    typed = re.findall(r"\d+\.\d+|\d+,\d{3}", re.sub(r"\]\([^)]+\)", "", text))
    assert set(typed) <= {"3.11"}  # Python's version


def test_every_picture_is_shown_somewhere() -> None:
    text = "".join(page.read_text() for page in EVERY_PAGE)
    folder = ROOT / "docs" / "images"
    pictures = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    assert [name for name in pictures if f"images/{name})" not in text] == []


def test_the_readmes_picture_moves_and_is_small() -> None:
    (target,) = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", README.read_text())
    assert (ROOT / target).stat().st_size < MOST_BYTES
    with Image.open(ROOT / target) as picture:
        assert getattr(picture, "n_frames", 1) > 10
        assert picture.width <= 1600


def test_the_citation_is_of_this_version() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f'\nversion: "{version}"\n' in (ROOT / "CITATION.cff").read_text()
    assert f"version = {{{version}}}" in README.read_text()


@pytest.mark.slow
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
    for kind in ("environments", "models", "columns", "datasets", "runs"):
        assert json.loads(run("list", kind, "--json").out)[kind]
    assert json.loads(run("info", "--json").out)["runs"] == [Path(trained["run"]).name]
