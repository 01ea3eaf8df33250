"""A learned model that somebody drives, action by action, beside the simulator where there is one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import torch
from jaxtyping import Float

from dmotion_bench.actions import ActionSpec, ActionTaken, Continuous
from dmotion_bench.environment import Environment
from dmotion_bench.errors import DmbenchError, LabelsNotAvailable
from dmotion_bench.learning.driving import Drive
from dmotion_bench.learning.runs.own_data import dataset_of
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.planning.tasks import take, task_environment
from dmotion_bench.specs import IMPORTED
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing.drive import drive_blueprint, log_drive
from dmotion_bench.workspace import AnyPath, Workspace

Frame = np.ndarray[Any, Any]


@dataclass(kw_only=True)
class Driven:
    """A model at the first frame of an episode, and what was done since; to be closed when it is done with.

    Attributes:
        run: The model's.
        dataset: With the episode.
        actions: What can be done.
        episode: Its number.
        moment: Actions and new beginnings so far.
    """

    run: Run
    dataset: Dataset
    actions: ActionSpec
    episode: int
    moment: int = 0
    _env: Environment | None = field(default=None, init=False, repr=False)

    def close(self) -> None:
        """Free the simulator, if there is one."""
        if self._env is not None:
            self._env.close()
            self._env = None

    @property
    def title(self) -> str:
        """What a recording of it is called."""
        return f"{self.run.name}, from episode {self.episode}"

    @property
    def blueprint(self) -> rrb.Blueprint:
        """How a recording of it is laid out."""
        return drive_blueprint(self.dataset.spec, self._truth is not None)

    @property
    def first_command(self) -> Float[np.ndarray, " a"] | None:
        """The first action of the episode, where continuous actions were imported; else None.

        An import does not say which action does nothing: 0 may be far away, as of the joint positions of an arm. Where
        the labels are not there, the middle of the bounds.
        """
        if self.dataset.recipe.environment != IMPORTED or not isinstance(self.actions, Continuous):
            return None
        try:
            first: Float[np.ndarray, " a"] = self.dataset.states(self.episode).actions[0]
        except LabelsNotAvailable:
            return self.actions.middle
        return first

    def begin(self, recording: rr.RecordingStream) -> None:
        """Log the first frame."""
        self._log(recording, None)

    def move(self, recording: rr.RecordingStream, action: ActionTaken | None) -> None:
        """Take an action, or start again (None), and log what the model imagines and what truly happens."""
        self.moment += 1
        if action is None:
            self._drive.restart()
        else:
            self._drive.step(action)
        self._log(recording, action)

    def _log(self, recording: rr.RecordingStream, action: ActionTaken | None) -> None:
        seen = None if self._truth is None else self._truth(action)
        log_drive(recording, self.moment, self._drive.frame.numpy(), seen)

    @cached_property
    def _drive(self) -> Drive:
        return Drive(self.run.model, torch.from_numpy(self.dataset.video(self.episode)[0]))

    @cached_property
    def _truth(self) -> Callable[[ActionTaken | None], Frame] | None:
        """A function that takes an action in the simulator (None: start again); None without that environment."""
        recipe = self.dataset.recipe
        if recipe.environment == IMPORTED:
            return None
        try:
            env = self._env = task_environment(recipe)
        except DmbenchError:
            return None

        def follow(action: ActionTaken | None) -> Frame:
            if action is None:
                options = {"vary": list(recipe.vary)} if recipe.vary else None
                frame: Frame = env.reset(seed=self.dataset.row(self.episode).seed, options=options)[0]
                return frame
            return take(env, action)

        return follow


def open_driven(run: AnyPath | None, episode: int | None, workspace: Workspace) -> Driven:
    """A model to be driven from an episode's first frame.

    Args:
        run: A run, by folder or name; None for the only one.
        episode: None for the first test episode.
        workspace: Where runs are looked for.

    Raises:
        RunMissing, UnknownName: There is none.
        UsageError: There is no such episode.
        LabelsNotAvailable: Nothing says which action is which in the model, or actions are not known at all.
    """
    opened = Run.open(workspace.run(run))
    opened.require_aligned()
    dataset = dataset_of(opened, Dataset)
    if dataset.spec.actions is None:
        raise LabelsNotAvailable(f"the actions of {dataset.name!r} are not known, so its models cannot be driven.")
    test = dataset.split("test")
    chosen = int(test[0]) if episode is None and len(test) else episode or 0
    dataset.row(chosen)  # an episode that there is not is said before anything is loaded
    return Driven(run=opened, dataset=dataset, actions=dataset.spec.actions, episode=chosen)
