"""Checks and converts the arguments of a model's methods to the form that the contract in ``model.py`` asks for.

Every method of the contract is wrapped once, when its class is defined (``ForwardModel.__init_subclass__``). So a model
sees images in [-1, 1] in the memory format that its training asks for, and actions of its own kind, one a row,
whoever calls: a command, a notebook that passes stored frames, or a test that passes the number of an action.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from dmotion_bench.errors import UsageError
from dmotion_bench.learning.images import to_model
from dmotion_bench.wording import shown

if TYPE_CHECKING:
    from dmotion_bench.learning.model import ForwardModel

MethodT = TypeVar("MethodT", bound=Callable[..., Any])

IMAGES: Final = {
    "predict": 2,
    "begin": 2,
    "rollout": 2,
    "latent_action": 3,
    "predict_with_latent": 2,
    "agent_map": 1,
    "agent_maps": 1,
    "feature_maps": 1,
    "moved_maps": 2,
}
"""How many of a method's first arguments are images."""

ACTION: Final = {"predict": 2, "advance": 1, "rollout": 2}
"""Which of a method's arguments is the action."""

_TAKEN: Final = (torch.float32, torch.bfloat16)
"""Types of images that a model is given as they are; of bfloat16 by a caller who computes in it."""

BATCHES: Final = ("losses", "align")
"""Methods whose one argument holds triplets of images. The library alone makes these, in the right form."""


_BEYOND_BOUNDS: ContextVar[bool] = ContextVar("beyond_bounds", default=False)


@contextlib.contextmanager
def recorded_actions() -> Iterator[None]:
    """Within it, continuous actions may lie beyond the bounds of the training, as those of another import do.

    They were held against the bounds of their own data set when they were read. A model normalises them beyond [-1, 1].
    """
    token = _BEYOND_BOUNDS.set(True)
    try:
        yield
    finally:
        _BEYOND_BOUNDS.reset(token)


def guarded(method: MethodT, name: str | None = None) -> MethodT:
    """Wrap a method of the contract so that its arguments are checked; leave any other method unchanged.

    Args:
        method: A function in a class's body.
        name: Of the method; the function's own if left out.
    """
    name = name or method.__name__
    if name in BATCHES:

        @functools.wraps(method)
        def with_batch(self: ForwardModel[Any], *given: Any, **named: Any) -> Any:
            if named:
                given = inspect.signature(method).bind(self, *given, **named).args[1:]
            return method(self, *(one if self.channels_last else one.contiguous() for one in given))

        return cast(MethodT, with_batch)
    if name not in IMAGES and name not in ACTION:
        return method

    @functools.wraps(method)
    def with_arguments(self: ForwardModel[Any], *given: Any, **named: Any) -> Any:
        if named:
            given = inspect.signature(method).bind(self, *given, **named).args[1:]
        arguments = list(given)
        frames = range(min(IMAGES.get(name, 0), len(arguments)))
        for place in frames:
            arguments[place] = _images(self, f"{name}()", arguments[place])
        if len({len(arguments[place]) for place in frames}) > 1:
            counts = ", ".join(str(len(arguments[place])) for place in frames)
            raise UsageError(
                f"{type(self).__name__}.{name}() was given batches of {counts} images; all hold the same moments."
            )
        if name in ACTION and len(arguments) > ACTION[name]:
            like = arguments[0][0] if isinstance(arguments[0], tuple) else arguments[0]
            arguments[ACTION[name]] = _actions(self, f"{name}()", arguments[ACTION[name]], like, name == "rollout")
        return method(self, *arguments)

    return cast(MethodT, with_arguments)


def _images(model: ForwardModel[Any], method: str, value: Any) -> Tensor:
    """Images in [-1, 1], out of such ones or of stored pixels."""
    size = (model.inputs.height, model.inputs.width)
    images = torch.from_numpy(value) if isinstance(value, np.ndarray) else value
    if isinstance(images, Tensor) and images.ndim == 4:
        if images.dtype == torch.uint8 and images.shape[1:] == (*size, 3):
            images = to_model(images)
        elif images.dtype == torch.uint8 and images.shape[1:] == (3, *size):
            images = to_model(images.movedim(1, -1))
        if images.is_floating_point() and images.shape[1:] == (3, *size):
            images = images if images.dtype in _TAKEN else images.float()
            return images if model.channels_last else images.contiguous()
    raise UsageError(
        f"{type(model).__name__}.{method} was given {_described(value)} as images; it takes a batch of floating-point "
        f"images (b, 3, {size[0]}, {size[1]}) in [-1, 1], or of stored frames (b, {size[0]}, {size[1]}, 3) of uint8; "
        "dmotion_bench.learning.images.to_model makes the one of the other."
    )


def _actions(model: ForwardModel[Any], method: str, value: Any, like: Tensor, sequences: bool) -> Tensor:
    """A row of actions for each image or, of a rollout, a row and step; what is given for one is every row's."""
    spec = model.inputs.actions
    if spec is None:
        raise UsageError(
            f"{type(model).__name__}.{method} was given actions, and those of the model's data set are not known. "
            "Predict with a latent action: predict_with_latent(previous, current, latent)."
        )
    try:
        actions = torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError):
        actions = torch.empty(0, dtype=torch.bool)
    fitting = actions.dtype != torch.bool and (bool(spec.shape) or not actions.is_floating_point())
    rows, axes = len(like), (2 if sequences else 1) + len(spec.shape)
    if fitting and actions.ndim == axes - 1:
        actions = actions.expand(rows, *actions.shape)
    if (
        fitting
        and actions.ndim == axes
        and len(actions) == rows
        and actions.shape[axes - len(spec.shape) :] == spec.shape
    ):
        anything_goes = bool(spec.shape) and _BEYOND_BOUNDS.get()
        # reading them on another device would wait for it
        if actions.device.type == "cpu" and actions.numel() and not anything_goes:
            numbers = actions.detach().reshape(-1, *spec.shape)
            if fault := spec.fault(numbers.double() if spec.shape else numbers, "in row"):
                raise UsageError(f"{type(model).__name__}.{method} was given {fault}.")
        return actions.to(like.device, torch.float32 if spec.shape else torch.long)
    wanted = ", ".join(map(str, (rows, *(("steps",) if sequences else ()), *spec.shape)))
    raise UsageError(
        f"{type(model).__name__}.{method} was given {_described(value)} as actions; it takes "
        f"{'numbers' if spec.shape else 'whole numbers'} of the shape ({wanted}{'' if ', ' in wanted else ','}), a row "
        f"for each of the {rows} images, or {'one sequence' if sequences else 'one action'} for all of them."
    )


def _described(value: Any) -> str:
    if isinstance(value, Tensor | np.ndarray):
        return f"{str(value.dtype).removeprefix('torch.')} of the shape {tuple(value.shape)}"
    return shown(value)
