"""What ``dm.view`` writes, serves and refuses."""

from __future__ import annotations

import urllib.request
from pathlib import Path
from typing import Any

import pytest

import dmotion_bench as dm
from dmotion_bench.errors import UnknownName, UsageError, ViewerError


@pytest.mark.slow
def test_views_are_written_to_files(workspace: Path) -> None:
    assert dm.view(dm.load_run("tiny"), save="run.rrd", episodes=[0]) == Path("run.rrd")
    assert dm.view("tiny", save="run.gif", steps=2, episodes=[0]) == Path("run.gif")
    assert dm.view([str(workspace / "runs" / "tiny")], save=workspace / "again.rrd", episodes=[0])
    for name in ("run.rrd", "run.gif", "again.rrd"):
        assert (workspace / name).stat().st_size > 1000


def test_a_page_is_served_until_it_is_closed(workspace: Path) -> None:
    page = dm.view("grid_world-tiny", web=True, episodes=[0], save="page.rrd")
    assert isinstance(page, dm.Served)
    assert (workspace / "page.rrd").stat().st_size > 1000
    assert repr(page) == f"<Served: {page.url}>"
    with page, urllib.request.urlopen(page.url, timeout=30) as answer:
        assert answer.status == 200
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(page.url, timeout=60)


@pytest.mark.parametrize(
    ("asked", "kind", "said"),
    [
        ({"what": "tiny", "save": "x.png"}, UsageError, "must end in .rrd"),
        ({"what": "tiny", "steps": 3}, UsageError, "steps is for an animation"),
        ({"what": "tinny", "save": "x.rrd"}, UnknownName, "did you mean 'tiny'"),
        ({"what": [], "save": "x.rrd"}, UsageError, "nothing is named"),
        ({"what": "grid_world-tiny", "save": "x.gif"}, UsageError, "name runs"),
        ({"what": "tiny", "save": "x.gif", "web": True}, UsageError, "without --live and --web"),
        ({"what": ["tiny", "grid_world-tiny"], "save": "x.rrd"}, UsageError, "only runs can be shown side by side"),
        ({"what": "tiny"}, ViewerError, "no display"),
    ],
)
def test_what_cannot_be_shown_is_refused(
    workspace: Path, monkeypatch: pytest.MonkeyPatch, asked: dict[str, Any], kind: type[Exception], said: str
) -> None:
    monkeypatch.setattr("sys.platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(kind, match=said.replace(".", r"\.")):
        dm.view(**asked)
    assert not list(workspace.glob("x.*"))
