"""Which workspace is the current one."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import dmotion_bench as dm
from dmotion_bench.errors import RunMissing, UnknownName, UsageError
from dmotion_bench.execution.local_executor import LocalExecutor
from dmotion_bench.workspace import AnyPath, Workspace, in_workspace


@in_workspace
def current(*, workspace: AnyPath | None = None, depth: int = 0) -> Path:
    return current(depth=depth - 1) if depth else Workspace.current().root


@pytest.fixture(autouse=True)
def _own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DMBENCH_WORKSPACE", "own")


def test_a_call_is_in_the_workspace_that_it_names() -> None:
    assert current() == Path("own")
    assert current(workspace="named") == Path("named")
    assert current(workspace="named", depth=2) == Path("named")
    assert current() == Path("own")


def test_an_error_leaves_the_workspace() -> None:
    @in_workspace
    def failing(*, workspace: AnyPath | None = None) -> None:
        raise ZeroDivisionError(str(Workspace.current().root))

    with pytest.raises(ZeroDivisionError, match="named"):
        failing(workspace="named")
    assert current() == Path("own")


def test_another_thread_has_its_own() -> None:
    with Workspace("named").entered(), ThreadPoolExecutor(1) as other:
        assert other.submit(current).result() == Path("own")


def root(_: int) -> str:
    return str(Workspace.current().root)


def test_jobs_are_done_in_the_workspace_of_whoever_gives_them(tmp_path: Path) -> None:
    executor = LocalExecutor(1)
    assert list(executor.map_unordered(root, [0])) == [str(Path("own").absolute())]
    with Workspace(tmp_path).entered():
        assert list(executor.map_unordered(root, [0])) == [str(tmp_path)]


def test_what_is_no_path_is_a_sentence() -> None:
    with pytest.raises(UsageError, match="5 stands for no workspace; give one name, or one path"):
        dm.record("grid_world", "tiny", workspace=5)  # type: ignore[arg-type]


def test_what_cannot_be_found_says_what_to_type(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    for name in ("one", "mit Leer"):
        (workspace.data / name).mkdir(parents=True)
        (workspace.data / name / "dataset.json").write_text("{}")
    with pytest.raises(UsageError, match=r"as the argument or with '--data':\n  'mit Leer'\n  one$"):
        workspace.dataset(None)
    with pytest.raises(RunMissing, match=r"is no run: it holds no run\.json\. 'dmbench list runs' lists the runs"):
        workspace.run(workspace.data / "one")
    with pytest.raises(UnknownName, match="did you mean 'oracle'"):
        workspace.run("orakle", ("oracle", "idle"))


def test_a_name_without_a_seed_stands_for_the_trainings_with_one(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    for name in ("a-s10", "a-s2", "a-b-s0", "b", "b-s0", "a-s2-c", "[a]-s1"):
        (workspace.runs / name).mkdir(parents=True)
        (workspace.runs / name / "run.json").write_text("{}")
    (workspace.runs / "a-s3").mkdir()  # no run

    def names(given: AnyPath) -> list[str]:
        return [run.name for run in workspace.trainings(given)]

    assert names("a") == names(workspace.runs / "a") == ["a-s2", "a-s10"]
    assert names("[a]") == ["[a]-s1"]
    assert names("a-s2") == ["a-s2"]
    assert names("b") == ["b"]
    with pytest.raises(UnknownName, match="no run named 'c'"):
        workspace.trainings("c")
