"""``dmbench list``: what can vary in each environment, which models there are, and tables on any terminal."""

from __future__ import annotations

import json
import re
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from dmbench_command import dmbench

from dmotion_bench import entry_points
from dmotion_bench.cli.tables import show_figures, show_rows
from dmotion_bench.planning.columns import COLUMNS
from dmotion_bench.workspace import Workspace
from recorders.distractors.scenes import NAMES
from recorders.planar_push.environment import FACTORS, PlanarPush


def test_what_may_vary_stands_beside_each_environment(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    listed = json.loads(dmbench(["list", "environments", "--json"], capsys, monkeypatch).out)["environments"]
    factors = {one["environment"]: one["factors"] for one in listed}

    assert list(factors["grid_world"]) == list(NAMES)
    own = [one for one in listed if ":" not in one["environment"]]
    assert {one["environment"]: list(one["versions"]) for one in own} == {
        "grid_world": ["1", "2"],
        "planar_push": ["1"],
        "push_t": ["1"],
        "robot_push": ["1"],
    }
    assert {one["tier"] for one in own} == {"masks"}
    others = {one["environment"]: one for one in listed if one not in own}
    assert others["gym:CartPole-v1"]["tier"] == "pixels"
    assert others["gym:CartPole-v1"]["factors"] == {}
    assert list(factors["planar_push"]) == [factor.name for factor in FACTORS]
    PlanarPush(vary=",".join(factors["planar_push"])).close()  # it takes every one of them
    assert factors["robot_push"]["mass"] == "an object's mass [kg]: 0.05 to 0.6; shifted: 0.02 to 0.04 or 0.7 to 1"


def test_the_table_names_them(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    table = dmbench(["list", "environments"], capsys, monkeypatch).out

    assert "--vary" in table
    words = " ".join(table.split())
    assert "friction, mass, colour, light, camera, distractors, background" in words
    assert "expert-correlated" in words


@pytest.mark.parametrize("words", [(), ("--json",)])
def test_an_environment_that_cannot_be_used_does_not_hide_the_others(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    undescribed = type("Undescribed", (PlanarPush,), {})
    added = {(entry_points.ENVIRONMENTS, "broken"): int, (entry_points.ENVIRONMENTS, "undescribed"): undescribed}
    monkeypatch.setattr(entry_points, "_ADDED", added)

    listed = dmbench(["list", "environments", *words], capsys, monkeypatch).out

    assert "cannot be used: the class 'int' of the environment 'broken' has no 'recording'" in " ".join(listed.split())
    assert "grid_world" in listed
    if words:
        rows = {one["environment"]: one for one in json.loads(listed)["environments"]}
        assert (rows["broken"]["policies"], rows["broken"]["factors"]) == ([], {})
        assert (rows["undescribed"]["what"], rows["undescribed"]["tier"]) == ("", "masks")


NAME = "runs/clasp-grid_world-small-epochs_0.3-kernel_27-20-shot-s0"


def test_a_pipe_has_no_edge_to_cut_a_name_at(capsys: pytest.CaptureFixture[str]) -> None:
    show_rows(("run", "paper"), [(NAME, "word " * 60 + "[end]")])

    (line,) = [line for line in capsys.readouterr().out.splitlines() if NAME in line]
    assert line.rstrip().endswith("word [end]")


def test_a_narrow_terminal_folds_a_name_and_keeps_all_of_it(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("NO_COLOR", "1")

    show_rows(("run", "labels"), [(NAME, "10%")])

    printed = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert max(map(len, printed.splitlines())) <= 40
    assert NAME in "".join(line.strip() for line in printed.splitlines())
    assert "  labels  10%" in printed.splitlines()


@pytest.mark.slow
@pytest.mark.parametrize("what", ["environments", "models"])
def test_on_eighty_columns_no_word_is_broken(
    what: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = dmbench(["list", what], capsys, monkeypatch).out
    monkeypatch.setenv("COLUMNS", "80")
    narrow = dmbench(["list", what], capsys, monkeypatch).out

    lines = narrow.splitlines()[: -2 if what == "environments" else None]  # what stands below the table is no table
    assert max(map(len, lines)) <= 80 < max(map(len, whole.splitlines()))
    assert {word for word in whole.split() if "─" not in word} <= set(narrow.split())


def test_no_line_ends_in_blanks_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    show_rows(("run", "labels"), [(NAME, "10%"), ("a", "b")])
    show_figures("title", ("run", "labels", "MSE"), [("a run of a long name", "10%", ""), ("b", "", "3")])
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if line != line.rstrip()] == []


def test_what_lies_in_the_workspace_is_listed_by_the_name_that_finds_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    folder = tmp_path / "runs" / "mine"
    folder.mkdir(parents=True)
    (folder / "run.json").write_text("{}")
    workspace = Workspace.current()

    assert dmbench(["list", "runs"], capsys, monkeypatch).out.splitlines()[3].split()[0] == "mine"
    (listed,) = json.loads(dmbench(["list", "runs", "--json"], capsys, monkeypatch).out)["runs"]
    assert listed["run"] == str(folder)
    assert workspace.run(workspace.short(folder)) == folder
    assert workspace.short(tmp_path / "other" / "mine") == tmp_path / "other" / "mine"
    Path("mine").mkdir()  # a path is looked for first
    assert workspace.short(folder) == folder


@pytest.mark.parametrize("columns", ["", "30"])
def test_a_folder_s_name_gives_the_terminal_no_orders(
    columns: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It sets the title of the window, clears the screen, and begins an order as terminals of 8 bits know it."""
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    monkeypatch.setenv("COLUMNS", columns)
    folder = tmp_path / "runs" / "a\x1b]0;b\x07\x1b[2J\x9b"
    folder.mkdir(parents=True)
    (folder / "run.json").write_text("{}")
    said = dmbench(["list", "runs"], capsys, monkeypatch)
    assert r"a\x1b]0;b\x07\x1b[2J\x9b" in "".join(said.out.split())
    assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]", said.out + said.err)


@pytest.fixture
def strangers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Packages of others: one that breaks on import, one that takes the name of a model of ours."""
    real = entry_points.registered

    def found(group: str) -> list[EntryPoint]:
        more = {"broken": "no_such_module:Model", "lapo": "antigravity_models:Lapo"}
        return [*real(group), *(EntryPoint(name, value, group) for name, value in more.items())]

    monkeypatch.setattr("dmotion_bench.entry_points.registered", found)


@pytest.mark.usefixtures("strangers")
def test_what_strangers_register_spoils_no_list(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    listed = json.loads(dmbench(["list", "models", "--json"], capsys, monkeypatch).out)["models"]
    papers = {row["model"]: row["paper"] for row in listed}

    assert "cannot be imported (ModuleNotFoundError): No module named 'no_such_module'." in papers["broken"]
    assert "rename or uninstall one" in papers["lapo"]
    assert "Yuan" in papers["dmotion"]


@pytest.mark.usefixtures("strangers")
def test_a_name_that_two_packages_register_is_nobodys(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = dmbench(["train", "lapo"], capsys, monkeypatch)

    assert outcome.code == 1
    assert "antigravity_models:Lapo" in outcome.sentence()
    assert "baselines.lapo:" in outcome.sentence()


def test_columns_are_told_with_what_they_are(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    listed = json.loads(dmbench(["list", "columns", "--json"], capsys, monkeypatch).out)["columns"]

    assert [row["column"] for row in listed] == list(COLUMNS)
    assert [row["column"] for row in listed if row["actions"] == "continuous"] == ["generic-wide"]
    wide, paper = (next(row for row in listed if row["column"] == name) for name in ("generic-wide", "paper"))
    assert (wide["planner"], wide["objective"]) == (
        "icem cost_at=last initial_std=1 horizon=10 hold=2 samples=25",
        "tracked-risk",
    )
    assert (paper["planner"], paper["objective"], paper["protocol"]) == ("cem", "centres", "dmbench-2")
    shown = dmbench(["list", "columns"], capsys, monkeypatch).out
    assert all(name in shown for name in COLUMNS)
