"""``dmbench list``: what can vary in each environment, which models there are, and tables on any terminal."""

from __future__ import annotations

import json
import re
from importlib.metadata import EntryPoint

import pytest
from dmbench_command import dmbench

from dmotion_bench import registry
from dmotion_bench.cli.tables import show_rows
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
    monkeypatch.setenv("COLUMNS", "200")
    table = dmbench(["list", "environments"], capsys, monkeypatch).out

    assert "--vary" in table
    words = " ".join(table.split())
    assert "friction, mass, colour, light, camera, distractors, background" in words
    assert "expert-correlated" in words


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
    assert NAME in "".join(line.replace("10%", "").strip() for line in printed.splitlines()[3:])


@pytest.fixture
def strangers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Packages of others: one that breaks on import, one that takes the name of a model of ours."""
    real = registry.registered

    def found(group: str) -> list[EntryPoint]:
        more = {"broken": "no_such_module:Model", "lapo": "antigravity_models:Lapo"}
        return [*real(group), *(EntryPoint(name, value, group) for name, value in more.items())]

    monkeypatch.setattr("dmotion_bench.registry.registered", found)


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
