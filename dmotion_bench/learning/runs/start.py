"""Turn a user's request into a run: fill in defaults, choose names, check values."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dmotion_bench.actions import ActionSpec, Continuous
from dmotion_bench.errors import InvalidSetting, LabelsNotAvailable, UnknownName, UsageError
from dmotion_bench.learning.data.curriculum import TrainingData, held_for_validation, labels_given
from dmotion_bench.learning.data.label_request import LabelRequest
from dmotion_bench.learning.data.labels import NOTHING_TO_DEMONSTRATE, LabelBudget
from dmotion_bench.learning.data.streamed import LOADERS, WINDOW, StreamedTriplets
from dmotion_bench.learning.data.triplets import SplitProtocol, TripletSet
from dmotion_bench.learning.model import TrainingConfig
from dmotion_bench.learning.runs.manifest import stored_actions
from dmotion_bench.learning.runs.run import Run, RunSpec
from dmotion_bench.learning.settings import to_json, with_settings
from dmotion_bench.registry import model_class
from dmotion_bench.specs import IMPORTED, Preset, Supervision
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.split import FEWEST_EPISODES
from dmotion_bench.versions import versions
from dmotion_bench.wording import counted
from dmotion_bench.workspace import RUN_MANIFEST, Workspace

_log = logging.getLogger(__name__)
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
        preset: What the name of a recorded data set ends with, else small.
        arch: The model's first architecture.
        settings: ``KEY=VALUE`` of the model's or the training's config.
        threads: That each process computes with.
        stream: Whether to read the compressed files instead of the frame cache; None takes what the run does, or in a
            new one the cache where it fits on the disk.
    """

    model: str
    labels: str | None = None
    preset: Preset | None = None
    arch: str | None = None
    seed: int = 0
    settings: Sequence[str] = ()
    protocol: SplitProtocol = "episode"
    threads: int | None = None
    stream: bool | None = None


def resolve(request: TrainingRequest, dataset: Dataset) -> RunSpec:
    """Fill in every default and check every name.

    Raises:
        UnknownName: Of the model or its architecture.
        InvalidSetting: Of a setting or the label budget.
        UsageError: The budget is not one that the model can use.
        LabelsNotAvailable: The budget asks for labels, and the actions of the data set are not known.
    """
    kind = model_class(request.model)
    arch = kind.architectures[0] if request.arch is None else request.arch
    if arch not in kind.architectures:
        raise UnknownName(f"architecture of {request.model}", arch, kind.architectures)
    labels = _labels(request, kind.supervision, dataset)
    preset = request.preset or _preset_of(dataset)
    if given := next((setting for setting in request.settings if setting.startswith("arch=")), None):
        raise UsageError(
            f"'--set {given}': an architecture has defaults of its own; give '--{given.replace('=', ' ')}'."
        )
    config, training = with_settings(request.settings, kind.configure(arch), kind.training_defaults(preset, arch))
    training = _streaming(request, training)
    _require_adaptable(request.model, kind.supervision, labels, dataset.spec.actions, training)
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


def _labels(request: TrainingRequest, supervision: Supervision, dataset: Dataset) -> LabelRequest:
    """The label budget of a request; a number that is larger than the data set is all labels.

    Raises:
        InvalidSetting: It is none.
        UsageError: It is not one that the model can use.
        LabelsNotAvailable: It asks for labels of unknown actions.
    """
    actions = dataset.spec.actions
    labels = LabelRequest.for_model(request.model, supervision, request.labels, actions)
    if actions is None:
        if supervision is not Supervision.NONE:
            raise UsageError(f"{dataset.name!r} has no action labels; train a model that needs none, such as dmotion.")
        if request.labels is None:
            return LabelRequest("none")
        if labels.kind != "none":
            raise LabelsNotAvailable(NOTHING_TO_DEMONSTRATE)
    return labels.of(_transitions(dataset))


def require_enough(request: TrainingRequest, dataset: Dataset) -> None:
    """Refuse a budget that somebody names and that is larger than the data set; one of a table is then all labels.

    Raises:
        UsageError: It is.
        InvalidSetting: It is no budget.
    """
    if request.labels is not None:
        LabelRequest.parse(request.labels).require_of(_transitions(dataset))


