"""Actions of LeRobot data sets that other programs wrote: what their features say, and what cannot be one."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from storage.continuous_recordings import AWKWARD, bits, imported, refused, twists

from dmotion_bench.storage.exports.lerobot import export_lerobot
from dmotion_bench.storage.imports.options import ImportOptions


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Read only; ``lerobot`` changes a copy."""
    root = tmp_path_factory.mktemp("exported")
    export_lerobot(imported(twists(root / "bag", AWKWARD), root / "source"), root / "lerobot")
    return root / "lerobot"


def lerobot(exported: Path, tmp_path: Path, actions: Any, feature: dict[str, Any]) -> Path:
    """An export whose actions are replaced, as another program would have written them."""
    folder = shutil.copytree(exported, tmp_path / "lerobot")
    file = folder / "data/chunk-000/file-000.parquet"
    table = parquet.read_table(file)
    parquet.write_table(table.set_column(table.column_names.index("action"), "action", actions), file)
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"]["action"] = feature
    (folder / "meta/info.json").write_text(json.dumps(info))
    return folder


LEROBOT = ImportOptions(size=32, actions="action")
ROWS = [[n / 3, n] for n in range(7)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stated", "names"),
    [
        (["a", "b"], ("a", "b")),
        ({"motors": ["a", "b"]}, ("a", "b")),
        ({"b": 1, "a": 0}, ("a", "b")),
        ([["a", "b"]], ("a", "b")),
        ({"left": ["a"], "right": ["b"]}, ("a", "b")),
        ({"left": ["arm"], "right": ["arm"]}, ("left.arm", "right.arm")),
        ({"motors": ["arm", "arm"]}, ("arm.0", "arm.1")),
        ({"motors": [{"name": "a"}, "b"]}, ("action.0", "action.1")),
        (None, ("action.0", "action.1")),
        (["only"], ("action.0", "action.1")),
    ],
)
def test_lerobot_s_own_actions(exported: Path, tmp_path: Path, stated: Any, names: tuple[str, ...]) -> None:
    column = pa.array(ROWS, pa.list_(pa.float32()))
    folder = lerobot(exported, tmp_path, column, {"dtype": "float32", "shape": [2], "names": stated})
    dataset = imported(folder, tmp_path / "out", LEROBOT)
    assert dataset.spec.actions is not None
    assert dataset.spec.actions.names == names
    assert bits(dataset.states(0).actions) == bits(np.float32(ROWS[:6]))
    part = imported(folder, tmp_path / "part", dataclasses.replace(LEROBOT, action_fields=(names[1],)))
    np.testing.assert_array_equal(part.states(0).actions[:, 0], range(6))
    unknown = dataclasses.replace(LEROBOT, action_fields=("velocity",))
    refused(folder, "has no field 'velocity' in its actions; its fields are: .* [(]feature 'action'", unknown)
    feature = dataclasses.replace(LEROBOT, actions="actions")
    refused(folder, "has no feature 'actions' for '--actions'; did you mean 'action'. Its features are: act", feature)
    camera = dataclasses.replace(LEROBOT, camera="camrea")
    refused(folder, "has no camera 'camrea'; did you mean 'observation.images.camera'. Its cameras are: ", camera)


FLOATS: dict[str, Any] = {"dtype": "float32", "shape": [2], "names": ["a", "b"]}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rows", "feature", "match"),
    [
        (
            [*ROWS[:3], [0.0, np.nan], *ROWS[4:]],
            FLOATS,
            "holds 'b' = nan in command 3; a command must be finite; .* choose other numbers with '--action-fields'",
        ),
        ([*ROWS[:3], [np.inf, 0.0], *ROWS[4:]], FLOATS, "holds 'a' = inf in command 3"),
        ([*ROWS[:3], [1.0], *ROWS[4:]], FLOATS, "different numbers of components"),
        ([*ROWS[:3], [None, 1.0], *ROWS[4:]], FLOATS, "lacks numbers of its actions"),
        ([*ROWS[:3], None, *ROWS[4:]], FLOATS, "different numbers of components"),
        ([[0.0] * 300] * 7, FLOATS, "holds 300 numbers a command; there can be 1 to 256"),
        (ROWS, FLOATS | {"names": ["a\x1b[31m", "b"]}, "printable characters"),
        (ROWS, FLOATS | {"dmbench_actions": {"names": ["a"]}}, "dmbench_actions of the feature 'action' that cannot"),
        (
            ROWS,
            FLOATS | {"dmbench_actions": {"names": ["a", "b"], "low": [0, 0], "high": [1, 9], "units": ["", ""]}},
            "contradicts its own bounds: it holds 'a' = 1.33333 in action 4; it can be 0 to 1",
        ),
        (
            ROWS,
            FLOATS | {"dmbench_actions": {"names": ["a", "c"], "low": [0, 0], "high": [1, 9], "units": ["", ""]}},
            "states bounds of 'a', 'c', and its numbers are 'a', 'b'",
        ),
    ],
)
def test_lerobot_s_actions_that_cannot_be(
    exported: Path, tmp_path: Path, rows: Any, feature: dict[str, Any], match: str
) -> None:
    refused(lerobot(exported, tmp_path, pa.array(rows, pa.list_(pa.float32())), feature), match, LEROBOT)


@pytest.mark.slow
def test_words_are_no_numbers(exported: Path, tmp_path: Path) -> None:
    refused(
        lerobot(exported, tmp_path, pa.array(["x"] * 7), FLOATS), "holds string as actions, which is no number", LEROBOT
    )
