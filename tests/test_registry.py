"""What packages register is read once, and again when packages come or go."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from dmotion_bench import registry
from dmotion_bench.entry_points import MODELS, names
from dmotion_bench.errors import UnknownName
from dmotion_bench.registry import environment_title

POINTS = "[dmbench.models]\n{name} = no_such_module:Model\n"


def _install(site: Path, name: str) -> Path:
    """Put a package that registers a model into a folder where packages are found."""
    facts = site / f"{name.replace('-', '_')}-1.dist-info"
    facts.mkdir()
    (facts / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1\n")
    (facts / "entry_points.txt").write_text(POINTS.format(name=name))
    return facts


def test_packages_that_come_and_go_are_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "newcomer" not in names(MODELS)

    facts = _install(tmp_path, "newcomer")
    assert "newcomer" in names(MODELS)
    assert "dmotion" in names(MODELS)

    shutil.rmtree(facts)
    os.utime(tmp_path, ns=(1, 1))  # however coarse the clock of the file system is
    assert "newcomer" not in names(MODELS)


def test_a_folder_that_is_added_later_is_looked_into(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _install(tmp_path, "latecomer")
    assert "latecomer" not in names(MODELS)

    monkeypatch.syspath_prepend(str(tmp_path))

    assert "latecomer" in names(MODELS)


def test_metadata_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    first = names(MODELS)

    def read_again(**_: str) -> None:
        raise AssertionError("read again, although nothing changed")

    monkeypatch.setattr("dmotion_bench.entry_points.entry_points", read_again)

    assert names(MODELS) == first


def test_a_world_is_called_by_its_own_title_or_by_its_name_in_words() -> None:
    assert environment_title("push_t") == "PushT"
    assert environment_title("grid_world") == "Grid World"
    assert environment_title("somebody_elses") == "Somebody Elses"
    assert environment_title("gym:CartPole-v1") == "gym:CartPole-v1"


def test_somebody_who_asks_for_a_class_of_their_own_is_told_how_it_becomes_known() -> None:
    with pytest.raises(UnknownName, match="where register_model was called, or once its package is installed"):
        registry.model_class("xyzzy")
    with pytest.raises(UnknownName, match="register_environment"):
        registry.environment_class("xyzzy")
    with pytest.raises(UnknownName) as near:
        registry.model_class("dmotoin")
    assert "register" not in str(near.value)