def _transitions(dataset: Dataset) -> int:
    return int((dataset.lengths - 1).sum())


def _require_adaptable(
    model: str,
    supervision: Supervision,
    labels: LabelRequest,
    actions: ActionSpec | None,
    training: TrainingConfig,
) -> None:
    """Refuse an adaptation that would have nothing to do.

    Raises:
        UsageError: The model is trained with actions anyway, or no action is demonstrated; or latent actions are to be
            clustered, and actions have no names.
    """
    asked = f"'--set adaptation={training.adaptation}'"
    if training.adaptation == "averaged":
        return
    if supervision is Supervision.ACTIONS:
        raise UsageError(f"{model} learns from actions all along, so there is nothing to adapt; leave out {asked}.")
    if labels.kind == "none":
        raise UsageError(
            f"{asked} teaches {model} by demonstrations, and '--labels none' gives none; name another budget, such as "
            "--labels 64."
        )
    if training.adaptation == "clustered" and isinstance(actions, Continuous):
        raise UsageError(f"{asked} is for named actions, and those of this data set are numbers; leave it out.")


def default_path(request: TrainingRequest, spec: RunSpec, workspace: Workspace) -> Path:
    """A folder's name that says what sets the run apart, such as ``dmotion-grid_world-small-s0``.

    A setting that is what the model takes anyway sets nothing apart; a run that it named before stays where it is.
    """
    named, before = (
        workspace.runs / _name(request, spec, settings)
        for settings in (_unusual_settings(request, spec), request.settings)
    )
    return before if (before / RUN_MANIFEST).exists() else named


def _name(request: TrainingRequest, spec: RunSpec, settings: Sequence[str]) -> str:
    kind = model_class(spec.model)
    parts = [spec.model]
    if spec.arch != kind.architectures[0]:
        parts.append(spec.arch)
    parts.append(spec.dataset)
    if not spec.dataset.endswith(f"-{spec.preset}"):
        parts.append(spec.preset)
    if spec.labels != _usual_labels(spec.model, kind.supervision, spec.action_spec):
        parts.append(spec.labels.replace("%", "pct"))
    if spec.protocol != "episode":
        parts.append(f"split_{spec.protocol}")
    parts += [setting.replace("=", "_").replace("/", "_") for setting in settings]
    if request.threads is not None:
        parts.append(f"threads_{request.threads}")
    if request.stream:
        parts.append("stream")
    return "-".join([*parts, f"s{spec.seed}"])


def _unusual_settings(request: TrainingRequest, spec: RunSpec) -> list[str]:
    """Those that change what the model or the training would take by default."""
    kind = model_class(spec.model)
    defaults = kind.training_defaults(Preset(spec.preset), spec.arch), kind.configure(spec.arch)
    usual = {name: value for config in defaults for name, value in to_json(config).items()}
    taken = {**spec.training, **spec.config}
    return [setting for setting in request.settings if taken[name := setting.partition("=")[0]] != usual[name]]


def _usual_labels(model: str, supervision: Supervision, actions: ActionSpec | None) -> str:
    """The budget that a folder's name does not mention."""
    if supervision is Supervision.ACTIONS:
        return "100%"
    return str(LabelRequest.for_model(model, supervision, None, actions))


def open_run(request: TrainingRequest, dataset: Dataset, path: Path | None, workspace: Workspace) -> Run:
    """The run that this request names: a new one, or the one that stands where it would stand.

    Raises:
        RunMismatch: That folder holds a run of another request.
    """
    spec = resolve(request, dataset)
    folder = path or default_path(request, spec, workspace)
    spec = _streamed_where_needed(request, spec, dataset, folder)
    return Run.create_or_open(
        folder,
        spec,
        dataset_path=dataset.where,
        versions=versions(),
        threads=request.threads,
        actions=dataset.spec.actions,
    )


def differences(request: TrainingRequest, dataset: Dataset, folder: Path) -> str:
    """In what the run of a folder differs from a request that would stand there; empty if in nothing.

    Raises:
        RunError: The folder holds none that can be read.
    """
    run = Run.open(folder)
    spec = _streamed_where_needed(request, resolve(request, dataset), dataset, folder)
    try:
        return "; ".join(run.differences(spec, request.threads))
    except InvalidSetting as error:  # of an earlier or a later version
        return str(error).rstrip(".")


