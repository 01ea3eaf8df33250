"""A model's results in its page: the rows of all boards, and charts that a browser reads without the page's style."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from dmotion_bench.registry import model_names
from leaderboard import planners
from leaderboard.board import Board, make_boards
from leaderboard.chart import WIDTH
from leaderboard.entry import Entry
from leaderboard.entry_file import write_entry
from leaderboard.model_results import CURVE, NOTHING, model_charts, model_lines
from leaderboard.results import write_results

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture
def result(sound: Entry) -> Callable[..., Entry]:
    """Makes an entry of one model, whose error 1, 2 and 4 steps ahead and distances in control are given."""

    def make(name: str, errors: tuple[float, ...], distances: tuple[float, ...] = (), **content: Any) -> Entry:
        made = copy.deepcopy(dict(sound.content)) | {"model": "dmotion", "run": name, "weights": "0" * 64}
        steps = {f"rollout_mse[{step}]": one for step, one in zip((1, 2, 4), errors, strict=True)}
        controlled = {f"control_distance[{step}]": one for step, one in enumerate(distances, start=1)}
        made["figures"] = _figures({"mse": errors[0]} | steps | controlled)
        made["by_episode"] = {}
        made["reference"] = {
            "copy_last": _figures(
                {"mse": 100.0, "rollout_mse[1]": 100.0, "rollout_mse[2]": 200.0, "rollout_mse[4]": 400.0}
            ),
            "idle": _figures({"control_distance[1]": 1.0, "control_distance[2]": 1.0}),
            "oracle": _figures({"control_distance[1]": 0.5, "control_distance[2]": 0.25}),
        }
        if distances:
            made["settings"] = made["settings"] | {"control_code": "planner-1", "control_tasks": 20}
        made["labels"] = {"asked": "one-shot", "given": {}, "total": 4}
        return Entry(made | content)

    return make


def _figures(means: dict[str, float]) -> dict[str, Any]:
    return {
        name: {"mean": mean, "std": 1.0, "low": mean / 2, "high": mean * 2, "n": 60} for name, mean in means.items()
    }


@pytest.fixture
def boards(result: Callable[..., Entry], sound: Entry) -> list[Board]:
    second = dict(sound.content["dataset"]) | {"fingerprint": "f" * 64, "name": "other|data"}
    return make_boards(
        [
            result("dmotion-grid_world-tiny-s0", (10.0, 40.0, 100.0), (0.9, 0.5)),
            result("dmotion-grid_world-tiny-warp_true-s0", (5.0, 20.0, 100.0)),
            result(
                "dmotion-grid_world-tiny-5-shot-s0",
                (1.0, 2.0, 4.0),
                labels={"asked": "5-shot", "given": {}, "total": 20},
            ),
            result("dmotion-other-s0", (25.0, 50.0, 400.0), dataset=second),
            result("cswm-s0", (7.0, 8.0, 9.0), model="cswm"),
        ]
    )


def _rows(lines: list[str]) -> list[list[str]]:
    tables = (line for line in lines if line.startswith("|"))
    cells = [[cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]] for line in tables]
    return [row for row in cells if not row[0].startswith("---")]


def test_the_points_of_a_label_curve_are_left_to_the_boards(result: Callable[..., Entry]) -> None:
    points = [
        result(f"dmotion-{total}-s0", (error, 1.0, 1.0), labels={"asked": asked, "given": {}, "total": total})
        for asked, total, error in (("4", 4, 9.0), ("16", 16, 8.0), ("100%", 64, 7.0))
    ]
    lines = model_lines("dmotion", make_boards(points))
    assert [row[1] for row in _rows(lines)[1:]] == ["64"]
    assert CURVE in lines
    assert CURVE not in model_lines("dmotion", make_boards(points[1:]))


def test_the_rows_of_all_boards_stand_beside_copying_and_control(boards: list[Board]) -> None:
    head, *rows = _rows(model_lines("dmotion", boards))
    predicted = rows[: next(place for place, row in enumerate(rows) if row[0] == "Data set")]
    assert head == ["Data set", "Variant", "Labels", "Trainings", "MSE", "copying"]
    assert [(row[0], row[1], row[2], row[5]) for row in predicted] == [
        ("grid_world-tiny", "", "20 (5 each)", "100"),
        ("grid_world-tiny", "warp true", "4 (1 each)", "100"),
        ("grid_world-tiny", "", "4 (1 each)", "100"),
        ("other\\|data", "", "4 (1 each)", "100"),
    ]
    assert [row[4].split(" ")[0].strip("*") for row in predicted] == ["1.00", "5.00", "10.0", "25.0"]

    control_head, control = rows[len(predicted) :]
    assert control_head == ["Data set", "Labels", "Tasks", "Distance left", "idle", "true simulator", "Tuned here"]
    assert control[2:] == ["60", "**0.500** (0.25\u00a0to\u00a01.0)", "1.00", "0.250", "not known"]


def test_a_planner_that_was_tuned_on_the_tasks_is_marked_in_the_table_and_in_the_chart(
    boards: list[Board], monkeypatch: pytest.MonkeyPatch
) -> None:
    known = {board.fingerprint: 60 for board in boards}
    monkeypatch.setattr(planners, "_tuned_tasks", lambda: {"planner-1": known})
    assert _rows(model_lines("dmotion", boards))[-1][-1] == "yes"
    assert "grid_world-tiny, one-shot, tuned here" in model_charts("dmotion", boards)["dmotion-control.svg"]
    monkeypatch.setattr(planners, "_tuned_tasks", lambda: {"planner-1": {}})
    assert _rows(model_lines("dmotion", boards))[-1][-1] == "no"
    assert "tuned here" not in model_charts("dmotion", boards)["dmotion-control.svg"]


def test_a_model_without_entries_has_a_sentence(boards: list[Board]) -> None:
    assert model_lines("laom", boards) == ["", NOTHING, ""]
    assert model_charts("laom", boards) == {}


def test_charts_have_the_best_variant_of_each_data_set_at_its_place(boards: list[Board]) -> None:
    charts = model_charts("dmotion", boards)
    assert sorted(charts) == ["dmotion-control.svg", "dmotion-rollout.svg"]
    drawn = {name: ElementTree.fromstring(text) for name, text in charts.items()}

    rollout = _series(drawn["dmotion-rollout.svg"])
    names = ["grid_world-tiny (warp true), one-shot", "other|data, one-shot"]  # five demonstrations hide nothing new
    assert sorted(rollout) == names
    steps, heights = zip(*_places(drawn["dmotion-rollout.svg"], names[0]), strict=True)
    assert (steps[2] - steps[1]) == pytest.approx(2 * (steps[1] - steps[0]), abs=0.2)
    assert heights[1] < heights[0]  # 20 / 200 is above 5 / 100, and up is less
    assert heights[2] < heights[1]

    controlled = _series(drawn["dmotion-control.svg"])
    name = "grid_world-tiny, one-shot, tuned here: not known"
    assert sorted(controlled) == [name, "idle", "true simulator as the model"]
    start, middle, end = (height for _, height in _places(drawn["dmotion-control.svg"], name))
    assert (middle - start) == pytest.approx((end - start) / 5, abs=0.2)  # 1, 0.9, 0.5


def test_of_one_and_of_all_labels_on_a_data_set_the_line_of_all_is_dashed(result: Callable[..., Entry]) -> None:
    every = {"asked": "100%", "given": {}, "total": 64}
    second = result("ed-cnn-s0", (4.0, 8.0, 16.0)).content["dataset"] | {"fingerprint": "f" * 64, "name": "other"}
    entries = [
        result("dmotion-s0", (10.0, 40.0, 100.0)),
        result("dmotion-100pct-s0", (9.0, 30.0, 90.0), labels=every),
        result("dmotion-other-100pct-s0", (9.0, 30.0, 90.0), labels=every, dataset=second),
    ]
    picture = ElementTree.fromstring(model_charts("dmotion", make_boards(entries))["dmotion-rollout.svg"])
    looks = {
        name: [path.attrib["class"] for path in group.iter(f"{SVG}path") if "line" in path.attrib["class"]]
        for name, group in _series(picture).items()
    }
    assert looks == {
        "grid_world-tiny, one-shot": ["line solid"],
        "grid_world-tiny, labels 100%": ["line dashed"],
        "other, labels 100%": ["line solid"],
    }


def _series(picture: ElementTree.Element) -> dict[str, ElementTree.Element]:
    groups = [group for group in picture.iter(f"{SVG}g") if group.find(f"{SVG}title") is not None]
    return {str(group.findtext(f"{SVG}title")): group for group in groups}


def _places(picture: ElementTree.Element, name: str) -> list[tuple[float, float]]:
    lines = [path.attrib["d"] for path in _series(picture)[name].iter(f"{SVG}path") if "line" in path.attrib["class"]]
    (line,) = lines
    return [(float(x), float(y)) for x, y in (place.split(" ") for place in line.removeprefix("M").split("L"))]


def test_charts_are_named_pictures_that_load_nothing(boards: list[Board]) -> None:
    for name, text in model_charts("dmotion", boards).items():
        assert f"curves/{name})" in "\n".join(model_lines("dmotion", boards))
        assert "--c0:" in text
        assert "url(" not in text
        assert len(text) < 20_000
        picture = ElementTree.fromstring(text)
        assert float(picture.attrib["width"]) == WIDTH
        legend = picture.findall(f"{SVG}g")[-1]
        lines = [line for one in legend for line in one.iter(f"{SVG}text")]
        assert max(52 + 6 * len(str(line.text)) for line in lines) <= WIDTH  # none runs past the edge
        heights = [float(line.attrib["y"]) for line in lines]
        assert [*np.diff(heights)] == [18.0] * (len(lines) - 1)
        assert heights[-1] < float(picture.attrib["height"])
        assert picture.tag == f"{SVG}svg"
        assert {name.rpartition("}")[2] for one in picture.iter() for name in one.attrib} & {"href", "src"} == set()


def test_a_long_name_in_a_legend_has_several_lines(result: Callable[..., Entry]) -> None:
    run = "dmotion-grid_world-tiny-" + "-".join(f"number{place}_of_settings_1" for place in range(7)) + "-s0"
    charts = model_charts("dmotion", make_boards([result(run, (1.0, 2.0, 4.0))]))
    (legend,) = ElementTree.fromstring(charts["dmotion-rollout.svg"]).findall(f"{SVG}g")[-1]
    lines = [str(line.text) for line in legend.iter(f"{SVG}text")]
    assert len(lines) > 2
    assert all(f"number{place} of settings 1" in " ".join(lines) for place in range(7))


def test_a_page_gets_its_rows_and_its_charts(boards: list[Board], tmp_path: Path) -> None:
    for entry in [entry for board in boards for entry in board.measured]:
        write_entry(entry, tmp_path / "entries")
    page = tmp_path / "pages" / "dmotion.md"
    page.parent.mkdir()
    page.write_text("<!-- results:model:dmotion -->\n<!-- /results -->\n")
    charts = [page.parent / "curves" / name for name in ("dmotion-rollout.svg", "dmotion-control.svg")]

    assert write_results(tmp_path, [page], check=True) == [page, *charts]
    assert not charts[0].exists()
    assert write_results(tmp_path, [page]) == [page, *charts]
    assert {file.name: file.read_text() for file in charts} == model_charts("dmotion", boards)
    assert write_results(tmp_path, [page]) == []
    charts[1].write_text("another picture")
    assert write_results(tmp_path, [page], check=True) == [charts[1]]
    assert set(model_names()) >= {"dmotion", "cswm"}
