"""A run notices that the code of its model was changed; comments, layout and the rest of a script do not count."""

from __future__ import annotations

import dataclasses
import importlib
import linecache
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import torch
from known_model import result_of, spec_with

from dmotion_bench import registry
from dmotion_bench.errors import RunCorrupt
from dmotion_bench.learning.model import TrainingConfig
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.run import Conditions, Run
from dmotion_bench.learning.runs.source import changed_modules, code_of
from dmotion_bench.learning.settings import to_json
from dmotion_bench.learning.training.beginning import finished_result
from dmotion_bench.registry import model_class, register_model
from dmotion_bench.versions import versions

MODEL = '''"""A model."""
from baselines.lapo import Lapo
from edited_models import parts
from .parts import WIDTH


class Edited(Lapo):
    width = WIDTH + parts.WIDTH
'''


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of an imported package with the model 'edited'."""
    folder = tmp_path / "edited_models"
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "parts.py").write_text("WIDTH = 3\n")
    (folder / "unused.py").write_text("DEPTH = 3\n")
    (folder / "model.py").write_text(MODEL)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    monkeypatch.setattr("dmotion_bench.entry_points._ADDED", {})
    register_model("edited", importlib.import_module("edited_models.model").Edited)
    yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == "edited_models"]:
        del sys.modules[name]


def test_it_is_of_the_model_its_bases_and_what_they_import(package: Path) -> None:
    names = list(code_of("edited"))
    assert {"edited_models", "edited_models.model", "edited_models.parts", "baselines.lapo", "baselines.layers"} < {
        *names
    }
    assert names == sorted(names)
    assert not [name for name in names if name.startswith(("dmotion_bench", "torch")) or name.endswith("unused")]
    assert code_of("nobodys-model") == {}


@pytest.mark.parametrize(
    ("file", "before", "after", "changed"),
    [
        ("model.py", "WIDTH + ", "WIDTH * ", ["edited_models.model"]),
        ("model.py", "WIDTH + ", "2 + WIDTH + ", ["edited_models.model"]),
        ("parts.py", "3", "4", ["edited_models.parts"]),
        ("parts.py", "WIDTH = 3", "WIDTH = '3'", ["edited_models.parts"]),
        ("parts.py", "3", "+".join("3" * 20_000), []),  # too deep to be read
        ("model.py", "A model.", "Another model.", []),
        ("model.py", "    width", "    # half of it\n\n    width", []),
        ("unused.py", "3", "4", []),
        ("model.py", "class", "class class", []),  # being edited: nothing can be said of it
    ],
)
def test_what_counts_as_a_change(package: Path, file: str, before: str, after: str, changed: list[str]) -> None:
    recorded = code_of("edited")
    text = (package / file).read_text()
    assert before in text
    (package / file).write_text(text.replace(before, after, 1))
    assert changed_modules(recorded, "edited") == changed


@pytest.mark.parametrize(("folder", "changed"), [("mine", ["layers_beside"]), ("site-packages", [])])
def test_files_beside_a_models_own_count_unless_they_are_installed_packages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: str, changed: list[str]
) -> None:
    (place := tmp_path / folder).mkdir()
    (place / "layers_beside.py").write_text("WIDTH = 3\n")
    (place / "model_beside.py").write_text(
        "from baselines.lapo import Lapo\nfrom layers_beside import WIDTH\nclass Mine(Lapo): width = WIDTH\n"
    )
    monkeypatch.syspath_prepend(place)
    monkeypatch.setattr("dmotion_bench.entry_points._ADDED", {})
    for name in ("layers_beside", "model_beside"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    register_model("edited", importlib.import_module("model_beside").Mine)
    recorded = code_of("edited")
    (place / "layers_beside.py").write_text("WIDTH = 4\n")
    assert changed_modules(recorded, "edited") == changed


def test_of_a_script_its_classes_and_functions_count(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "script.py"
    script.write_text("EPOCHS = 3\nclass Mine:\n    width = 3\n")
    monkeypatch.setattr(sys.modules["__main__"], "__file__", str(script), raising=False)
    kind = type("Mine", (registry.model_class("edited"),), {"__module__": "__main__"})
    register_model("mine", kind)
    recorded = code_of("mine")
    script.write_text("EPOCHS = 4\nclass Mine:\n    width = 3\n")
    assert changed_modules(recorded, "mine") == []
    script.write_text("EPOCHS = 4\nclass Mine:\n    width = 4\n")
    assert changed_modules(recorded, "mine") == ["__main__"]


NOTEBOOK = """
from dataclasses import dataclass

from baselines.lapo import Lapo

SCALE = 2


def distance(x):
    return x * 2


