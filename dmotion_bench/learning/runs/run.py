"""A training run on disk: its request, its progress and its trained model.

::

    runs/dmotion-grid_world-small-s0/
      run.json            what decides the result (RunSpec, Conditions), the versions, hashes of the model's code, the
                          names of discrete actions, and the result once there is one
      metrics.jsonl       a row every few steps: losses, learning rate, triplets/s; a row a validation
      last.safetensors    all that resuming needs
      best.safetensors    the weights that validated best, with the actions aligned once training is done
      watched.safetensors where the phases that need no labels ended, if others came after them
      unadapted.safetensors the best weights before demonstrations aligned or tuned the model, if it was given any
      samples/            pictures of what the model predicted at each validation
      report/             written by ``dmbench score``
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, Final, TypeVar

import torch
from torch import Tensor

from dmotion_bench.actions import ActionSpec, Discrete
from dmotion_bench.addresses import remote_address
from dmotion_bench.errors import InvalidSetting, LabelsNotAvailable, RunCorrupt, RunError, RunMismatch, RunMissing
from dmotion_bench.learning.data.label_request import first_budget
from dmotion_bench.learning.hardware.precision import AUTO
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.manifest import ACTION_NAMES, RUN_FORMAT, Conditions, RunSpec, read_manifest
from dmotion_bench.learning.runs.own_data import find_own_data
from dmotion_bench.learning.runs.source import changed_modules, code_of
from dmotion_bench.learning.settings import from_json
from dmotion_bench.storage.atomic import write_atomically
from dmotion_bench.storage.links import require_no_link_out
from dmotion_bench.storage.remote_copy import copy_folder
from dmotion_bench.versions import versions, with_earlier
from dmotion_bench.wording import command, shown
from dmotion_bench.workspace import RUN_MANIFEST, AnyPath

__all__ = ["Conditions", "Run", "RunSpec"]

SAMPLES: Final = "samples"
"""The folder of the pictures."""
TRACKED: Final = ("tensorboard", "wandb")
"""Folders of programs that show curves (``training/tracking.py``); Weights & Biases links its own logs there."""

AnyRun = TypeVar("AnyRun", bound="Run")
"""Run, or what a layer above makes of it."""


def require_own_files(run: Path) -> None:
    """See that no link in a run's folder leads out of it.

    Raises:
        RunError: One does.
    """
    require_no_link_out(run / RUN_MANIFEST, "run", RunError, others=TRACKED)


class Run:
    """One run's folder.

    Attributes:
        path: The folder.
        manifest: What ``run.json`` holds.
        spec: What was asked for.
        threads: Threads that each process computes with: as recorded, else as asked for, else None.
    """

    def __init__(self, path: Path, manifest: dict[str, Any], threads: int | None = None) -> None:
        self.path, self.manifest = path, manifest
        self.spec = from_json(RunSpec, manifest["spec"])
        self.threads = threads if self.conditions is None else self.conditions.threads

    def __fspath__(self) -> str:
        """Its folder: a run may stand wherever a path may."""
        return str(self.path)

    @classmethod
    def open(cls: type[AnyRun], path: AnyPath) -> AnyRun:
        """A run that exists, finished or not.

        Raises:
            RunMissing: The folder holds no run.
            RunCorrupt: Its manifest cannot be read, or is of another version.
            RunError: Its manifest may not be opened, or a link in the folder leads out of it.
        """
        path = Path(path)
        file = path / RUN_MANIFEST
        try:
            require_own_files(path)
            return cls(path, read_manifest(file))
        except (FileNotFoundError, NotADirectoryError):
            raise RunMissing(f"no run in {shown(str(path))}; list them with 'dmbench list runs'.") from None
        except OSError as error:
            where = shown(str(error.filename or file))
            raise RunError(f"{where} cannot be opened: {error.strerror}; make it readable.") from None
        except (ValueError, InvalidSetting) as error:
            raise RunCorrupt(
                f"{shown(str(file))} cannot be read: {str(error).rstrip('.')}. Restore it from a copy, or delete the "
                "folder and train again with 'dmbench train'."
            ) from None

    @classmethod
    def create_or_open(
        cls: type[AnyRun],
        path: Path,
        spec: RunSpec,
        *,
        dataset_path: Path | str,
        versions: Mapping[str, str],
        threads: int | None = None,
        actions: ActionSpec | None = None,
    ) -> AnyRun:
        """The run of this folder if it asks for the same, else a new one, which is on disk once training begins.

        Args:
            path: The folder.
            spec: What is asked for.
            dataset_path: Of the data set, or its address.
            versions: Of the packages, for a new run.
            threads: Asked for; None takes those of the run, or in a new one torch's own number.
            actions: Of the data set; a new run keeps the names of discrete ones, which ``spec`` does not hold.

        Raises:
            RunMismatch: The folder holds a run that asks for something else; says what differs.
        """
        if (path / RUN_MANIFEST).exists():
            run = cls.open(path)
            run._require_same(spec, threads)
            run.threads = run.threads or threads
            return run
        manifest: dict[str, Any] = {
            "format": RUN_FORMAT,
            "spec": dataclasses.asdict(spec),
            "dataset_path": str(dataset_path),
            "versions": dict(versions),
            "code": code_of(spec.model),
            "result": None,
        }
        if isinstance(actions, Discrete):
            manifest[ACTION_NAMES] = list(actions.names)
        return cls(path, manifest, threads)

    def _require_same(self, spec: RunSpec, threads: int | None) -> None:
        if differing := self.differences(spec, threads):
            raise RunMismatch(
                f"{str(self.path)!r} holds another run: {'; '.join(differing)}. "
                "Name another folder with '--out DIR', or delete this one."
            )

    def read_again(self) -> None:
        """Take up what ``run.json`` says by now; for a process that holds the folder's lock.

        Another command may have begun the run, or finished it, since this process read the file.

        Raises:
            RunMismatch: The folder holds a run that asks for something else; says what differs.
            RunCorrupt: The file cannot be read.
            RunError: It may not be opened.
        """
        if not (self.path / RUN_MANIFEST).exists():
            return
        there = Run.open(self.path)
        there._require_same(self.spec, self.threads)
        self.manifest, self.spec, self.threads = there.manifest, there.spec, there.threads or self.threads

    def differences(self, spec: RunSpec, threads: int | None) -> list[str]:
        """The settings in which another request differs from this run; ``threads`` None stands for any number.

        Raises:
            InvalidSetting: The run has settings that this version does not know.
        """
        there = self.spec
        if there.model == spec.model:
            there, spec = there.completed(), spec.completed()
            asked = spec.training["precision"]
            if asked == AUTO or (self.conditions is not None and asked == self.conditions.precision):
                there = dataclasses.replace(there, training={**there.training, "precision": asked})
        old, new = dataclasses.asdict(there), dataclasses.asdict(spec)
        if threads is not None and self.conditions is not None:
            old["threads"], new["threads"] = self.conditions.threads, threads
        return [
            f"{name} is {_short(old[name], new[name])} there and {_short(new[name], old[name])} here"
            for name in new
            if old[name] != new[name]
        ]

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.path.name

    @property
    def dataset_path(self) -> Path:
        """Where the data set is: in the run's own workspace, which may have moved, or where it was.

        One of another name is found there by its fingerprint.

        An address is only followed to a place that was opened from here before: the run may come from anybody.

        Raises:
            RunError: The data set is at an address that nobody has opened here.
        """
        if (address := remote_address(self.manifest["dataset_path"])) is not None:
            if not copy_folder(address).is_dir():
                raise RunError(
                    f"the run {self.name!r} was trained on {shown(address)}, which was never opened from here; if you "
                    f"trust that place, open it with {command('dmbench data info', address)} and run the command again."
                )
            return Path(address)
        given = Path(self.manifest["dataset_path"])
        workspaces = [path.parent.parent for path in (self.path.resolve(), self.path.absolute())]  # it may be a link
        inside = [workspace / given for workspace in workspaces]
        named = (*inside, given, *(workspace / "data" / given.name for workspace in workspaces))
        return find_own_data(named, workspaces, self.spec.fingerprint) or given

    @property
    def result(self) -> dict[str, Any] | None:
        """The result of the training; None until it is finished."""
        result: dict[str, Any] | None = self.manifest["result"]
        return result

    @property
    def conditions(self) -> Conditions | None:
        """The threads and precision of the training; None before its first step and in older runs."""
        recorded = self.manifest.get("conditions")
        return None if recorded is None else from_json(Conditions, recorded)

    def begin(self, conditions: Conditions) -> None:
        """Record the threads and precision of a training, and the versions that it begins or goes on with."""
        self.manifest["conditions"] = dataclasses.asdict(conditions)
        self.manifest["versions"] = with_earlier(self.manifest["versions"], versions())
        self.threads = conditions.threads
        self.write()

    @property
    def named_actions(self) -> ActionSpec | None:
        """The actions of the data set with their names; None if they are not known, or in older runs if discrete."""
        if isinstance(self.spec.action_spec, Discrete):
            names = self.manifest.get(ACTION_NAMES)
            return None if names is None else Discrete(tuple(names))
        return self.spec.action_spec

    @property
    def last(self) -> Path:
        """The checkpoint to resume from."""
        return self.path / "last.safetensors"

    @property
    def best(self) -> Path:
        """The weights that validated best."""
        return self.path / "best.safetensors"

    @property
    def unlabelled_stage(self) -> Path:
        """The checkpoint after the phases that need no labels, from which other label budgets go on."""
        return self.path / "watched.safetensors"

    @property
    def unadapted(self) -> Path:
        """The best weights before demonstrations aligned or tuned the model, where it was given any."""
        return self.path / "unadapted.safetensors"

    @property
    def metrics(self) -> Path:
        """The training's curves, a JSON object a line."""
        return self.path / "metrics.jsonl"

    @property
    def changed_modules(self) -> list[str]:
        """The modules of the model whose code was changed since the training began, by name (``source.py``).

        Runs of older versions say nothing of theirs, nor of the classes of a notebook.
        """
        return changed_modules(self.manifest.get("code", {}), self.spec.model)

    def require_aligned(self) -> None:
        """Raise an error if the model was never told which latent action each action is.

        Raises:
            LabelsNotAvailable: It was trained without labels, on a data set whose actions have names.
        """
        if self.spec.labels == "none" and self.spec.actions:
            named = first_budget(self.spec.action_spec)
            raise LabelsNotAvailable(
                f"{self.name!r} was trained with '--labels none', so nothing says what any action does in it; the same "
                f"'dmbench train' command with '--labels {named}' takes the training over "
                "and names the actions."
            )

    def begin_anew(self) -> None:
        """Delete the result, the checkpoints, the curves and the pictures, so that the training starts again.

        Its threads and precision stay; code and versions are then those of now.
        """
        files = (self.last, self.best, self.unlabelled_stage, self.unadapted, self.metrics)
        for file in (*files, *(self.path / SAMPLES).glob("*.png")):
            file.unlink(missing_ok=True)
        self.manifest |= {"versions": versions(), "code": code_of(self.spec.model), "result": None}
        self.manifest.pop("trained_as", None)
        self.write()

    def write(self) -> None:
        """Replace ``run.json`` in one step."""
        content = json.dumps(self.manifest, indent=2, ensure_ascii=False) + "\n"
        write_atomically(self.path / RUN_MANIFEST, content.encode())

    def finish(self, result: Mapping[str, Any]) -> None:
        """Write the result into the manifest."""
        self.manifest["result"] = dict(result)
        self.write()

    def forms(self, file: Path) -> checkpoint.Forms:
        """The tensors of the model in a checkpoint of this run, by their names there.

        Args:
            file: The checkpoint; a model of far more tensors than it has is not built to its end.

        Raises:
            RunCorrupt: No model can be built as ``run.json`` says.
        """
        try:
            return checkpoint.with_prefix("model", self.spec.forms(most=100 + 2 * checkpoint.count_tensors(file)))
        except InvalidSetting as error:
            raise RunCorrupt(
                f"the model of {shown(str(self.path / RUN_MANIFEST))} cannot be built: {error} Restore that file from "
                "a copy, or delete the folder and train again with 'dmbench train'."
            ) from None

    def weights(self) -> dict[str, Tensor]:
        """The weights of a finished run, whatever model they may fit, as the training wrote them.

        Raises:
            RunMissing: Training is not done, or they are gone.
            RunCorrupt: They cannot be read, or are others.
            RunError: They may not be opened.
        """
        return self._weights(None)

    @cached_property
    def model(self) -> ForwardModel[Any]:
        """The trained model, in evaluation mode, its actions aligned.

        Raises:
            RunCorrupt: The weights do not fit the model; and what ``weights`` raises.
        """
        self._require_result()
        with torch.inference_mode(False):  # whoever asks for it first, it can be trained further
            try:
                weights = self._weights(self.forms(self.best))
            except RunCorrupt as error:
                if names := self.changed_modules:
                    self.weights()  # raises if they are damaged; else they are to be kept
                    raise RunCorrupt(
                        f"the weights of {self.name!r} do not fit its model {self.spec.model!r}, whose code was "
                        f"changed since it was trained ({', '.join(names)}); undo the change to use them, or train the "
                        "model as it is now in a new run (--out DIR)."
                    ) from error
                raise
            model = self.spec.build()
            try:
                model.load_state_dict(weights)
            except RuntimeError as error:
                raise RunCorrupt(f"the weights in {str(self.best)!r} do not fit {self.spec.model!r}: {error}") from None
        return model.eval()

    def _require_result(self) -> dict[str, Any]:
        if self.result is None:
            raise RunMissing(
                f"the run {str(self.path)!r} is not finished; go on with the 'dmbench train' command that began it."
            )
        return self.result

    def _weights(self, forms: checkpoint.Forms | None) -> dict[str, Tensor]:
        result = self._require_result()
        tensors, _ = checkpoint.load(self.best, required=forms)
        weights = checkpoint.without_prefix("model", tensors)
        if checkpoint.weights_hash(weights) != result["weights"]:
            raise checkpoint.damaged(self.best, "holds other weights than those that the training wrote")
        return weights


def _short(value: Any, other: Any) -> str:
    """The entries in which two mappings differ."""
    if isinstance(value, Mapping) and isinstance(other, Mapping):
        return "{" + ", ".join(f"{key}: {value[key]!r}" for key in value if value[key] != other.get(key)) + "}"
    return repr(value)
