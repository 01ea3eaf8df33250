"""A training run on disk: what was asked for, how far it came, and the model that came of it.

::

    runs/dmotion-grid_world-small-s0/
      run.json            what decides the result (RunSpec), the versions, and the result once there is one
      metrics.jsonl       a row every few steps: losses, learning rate, triplets/s; a row a validation
      last.safetensors    all that resuming needs
      best.safetensors    the weights that validated best, with the actions aligned once training is done
      watched.safetensors where the phases that need no labels ended, if others came after them
      samples/            pictures of what the model predicted at each validation
      report/             written by ``dmbench score``
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dmotion_bench.errors import InvalidSetting, LabelsNotAvailable, RunCorrupt, RunMismatch, RunMissing
from dmotion_bench.learning import checkpoint
from dmotion_bench.learning.model import ForwardModel, ModelInputs, TrainingConfig
from dmotion_bench.learning.settings import from_json, to_json
from dmotion_bench.registry import model_class
from dmotion_bench.storage.atomic import write_atomically
from dmotion_bench.workspace import DATASET_MANIFEST, RUN_MANIFEST, AnyPath

RUN_FORMAT = "dmbench-run/1"


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunSpec:
    """All that decides the result of a training.

    Attributes:
        model, arch: Registry name and architecture.
        config, training: The configs, as JSON's types.
        preset: Where the defaults came from.
        labels: The label budget, as ``LabelRequest`` prints it.
        seed: Of the weights, the order of the batches and the draw of demonstrations.
        dataset: Its name.
        fingerprint: The hash of its content.
        protocol: How triplets are split.
        height, width, actions: What the model was built for.
    """

    model: str
    arch: str
    config: Mapping[str, Any]
    training: Mapping[str, Any]
    preset: str
    labels: str
    seed: int
    dataset: str
    fingerprint: str
    protocol: str = "episode"
    height: int
    width: int
    actions: int

    @property
    def inputs(self) -> ModelInputs:
        """The facts that the model is built for."""
        return ModelInputs(height=self.height, width=self.width, actions=self.actions)

    @property
    def training_config(self) -> TrainingConfig:
        """How the model is optimised."""
        return from_json(TrainingConfig, self.training)

    def completed(self) -> RunSpec:
        """The same, settings that later versions added at their defaults: what specs are compared by.

        Raises:
            InvalidSetting: It has settings that this version does not know.
        """
        config: Any = from_json(model_class(self.model).Config, self.config)
        return dataclasses.replace(self, config=to_json(config), training=to_json(self.training_config))

    def build(self) -> ForwardModel[Any]:
        """The model with weights that the seed decides, whatever random numbers were drawn before."""
        kind = model_class(self.model)
        with torch.random.fork_rng():
            torch.manual_seed(self.seed)
            model = kind(from_json(kind.Config, self.config), self.inputs)
        model.channels_last = self.training_config.channels_last
        return model


class Run:
    """One run's folder.

    Attributes:
        path: The folder.
        manifest: What ``run.json`` holds.
        spec: What was asked for.
    """

    def __init__(self, path: Path, manifest: dict[str, Any]) -> None:
        self.path, self.manifest = path, manifest
        self.spec = from_json(RunSpec, manifest["spec"])

    @classmethod
    def open(cls, path: AnyPath) -> Run:
        """A run that exists, finished or not.

        Raises:
            RunMissing: The folder holds no run.
            RunCorrupt: Its manifest cannot be read, or is of another version.
        """
        path = Path(path)
        try:
            manifest = json.loads((path / RUN_MANIFEST).read_text())
        except (FileNotFoundError, NotADirectoryError):
            raise RunMissing(f"no run in {str(path)!r}; list them with 'dmbench list runs'.") from None
        except (json.JSONDecodeError, UnicodeDecodeError) as error:
            raise RunCorrupt(f"{str(path / RUN_MANIFEST)!r} cannot be read: {error}.") from None
        found = manifest.get("format") if isinstance(manifest, dict) else None
        if found != RUN_FORMAT:
            raise RunCorrupt(f"{str(path)!r} is of the format {found!r}; this dmbench reads {RUN_FORMAT!r}.")
        for name, kind in (("spec", dict), ("result", dict | None), ("dataset_path", str)):
            if not isinstance(manifest.get(name, ...), kind):
                raise RunCorrupt(
                    f"{str(path / RUN_MANIFEST)!r} cannot be read: it has no {name}, or another thing in its place."
                )
        try:
            return cls(path, manifest)
        except InvalidSetting as error:
            raise RunCorrupt(f"{str(path / RUN_MANIFEST)!r} cannot be read: {error}") from None

    @classmethod
    def create_or_open(cls, path: Path, spec: RunSpec, *, dataset_path: Path, versions: Mapping[str, str]) -> Run:
        """The run of this folder if it asks for the same, else a new one, which is on disk once training begins.

        Raises:
            RunMismatch: The folder holds a run that asks for something else; says what differs.
        """
        if (path / RUN_MANIFEST).exists():
            run = cls.open(path)
            there = run.spec.completed() if run.spec.model == spec.model else run.spec
            old, new = dataclasses.asdict(there), dataclasses.asdict(spec)
            if differing := [
                f"{name} is {_short(old[name], new[name])} there and {_short(new[name], old[name])} here"
                for name in new
                if old[name] != new[name]
            ]:
                raise RunMismatch(
                    f"{str(path)!r} holds another run: {'; '.join(differing)}. "
                    "Name another folder with '--out DIR', or delete this one."
                )
            return run
        manifest = {
            "format": RUN_FORMAT,
            "spec": dataclasses.asdict(spec),
            "dataset_path": str(dataset_path),
            "versions": dict(versions),
            "result": None,
        }
        return cls(path, manifest)

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.path.name

    @property
    def dataset_path(self) -> Path:
        """Where the data set is: in the run's own workspace, which may have moved, or where it was."""
        given, workspace = Path(self.manifest["dataset_path"]), self.path.resolve().parent.parent
        for candidate in (workspace / given, given, workspace / "data" / given.name):
            if (candidate / DATASET_MANIFEST).is_file():
                return candidate
        return given

    @property
    def result(self) -> dict[str, Any] | None:
        """What the training came to, or None while it is not done."""
        result: dict[str, Any] | None = self.manifest["result"]
        return result

    @property
    def last(self) -> Path:
        """The checkpoint to resume from."""
        return self.path / "last.safetensors"

    @property
    def best(self) -> Path:
        """The weights that validated best."""
        return self.path / "best.safetensors"

    @property
    def watched(self) -> Path:
        """The checkpoint from which a run of another label budget can go on; few models have one."""
        return self.path / "watched.safetensors"

    @property
    def metrics(self) -> Path:
        """The training's curves, a JSON object a line."""
        return self.path / "metrics.jsonl"

    def require_aligned(self) -> None:
        """Refuse a model that was never told which of its latent actions is which action.

        Raises:
            LabelsNotAvailable: It was trained without labels, on a data set whose actions have names.
        """
        if self.spec.labels == "none" and self.spec.actions:
            raise LabelsNotAvailable(
                f"{self.name!r} was trained with '--labels none', so nothing says what any action does in it; the same "
                "'dmbench train' command with '--labels one-shot' takes the training over and names the actions."
            )

    def begin_anew(self) -> None:
        """Forget the result and all that the training wrote, so that it starts from the beginning."""
        for file in (self.last, self.best, self.watched, self.metrics):
            file.unlink(missing_ok=True)
        self.manifest["result"] = None
        self.write()

    def write(self) -> None:
        """Replace ``run.json`` in one step."""
        content = json.dumps(self.manifest, indent=2, ensure_ascii=False) + "\n"
        write_atomically(self.path / RUN_MANIFEST, content.encode())

    def finish(self, result: Mapping[str, Any]) -> None:
        """Write the result into the manifest."""
        self.manifest["result"] = dict(result)
        self.write()

    def weights(self) -> dict[str, Tensor]:
        """The trained model's weights, as the training wrote them.

        Raises:
            RunMissing: Training is not done, or they are gone.
            RunCorrupt: They cannot be read, or are others.
        """
        if self.result is None:
            raise RunMissing(
                f"the run {str(self.path)!r} is not finished; go on with the 'dmbench train' command that began it."
            )
        tensors, _ = checkpoint.load(self.best)
        weights = checkpoint.without_prefix("model", tensors)
        if checkpoint.weights_hash(weights) != self.result["weights"]:
            raise RunCorrupt(f"the weights in {str(self.best)!r} are not those that the training wrote.")
        return weights

    @cached_property
    def model(self) -> ForwardModel[Any]:
        """The trained model, in evaluation mode, its actions aligned.

        Raises:
            RunMissing: Training is not done.
            RunCorrupt: The weights do not fit the model, or are not those that the training wrote.
        """
        weights, model = self.weights(), self.spec.build()
        try:
            model.load_state_dict(weights)
        except RuntimeError as error:
            raise RunCorrupt(f"the weights in {str(self.best)!r} do not fit {self.spec.model!r}: {error}") from None
        return model.eval()


def _short(value: Any, other: Any) -> str:
    """Of two mappings only what differs."""
    if isinstance(value, Mapping) and isinstance(other, Mapping):
        return "{" + ", ".join(f"{key}: {value[key]!r}" for key in value if value[key] != other.get(key)) + "}"
    return repr(value)