class Mine(Lapo):
    'A model of a notebook.'
    width = [3, 4]

    @dataclass(frozen=True, kw_only=True)
    class Extra:
        depth: int = 3

    def losses(self, batch):
        # the distance alone
        total = super().losses(batch)
        return [distance(one) for one in (total,) if one in {"a", "b"}]
"""


def _defined(text: str, *, known: bool) -> dict[str, str]:
    """The hashes of the model of a notebook; its source is known as in IPython, or not."""
    file = f"<cell {hash(text)}>"
    linecache.cache.pop(file, None)  # of another test of this process
    if known:
        linecache.cache[file] = (len(text), None, text.splitlines(keepends=True), file)
    sys.modules["a_notebook"] = notebook = ModuleType("a_notebook")
    try:
        exec(compile(text, file, "exec", dont_inherit=True), vars(notebook))
        register_model("mine", notebook.Mine)
        return code_of("mine")
    finally:
        del sys.modules["a_notebook"]


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(
    ("before", "after", "counts"),
    [
        ("super().losses(batch)", "super().losses(batch.clone())", True),
        ('"a", "b"', '"a", "c"', True),
        ("x * 2", "x * 3", True),
        ("[3, 4]", "[3, 5]", True),
        ("depth: int = 3", "depth: int = 4", True),
        ("(self, batch)", "(self, batch, more=1)", True),
        ("class Mine(Lapo)", "class Mine(Lapo, object)", False),
        ("A model", "Another model", False),
        ("# the distance", "# not the distance", False),
        ("SCALE = 2", "SCALE = 3\n\n\n", False),
    ],
)
def test_of_a_notebook_the_class_counts(package: Path, known: bool, before: str, after: str, counts: bool) -> None:
    recorded = _defined(NOTEBOOK, known=known)
    assert "baselines.lapo" in recorded
    assert _defined(NOTEBOOK, known=known) == recorded
    assert before in NOTEBOOK
    now = _defined(NOTEBOOK.replace(before, after, 1), known=known)
    assert [name for name, told in now.items() if recorded[name] != told] == (
        ["classes of a_notebook"] if counts else []
    )


def test_another_class_under_the_same_name_counts(package: Path) -> None:
    recorded = _defined(NOTEBOOK, known=True)
    _defined(NOTEBOOK.replace("Mine", "Other").replace("x * 2", "x * 3") + "\nMine = Other\n", known=True)
    assert changed_modules(recorded, "mine") == ["classes of a_notebook"]


def test_what_a_class_holds_of_the_function_around_it_counts(package: Path) -> None:
    text = """
from baselines.lapo import Lapo
def made(weight):
    class Mine(Lapo):
        def losses(self, batch):
            return super().losses(batch) * weight
    return Mine
