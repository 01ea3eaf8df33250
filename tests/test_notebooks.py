"""The notebooks of the documentation: they work from top to bottom, and what they hold is what their cells gave."""

from __future__ import annotations

import base64
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
MOST_BYTES = 100_000
"""Of the pictures of a notebook, all together."""

RUN = """
import json, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from notebook_run import run
print(json.dumps(run(Path(sys.argv[2]), Path.cwd(), json.loads(sys.argv[3]))))
"""

SHORTER = {
    "add_a_model_and_place_it": {"epochs=16,": "epochs=1,", '"epochs": 8,': '"epochs": 1,'},
    "look_at_data_and_model": {'"epochs": 16,': '"epochs": 1,'},
}
"""Trainings of an epoch: a notebook takes seconds instead of a minute and a half, and no figure is compared."""


def _code(content: dict[str, Any]) -> list[dict[str, Any]]:
    return [cell for cell in content["cells"] if cell["cell_type"] == "code"]


def _kinds(cell: dict[str, Any]) -> list[list[str]]:
    """What a cell gave, without the figures: the streams and the formats."""
    return [sorted(output.get("data", {})) or [output["name"]] for output in cell["outputs"]]


def test_there_are_notebooks() -> None:
    assert [path.stem for path in NOTEBOOKS] == ["add_a_model_and_place_it", "look_at_data_and_model"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_holds_what_each_cell_gave_in_order_and_no_error(path: Path) -> None:
    content = json.loads(path.read_text())
    cells = _code(content)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert {output["output_type"] for output in outputs} <= {"execute_result", "display_data", "stream"}
    assert not [output for output in outputs if output.get("name") == "stderr"]
    for cell in cells:
        if "".join(cell["source"]).rstrip().splitlines()[-1].startswith("print("):
            assert "".join(cell["outputs"][-1]["text"]).strip()
    pictures = [
        base64.b64decode(output["data"]["image/png"]) for output in outputs if "image/png" in output.get("data", {})
    ]
    assert all(picture.startswith(b"\x89PNG") for picture in pictures)
    assert sum(map(len, pictures)) < MOST_BYTES
    assert str(ROOT) not in path.read_text()
    assert "/tmp/" not in path.read_text()


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_works_from_top_to_bottom(path: Path, tmp_path: Path) -> None:
    words = [sys.executable, "-c", RUN, str(ROOT / "tests"), str(path), json.dumps(SHORTER[path.stem])]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    ran, held = json.loads(done.stdout), json.loads(path.read_text())
    assert [_kinds(cell) for cell in _code(ran)] == [_kinds(cell) for cell in _code(held)]
    assert list(tmp_path.iterdir()) == []  # all files went into a temporary folder
