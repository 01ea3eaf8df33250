"""A trained model that takes stored frames and the names of actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from dmotion_bench.actions import ActionSpec, Discrete
from dmotion_bench.api.datasets import Dataset
from dmotion_bench.errors import DatasetMissing, RunMismatch, RunMissing, UnknownName, UsageError
from dmotion_bench.learning.images import to_pixels
from dmotion_bench.learning.runs import run as runs
from dmotion_bench.learning.runs.own_data import dataset_of
from dmotion_bench.scoring.report import REPORT_FOLDER, Report, read_report
from dmotion_bench.specs import Supervision
from dmotion_bench.wording import command
from dmotion_bench.workspace import AnyPath, Workspace, in_workspace

Images = np.ndarray[Any, Any] | Tensor
"""Stored frames UInt8[h w 3] or UInt8[b h w 3], or images Float[b c h w] in [-1, 1]."""

_FARTHEST: Final = 10.0
"""Of an image's values from zero; a predicted one may lie outside [-1, 1], pixels reach 255."""


class Run(runs.Run):
    """A training run on disk; ``load_run`` opens one, and ``train`` returns one.

    It has what ``dmotion_bench.learning.runs.run.Run`` has, such as ``result`` and ``model``, and the methods below.
    They take frames as they are stored (uint8, RGB, 0-255, channels last) and return such frames; or images of a
    ``DataLoader``'s batch (Float[b c h w] in [-1, 1]) and return such images. One frame without an axis for the batch
    is a batch of one, and so is what comes back.
    """

    @property
    def dataset(self) -> Dataset:
        """The data set that it was trained on.

        Raises:
            DatasetMissing: It is not there any more.
            RunMismatch: Another one is there now.
        """
        found = dataset_of(self, Dataset)
        if found.fingerprint != self.spec.fingerprint:
            raise RunMismatch(
                f"the data set {str(self.dataset_path)!r} has changed since the run {self.name!r} was trained on it; "
                "open it as it is now with dm.open_dataset, or train again with dm.train."
            )
        return found

    @property
    def report(self) -> Report:
        """What ``score`` found, on the data set of the training.

        Raises:
            RunMissing: It is not scored yet.
        """
        found = read_report(self.path / REPORT_FOLDER)
        if found is None:
            score = command("dmbench score", self.path)
            raise RunMissing(f"the run {self.name!r} has no report; score it with {score}, or dm.score.")
        return found

    def __repr__(self) -> str:
        trained = "trained" if self.result is not None else "not trained"
        return f"<Run {self.name!r}: {self.spec.model}, labels {self.spec.labels}, {trained}>"

    def predict(self, previous: Images, current: Images, action: Any) -> Images:
        """The frames after ``current`` if ``action`` is taken.

        Args:
            previous, current: The last two frames.
            action: One for all, or one for each: the names or numbers of discrete actions, or Float[b a] in their
                units.

        Raises:
            RunMissing: The training is not finished.
            LabelsNotAvailable: It was trained without labels, so it does not know which action is which.
            UnknownName: No action has this name.
            DatasetMissing, RunMismatch: An action is named, the run is of a version that kept no names, and its data
                set is gone or another one.
            UsageError: Frames or actions of another shape or kind.

        Example:
            >>> run = dm.load_run("tiny")
            >>> frames = run.dataset.video(0)
            >>> run.predict(frames[0], frames[1], "right").shape
            (1, 128, 128, 3)
        """
        self.require_aligned()
        before, now = _batch(previous), _batch(current)
        with torch.inference_mode():
            images = self.model.predict(before, now, self._actions(action))
        return _like(current, images)

    def rollout(self, previous: Images, current: Images, actions: Any) -> Images:
        """The frames that a sequence of actions leads to, each predicted from the model's own last ones.

        Args:
            previous, current: The last two frames.
            actions: One sequence for all, or one for each: names or numbers, or Float[b t a] in their units.

        Returns:
            UInt8[b t h w 3], or Float[b t c h w] in [-1, 1].

        Raises:
            RunMissing, LabelsNotAvailable, UnknownName, DatasetMissing, RunMismatch, UsageError: As ``predict``.

        Example:
            >>> run = dm.load_run("tiny")
            >>> frames = run.dataset.video(0)
            >>> run.rollout(frames[0], frames[1], ["right", "right", "up"]).shape
            (1, 3, 128, 128, 3)
        """
        self.require_aligned()
        before, now = _batch(previous), _batch(current)
        with torch.inference_mode():
            images = self.model.rollout(before, now, self._actions(actions))
        return _like(current, images)

    def latent_action(self, previous: Images, current: Images, following: Images) -> Images:
        """What the model takes to have happened between ``current`` and ``following``.

        Args:
            previous, current, following: Three consecutive frames.

        Returns:
            Float[b d]; an array for stored frames, a tensor for images.

        Raises:
            UsageError: The model has no latent actions.

        Example:
            >>> run = dm.load_run("tiny")
            >>> frames = run.dataset.video(0)
            >>> run.latent_action(frames[0], frames[1], frames[2]).shape
            (1, 2)
        """
        model: Any = self.model
        if not hasattr(model, "latent_action"):
            given = (
                "it is given the actions; a model of video has them, such as dmotion"
                if model.supervision is Supervision.ACTIONS
                else "it defines no method latent_action(previous, current, following)"
            )
            raise UsageError(f"{self.spec.model!r} has no latent actions that can be read: {given}.")
        with torch.inference_mode():
            latent: Tensor = model.latent_action(_batch(previous), _batch(current), _batch(following))
        return latent.numpy() if _is_stored(current) else latent

    def _actions(self, given: Any) -> Any:
        """Numbers in the place of names, and where they can be checked; everything else as it is."""
        if isinstance(given, Tensor):
            return given.cpu()
        if isinstance(given, str):
            return self._number(given)
        return [self._actions(one) for one in given] if isinstance(given, Sequence) else given

    def _number(self, name: str) -> int:
        """The number of a discrete action."""
        spec = self.spec.action_spec
        if not isinstance(spec, Discrete):
            raise UsageError(f"the action is named {name!r}, and this model's actions are {spec}; give numbers.")
        named = self.named_actions or self._names_of_dataset(spec, name)
        assert isinstance(named, Discrete), "as the run's are"
        if name not in named.names:
            raise UnknownName("action", name, named.names)
        return named.names.index(name)

    def _names_of_dataset(self, numbered: Discrete, name: str) -> ActionSpec | None:
        """The actions of a run of before, which has no names; of one without its data set they are numbers."""
        try:
            return self.dataset.spec.actions
        except DatasetMissing:
            if name not in numbered.names:
                raise
            return numbered