Mine = made(1)
"""
    recorded = _defined(text, known=False)
    _defined(text.replace("made(1)", "made(2)"), known=False)
    assert changed_modules(recorded, "mine") == ["classes of a_notebook"]


@pytest.mark.slow
def test_the_hash_of_a_notebook_s_class_is_the_same_in_every_process(package: Path) -> None:
    script = f"text = {NOTEBOOK!r}\nexec(text)\nfrom dmotion_bench.learning.runs.source import code_of\n"
    script += (
        "import dmotion_bench as dm\ndm.register_model('mine', Mine)\nprint(code_of('mine')['classes of __main__'])"
    )
    told = {
        subprocess.run(
            [sys.executable, "-c", script],
            env={**os.environ, "PYTHONHASHSEED": seed},
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert len(told) == 1


def _trained(package: Path, folder: Path) -> Run:
    """A finished run of the model 'edited', begun by the code as it is."""
    config, training = to_json(model_class("lapo").Config()), to_json(TrainingConfig(epochs=1))
    spec = spec_with(model="edited", config=config, training=training, labels="none")
    run = Run.create_or_open(folder, spec, dataset_path="data/grid", versions={"torch": "1.0"})
    folder.mkdir(parents=True)
    run.metrics.touch()
    weights = {"a": torch.ones(3)}
    for file in (run.best, run.last):
        checkpoint.save(file, checkpoint.with_prefix("model", weights), {})
    run.finish(result_of(weights))
    return Run.open(folder)


def _told(run: Run) -> str:
    """What is said of a run before it is trained."""
    said: list[str] = []
    finished_result(run, said.append, said.append)
    return " ".join(said)


def test_training_it_again_says_so(package: Path, tmp_path: Path) -> None:
    run = _trained(package, tmp_path / "runs" / "one")
    assert _told(run) == f"{run.path} is already trained; here is its result."
    (package / "parts.py").write_text("WIDTH = 5\n")
    assert "was changed since that training began (edited_models.parts); to train the model as it is" in _told(run)
    assert f"delete {str(run.path)!r} first" in _told(run)


def test_weights_that_do_not_fit_the_changed_code_are_not_called_damaged(package: Path, tmp_path: Path) -> None:
    run = _trained(package, tmp_path / "runs" / "one")
    (package / "parts.py").write_text("WIDTH = 5\n")
    said = (
        r"^the weights of 'one' do not fit its model 'edited', whose code was changed .*\(edited_models.parts\); undo"
    )
    with pytest.raises(RunCorrupt, match=said):
        _ = run.model
    run.best.write_bytes(run.best.read_bytes()[:-1])
    with pytest.raises(RunCorrupt, match=r"Delete the .safetensors files of that folder"):
        _ = run.model


def test_an_attempt_that_failed_before_its_first_checkpoint_is_no_training(package: Path, tmp_path: Path) -> None:
    run = _trained(package, tmp_path / "runs" / "one")
    run.manifest["result"] = None
    run.write()
    run.last.unlink()
    (package / "parts.py").write_text("WIDTH = 5\n")  # its author mends it
    assert run.changed_modules
    assert _told(run) == ""
    assert not Run.open(run.path).changed_modules


def test_a_training_that_goes_on_with_another_version_says_so_and_states_both(package: Path, tmp_path: Path) -> None:
    run = _trained(package, tmp_path / "runs" / "one")
    run.manifest["result"] = None
    run.write()
    both = f"1.0, {versions()['torch']}"
    assert f"goes on with another version than it began with (torch {both})" in _told(run)
    assert f"delete {str(run.path)!r} first" in _told(run)
    run.begin(Conditions(threads=1, precision="float32"))
    again = Run.open(run.path)
    assert again.manifest["versions"] == versions() | {"torch": both}
    assert _told(again) == f"going on with {run.path}."


def test_a_class_that_a_notebook_defines_again_is_told(package: Path, tmp_path: Path) -> None:
    _defined(NOTEBOOK, known=True)
    register_model("edited", model_class("mine"))
    run = _trained(package, tmp_path / "runs" / "one")
    assert _told(run) == f"{run.path} is already trained; here is its result."
    _defined(NOTEBOOK.replace("x * 2", "x * 3"), known=True)
    register_model("edited", model_class("mine"))
    assert "was changed since that training began (classes of a_notebook); to train the model as it is" in _told(run)


def test_so_does_a_budget_that_takes_the_training_over(package: Path, tmp_path: Path) -> None:
    run = _trained(package, tmp_path / "runs" / "one")
    (package / "parts.py").write_text("WIDTH = 5\n")
    spec = dataclasses.replace(run.spec, labels="one-shot")
    other = Run.create_or_open(run.path.with_name("two"), spec, dataset_path="data/grid", versions={})
    told = _told(other)
    assert (
        "which differs only in its labels and what it does with them. the code of the model 'edited' was changed"
        in told
    )
    assert f"delete {str(run.path)!r} first" in told
    assert Run.open(other.path).changed_modules == ["edited_models.parts"]  # it is what the other one was trained with
    assert Run.open(other.path).manifest["versions"] == {"torch": "1.0"}


def test_damaged_weights_are_trained_anew_by_the_code_as_it_is(package: Path, tmp_path: Path) -> None:
    run = _trained(package, tmp_path / "runs" / "one")
    (package / "parts.py").write_text("WIDTH = 5\n")
    run.best.unlink()
    (run.path / "samples").mkdir()
    (run.path / "samples" / "00000008.png").touch()
    assert run.manifest["versions"] == {"torch": "1.0"}
    assert "training" in _told(run)
    assert run.changed_modules == []
    assert Run.open(run.path).manifest["versions"] == versions()
    assert not list((run.path / "samples").iterdir())


def test_a_run_of_before_says_nothing(package: Path, tmp_path: Path) -> None:
    run = _trained(package, tmp_path / "runs" / "one")
    (package / "parts.py").write_text("WIDTH = 5\n")
    del run.manifest["code"]
    run.write()
    assert _told(Run.open(run.path)) == f"{run.path} is already trained; here is its result."


@pytest.mark.parametrize("code", [{"a": 3}, {"a": "0"}, {"a" * 100_000: "0" * 64}, [], "a"])
def test_what_is_no_hash_of_code_is_refused(package: Path, tmp_path: Path, code: object) -> None:
    run = _trained(package, tmp_path / "runs" / "one")
    run.manifest["code"] = code
    run.write()
    with pytest.raises(RunCorrupt, match=r"run\.json' cannot be read"):
        Run.open(run.path)
