"""``import dmotion_bench``: what it offers, what it loads, and which environments Gymnasium knows afterwards."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

import dmotion_bench as dm
from dmotion_bench import gymnasium_ids
from recorders.gymnasium_ids import IDS

ROOT = Path(__file__).parents[2]
HEAVY = "torch pybullet pymunk mujoco pygame rerun pyarrow lightning_fabric scipy baselines leaderboard"
DONE = ("demo", "load_run", "open_dataset", "plan", "record", "score", "train", "view")
WITH_EXAMPLES = [
    *(name for name in dm.__all__ if inspect.isfunction(getattr(dm, name)) and name != "demo"),  # it takes a minute
    *("Dataset.triplets", "Run.predict", "Run.rollout", "Run.latent_action"),
]


def _in_a_new_process(code: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_loads_no_torch_no_simulator_and_no_model() -> None:
    told = _in_a_new_process(
        "import sys, dmotion_bench\n"
        "dmotion_bench.environment_names(), dmotion_bench.model_names(), dmotion_bench.Workspace\n"
        "print(*sys.modules)"
    )
    loaded = set(told.split())
    assert "gymnasium" in loaded
    assert not {name.partition(".")[0] for name in loaded} & set(HEAVY.split())
    assert {name for name in loaded if name.startswith("recorders")} == {"recorders", "recorders.gymnasium_ids"}


@pytest.mark.slow
def test_what_opens_and_scores_any_model_loads_no_compiler() -> None:
    told = _in_a_new_process(
        "import sys\n"
        "import dmotion_bench.api.scoring, dmotion_bench.api.viewing, dmotion_bench.api.training\n"
        "from dmotion_bench.learning.runs.manifest import RunSpec\n"
        "from dmotion_bench.learning.settings import to_json\n"
        "from dmotion_bench.registry import model_class, model_names\n"
        "facts = {'preset': 'tiny', 'labels': 'all', 'seed': 0, 'dataset': 'd', 'fingerprint': ''}\n"
        "size = {'height': 64, 'width': 64, 'actions': 4}\n"
        "for name in model_names():\n"
        "    config = to_json(model_class(name).configure('compact'))\n"
        "    spec = RunSpec(model=name, arch='compact', config=config, training={'epochs': 1}, **facts, **size)\n"
        "    assert spec.forms(1000)\n"
        "print(*{'torch._dynamo', 'scipy.stats', 'lightning_fabric', 'sympy'} & set(sys.modules))"
    )
    assert not told.strip()


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(IDS))
def test_gymnasium_makes_an_environment_after_the_import_alone(name: str) -> None:
    told = _in_a_new_process(
        "import gymnasium, dmotion_bench\n"
        f"env = gymnasium.make({name!r})\n"
        "frame, _ = env.reset(seed=0)\n"
        "frame, *_ = env.step(env.action_space.sample())\n"
        "print(frame.shape, frame.dtype)"
    )
    assert told.strip() == "(128, 128, 3) uint8"


def test_every_environment_of_the_benchmark_has_an_id() -> None:
    classes = {place.partition(":")[0] for place, _ in IDS.values()}
    assert classes == set(dm.environment_names()) - {"gym"}


def test_a_package_that_cannot_register_its_environments_is_named_and_the_import_goes_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    broken = EntryPoint(name="broken", value="no_such_package.ids:register", group=gymnasium_ids.GROUP)
    called: list[str] = []

    class Sound:
        value = "sound"

        def load(self) -> Any:
            return lambda: called.append("sound")

    monkeypatch.setattr(gymnasium_ids, "entry_points", lambda group: [broken, Sound()])
    with pytest.warns(RuntimeWarning, match=r"'no_such_package.ids:register' are not known to Gymnasium"):
        gymnasium_ids.register_ids()
    assert called == ["sound"]


def test_every_name_that_is_offered_is_there() -> None:
    assert set(DONE) <= set(dm.__all__) <= set(dir(dm))
    for name in dm.__all__:
        assert getattr(dm, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'trian'"):
        dm.trian  # type: ignore[attr-defined]  # noqa: B018


def test_what_a_function_returns_can_be_named_in_annotations() -> None:
    functions = [getattr(dm, name) for name in dm.__all__ if inspect.isfunction(getattr(dm, name))]
    functions += [dm.Dataset.triplets, dm.Dataset.episode, dm.Dataset.labels]
    returned = {
        word for one in functions for word in re.findall(r"[A-Z]\w+", str(inspect.signature(one).return_annotation))
    }
    assert {"Run", "Difference", "EpisodeLabels"} <= returned
    assert returned - {"Path", "None"} <= set(dm.__all__)


def test_every_name_that_is_offered_is_in_the_reference() -> None:
    pages = "".join(page.read_text() for page in (ROOT / "docs" / "api").glob("*.md"))
    named = set(re.findall(r"^::: dmotion_bench\.[\w.]*\.(\w+)$", pages, re.MULTILINE))
    assert set(dm.__all__) - {"DmbenchError", "__version__"} <= named  # errors stand on a page of their own


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_every_function_has_an_example(name: str) -> None:
    what: Any = dm
    for part in name.split("."):
        what = getattr(what, part)
    text = inspect.getdoc(what) or ""
    assert "Example:" in text
    assert ">>> " in text


@pytest.mark.parametrize("package", ["dmotion_bench", "recorders", "baselines", "leaderboard"])
def test_packages_say_that_they_are_typed(package: str) -> None:
    assert (ROOT / package / "py.typed").is_file()