@in_workspace
def load_run(run: AnyPath | None = None, *, workspace: AnyPath | None = None) -> Run:
    """Open a run, trained or not; its weights are read when they are first needed.

    Args:
        run: Its folder, or its name in the workspace. Default: the workspace's only one.
        workspace: The folder with ``data/`` and ``runs/``; the current one by default.

    Raises:
        RunMissing, UnknownName: There is none.
        UsageError: There are several, and none was named.
        RunCorrupt: Its files are damaged.

    Example:
        >>> run = dm.load_run("tiny")
        >>> run.spec.model, run.spec.labels
        ('dmotion', 'one-shot')
    """
    place = Workspace.current()
    return Run.open(place.run(run))


def _is_stored(images: Images) -> bool:
    return isinstance(images, np.ndarray) or images.dtype == torch.uint8


def _batch(images: Images) -> Tensor:
    """A batch, of frames or images; the model says what is wrong with any other.

    Raises:
        UsageError: There are none, or these are numbers that are no images in [-1, 1], which a model would take for
            ones.
    """
    tensor = torch.tensor(images) if isinstance(images, np.ndarray) else images
    if isinstance(tensor, Tensor) and not tensor.numel():
        raise UsageError(f"there are no images: they were given with the shape {tuple(tensor.shape)}.")
    images_given = isinstance(tensor, Tensor) and tensor.is_floating_point()
    if images_given and not tensor.abs().max() <= _FARTHEST:  # nor if it is no number
        raise UsageError(
            f"images have values from {tensor.min():g} to {tensor.max():g}; a model's lie in [-1, 1]. Give stored "
            "frames as uint8, or convert them with dmotion_bench.learning.images.to_model."
        )
    return tensor[None] if isinstance(tensor, Tensor) and tensor.ndim == 3 else tensor


def _like(given: Images, images: Tensor) -> Images:
    """The images in the form of what was given: stored frames for stored frames."""
    if not _is_stored(given):
        return images
    frames = to_pixels(images)
    return frames.numpy() if isinstance(given, np.ndarray) else frames
