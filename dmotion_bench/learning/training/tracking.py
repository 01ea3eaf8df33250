"""A training's curves in TensorBoard or Weights & Biases, beside ``metrics.jsonl``, which holds them in any case.

Both are optional packages. Weights & Biases stays offline, so that nothing leaves the machine, unless WANDB_MODE says
otherwise; ``wandb sync`` sends what it kept. A run that goes on adds to the same curves.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from dmotion_bench.errors import PackageNotInstalled, RunError
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.settings import to_json

_MODE: Final = "WANDB_MODE"
_PROJECT: Final = "WANDB_PROJECT"


@runtime_checkable
class Tracker(Protocol):
    """Takes what a training measures."""

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """Figures of a step, by names such as ``training/loss``."""

    def picture(self, step: int, name: str, picture: UInt8[np.ndarray, "y x 3"]) -> None:
        """What a model predicts at a step."""

    def close(self, result: Mapping[str, Any] | None) -> None:
        """The training is over; ``result`` is None if it was interrupted."""


def require_trackers(names: Sequence[str]) -> None:
    """Check that the packages are there, before anything is trained.

    Raises:
        PackageNotInstalled: One is not.
    """
    for name in names:
        if importlib.util.find_spec(name) is None:
            raise PackageNotInstalled(name, f"--log {name}", f"pip install 'dmbench[{name}]'")


class Trackers:
    """Some trackers of a training, maybe none.

    Args:
        trackers: Told the same.
    """

    def __init__(self, trackers: Sequence[Tracker] = ()) -> None:
        self._trackers = trackers

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """A row of ``metrics.jsonl``."""
        named = {_tag(name): value for name, value in values.items()}
        for tracker in self._trackers:
            tracker.scalars(step, named)

    def picture(self, step: int, picture: UInt8[np.ndarray, "y x 3"]) -> None:
        """A sheet of predictions."""
        for tracker in self._trackers:
            tracker.picture(step, "validation/predictions", picture)

    def close(self, result: Mapping[str, Any] | None) -> None:
        """The training is over, or interrupted."""
        for tracker in self._trackers:
            tracker.close(result)


@contextlib.contextmanager
def tracked(names: Sequence[str], run: Run, step: int) -> Iterator[Trackers]:
    """The trackers of a training.

    Args:
        names: ``tensorboard``, ``wandb``.
        run: What is trained; TensorBoard's events lie in its folder ``tensorboard``, those of wandb in ``wandb``.
        step: Steps that were taken before; what a killed process logged beyond them counts no more.

    Raises:
        PackageNotInstalled: A package is not there.
        RunError: Weights & Biases cannot begin.
    """
    require_trackers(names)
    kinds: Mapping[str, Callable[[Run, int], Tracker]] = {"tensorboard": TensorBoard, "wandb": WeightsAndBiases}
    trackers = Trackers([kinds[name](run, step) for name in names])
    try:
        yield trackers
    finally:
        trackers.close(run.result)


class TensorBoard:
    """Event files for ``tensorboard --logdir runs``."""

    def __init__(self, run: Run, step: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        first = step + 1 if step else 0  # a reader leaves out what an earlier process wrote of it and of later steps
        self._writer: Any = SummaryWriter(str(run.path / "tensorboard"), purge_step=first)
        if not step:
            lines = [f"    {name}: {value}" for name, value in to_json(run.spec).items()]
            self._writer.add_text("settings", "\n".join(lines), 0)

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """See ``Tracker``."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def picture(self, step: int, name: str, picture: UInt8[np.ndarray, "y x 3"]) -> None:
        """See ``Tracker``."""
        self._writer.add_image(name, picture, step, dataformats="HWC")

    def close(self, result: Mapping[str, Any] | None) -> None:
        """See ``Tracker``."""
        self._writer.close()


class WeightsAndBiases:
    """A run of Weights & Biases, named after the run's folder; WANDB_MODE and WANDB_PROJECT are heeded."""

    def __init__(self, run: Run, step: int) -> None:
        import wandb

        self._wandb: Any = wandb
        try:
            self._run: Any = wandb.init(
                dir=str(run.path),
                project=os.environ.get(_PROJECT, "dmbench"),
                name=run.name,
                id=hashlib.sha256(str(run.path.resolve()).encode()).hexdigest()[:16],
                resume="allow",
                config=to_json(run.spec),
                mode=os.environ.get(_MODE, "offline"),  # type: ignore[arg-type]
                settings=wandb.Settings(silent=True, console="off", disable_git=True, save_code=False),
            )
        except Exception as error:  # its errors are of many kinds, those of its server among them
            raise RunError(
                f"Weights & Biases cannot begin: {str(error).splitlines()[0] if str(error) else type(error).__name__}. "
                f"Set {_MODE}=offline, or leave out '--log wandb'."
            ) from None
        self._run.define_metric("*", step_metric="training_step")

    def scalars(self, step: int, values: Mapping[str, float]) -> None:
        """See ``Tracker``."""
        self._run.log({**values, "training_step": step})

    def picture(self, step: int, name: str, picture: UInt8[np.ndarray, "y x 3"]) -> None:
        """See ``Tracker``."""
        self._run.log({name: self._wandb.Image(picture), "training_step": step})

    def close(self, result: Mapping[str, Any] | None) -> None:
        """See ``Tracker``."""
        if result is not None:
            self._run.summary.update(dict(result))
        self._run.finish(exit_code=0 if result is not None else 1)


def _tag(name: str) -> str:
    """The place of a figure among others: ``validation_loss`` is ``validation/loss``."""
    part, underscore, rest = name.partition("_")
    return f"validation/{rest}" if underscore and part == "validation" else f"training/{name}"
