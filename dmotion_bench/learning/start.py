"""Turn a user's request into a run: fill in defaults, choose names, check values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dmotion_bench.actions import Continuous
from dmotion_bench.errors import UnknownName, UsageError
from dmotion_bench.learning.curriculum import TrainingData
from dmotion_bench.learning.labels import DEMONSTRATIONS, LabelBudget, LabelRequest
from dmotion_bench.learning.run import Run, RunSpec
from dmotion_bench.learning.run_manifest import stored_actions
from dmotion_bench.learning.settings import to_json, with_settings
from dmotion_bench.learning.triplets import SplitProtocol, TripletSet
from dmotion_bench.registry import model_class
from dmotion_bench.specs import IMPORTED, Preset, Supervision
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.split import FEWEST_EPISODES
from dmotion_bench.versions import versions
from dmotion_bench.workspace import Workspace

_MORE_EPISODES = {
    False: f"record at least {FEWEST_EPISODES}.",
    True: f"import at least {FEWEST_EPISODES}: cut the recordings shorter with '--frames-per-episode', or import more.",
}


@dataclass(frozen=True, kw_only=True)
class TrainingRequest:
    """What ``dmbench train`` was asked for; None stands for the default.

    Attributes:
        model: Registry name.
        labels: Label budget; one-shot for models that see video only, 64 transitions if the actions are continuous; no
            default for supervised ones.
        preset: The data set's own where its name ends with one, else small.
        arch: The model's first architecture.
        settings: ``KEY=VALUE`` of the model's or the training's config.
        threads: That each process computes with.
    """

    model: str
    labels: str | None = None
    preset: Preset | None = None
    arch: str | None = None
    seed: int = 0
    settings: Sequence[str] = ()
    protocol: SplitProtocol = "episode"
    threads: int | None = None


def resolve(request: TrainingRequest, dataset: Dataset) -> RunSpec:
    """Fill in every default and check every name.

    Raises:
        UnknownName: Of the model or its architecture.
        InvalidSetting: Of a setting or the label budget.
        UsageError: The budget is not one that the model can use.
    """
    kind = model_class(request.model)
    arch = request.arch or kind.architectures[0]
    if arch not in kind.architectures:
        raise UnknownName(f"architecture of {request.model}", arch, kind.architectures)
    labels = LabelRequest.for_model(request.model, kind.supervision, request.labels, dataset.spec.actions)
    if dataset.spec.actions is None:
        if kind.supervision is Supervision.ACTIONS:
            raise UsageError(f"{dataset.name!r} has no action labels; train a model that needs none, such as dmotion.")
        if request.labels is None:
            labels = LabelRequest("none")
    preset = request.preset or _preset_of(dataset.name)
    if given := next((setting for setting in request.settings if setting.startswith("arch=")), None):
        raise UsageError(
            f"'--set {given}': an architecture has defaults of its own; give '--{given.replace('=', ' ')}'."
        )
    config, training = with_settings(request.settings, kind.configure(arch), kind.training_defaults(preset, arch))
    return RunSpec(
        model=request.model,
        arch=arch,
        config=to_json(config),
        training=to_json(training),
        preset=preset.value,
        labels=str(labels),
        seed=request.seed,
        dataset=dataset.name,
        fingerprint=dataset.fingerprint,
        protocol=request.protocol,
        height=dataset.spec.height,
        width=dataset.spec.width,
        actions=stored_actions(dataset.spec.actions),
    )


def default_path(request: TrainingRequest, spec: RunSpec, workspace: Workspace) -> Path:
    """A folder's name that says what sets the run apart, such as ``dmotion-grid_world-small-s0``."""
    kind = model_class(spec.model)
    parts = [spec.model]
    if spec.arch != kind.architectures[0]:
        parts.append(spec.arch)
    parts.append(spec.dataset)
    if not spec.dataset.endswith(f"-{spec.preset}"):
        parts.append(spec.preset)
    if spec.labels not in (str(DEMONSTRATIONS) if isinstance(spec.action_spec, Continuous) else "one-shot", "100%"):
        parts.append(spec.labels.replace("%", "pct"))
    if spec.protocol != "episode":
        parts.append(f"split_{spec.protocol}")
    parts += [setting.replace("=", "_").replace("/", "_") for setting in request.settings]
    if request.threads is not None:
        parts.append(f"threads_{request.threads}")
    return workspace.runs / "-".join([*parts, f"s{spec.seed}"])


def open_run(request: TrainingRequest, dataset: Dataset, path: Path | None, workspace: Workspace) -> Run:
    """The run that this request names: a new one, or the one that stands where it would stand.

    Raises:
        RunMismatch: That folder holds a run of another request.
    """
    spec = resolve(request, dataset)
    folder = path or default_path(request, spec, workspace)
    return Run.create_or_open(folder, spec, dataset_path=dataset.path, versions=versions(), threads=request.threads)


def training_data(run: Run, dataset: Dataset) -> TrainingData:
    """The data of a run; only the label budget opens ``labels/``, and only for the labels that it hands out.

    Raises:
        UsageError: There are too few episodes to train and validate.
    """
    protocol: SplitProtocol = "paper" if run.spec.protocol == "paper" else "episode"
    train = TripletSet.of_split(dataset, "train", protocol)
    validation = TripletSet.of_split(dataset, "validation", protocol)
    if not len(train) or not len(validation):
        imported = dataset.recipe.environment == IMPORTED
        raise UsageError(
            f"{dataset.name!r} has {len(dataset)} episodes, too few to train and validate; {_MORE_EPISODES[imported]}"
        )
    budget = LabelBudget(dataset, LabelRequest.parse(run.spec.labels), run.spec.seed)
    return TrainingData(train=train, validation=validation, budget=budget)


def _preset_of(dataset: str) -> Preset:
    for preset in Preset:
        if dataset.endswith(f"-{preset.value}"):
            return preset
    return Preset.SMALL