def _streaming(request: TrainingRequest, training: TrainingConfig) -> TrainingConfig:
    """The training's settings with what ``--stream`` says.

    Raises:
        UsageError: The settings say something else, or the split cannot be streamed.
    """
    if request.stream is False and training.window:
        raise UsageError(
            f"'--set window={training.window}' is for data that are streamed; leave it out, or '--no-stream'."
        )
    if request.stream and not training.window:
        training = dataclasses.replace(training, window=WINDOW)
    if training.window and request.protocol == "paper":
        raise UsageError(
            "'--split paper' shuffles all triplets of the data set and cannot be streamed; leave out '--stream' or "
            "'--split paper'."
        )
    return training


def _streamed_where_needed(request: TrainingRequest, spec: RunSpec, dataset: Dataset, folder: Path) -> RunSpec:
    """The request as it stands if something was asked for, as the run does it, or streamed if no cache fits."""
    window = spec.training_config.window
    if request.stream is not None or window:
        return spec
    if (folder / RUN_MANIFEST).exists():
        window = Run.open(folder).spec.training_config.window
    elif request.protocol == "episode" and (lacking := dataset.cache_file.lacking()):
        window = WINDOW
        _log.warning(
            "%s; the training reads the compressed files instead and shuffles %s triplets at a time ('--stream').",
            *(lacking, f"{WINDOW:,}"),
        )
    return dataclasses.replace(spec, training={**spec.training, "window": window})


def training_data(run: Run, dataset: Dataset, loaders: int | None = None) -> TrainingData:
    """The data of a run; only the label budget opens ``labels/``, and only for the labels that it hands out.

    Args:
        run: What is asked for.
        dataset: Where the data are.
        loaders: Threads that read, where the frames are streamed; None for the usual number.

    Raises:
        UsageError: There are too few episodes to train and validate, or ``loaders`` are given and nothing is streamed.
    """
    protocol: SplitProtocol = "paper" if run.spec.protocol == "paper" else "episode"
    train: TripletSet | StreamedTriplets
    validation: TripletSet | StreamedTriplets
    window = run.spec.training_config.window
    if loaders is not None and not window:
        raise UsageError(
            f"'--loaders {loaders}' is for a training that reads the compressed files; add '--stream', or leave it out."
        )
    if window:
        train, validation = (
            StreamedTriplets.of_split(dataset, name, window=window, loaders=loaders or LOADERS)
            for name in ("train", "validation")
        )
    else:
        train = TripletSet.of_split(dataset, "train", protocol)
        validation = TripletSet.of_split(dataset, "validation", protocol)
    if not len(train) or not len(validation):
        imported, count = dataset.recipe.environment == IMPORTED, len(dataset)
        if count >= FEWEST_EPISODES:
            part = "validation" if len(train) else "training"
            raise UsageError(
                f"{dataset.name!r} has {count} episodes, and none of those for {part} has the three frames that a "
                "model learns from; record longer ones."
            )
        raise UsageError(
            f"{dataset.name!r} has {counted(count, 'episode')}, too few to train and validate; "
            f"{_MORE_EPISODES[imported]}"
        )
    budget = LabelBudget(dataset, LabelRequest.parse(run.spec.labels), run.spec.seed)
    return TrainingData(train=train, validation=validation, budget=budget)


def require_labels(run: Run, dataset: Dataset, loaders: int | None = None) -> None:
    """Refuse a run whose labels are not there, before anything of it is made; for the arguments see ``training_data``.

    Raises:
        LabelsNotAvailable: They are not there.
        UsageError: As for ``training_data``.
    """
    data = training_data(run, dataset, loaders)
    labels_given(data.train, data.validation, data.budget, model_class(run.spec.model).supervision)


def prepare_frames(run: Run, dataset: Dataset) -> None:
    """Decode what trainings read from a cache, before several processes look for it."""
    if run.spec.training_config.window:
        held_for_validation(training_data(run, dataset))
    else:
        dataset.cache()


def _preset_of(dataset: Dataset) -> Preset:
    """What the name of a recorded data set ends with; the name of an import says nothing of its size."""
    for preset in Preset:
        if dataset.recipe.environment != IMPORTED and dataset.name.endswith(f"-{preset.value}"):
            return preset
    return Preset.SMALL
