"""Checks and converts the arguments of a model's methods to the form that the contract in ``model.py`` asks for.

Every method of the contract is wrapped once, when its class is defined (``ForwardModel.__init_subclass__``). So a model
sees images in [-1, 1] in the memory format that its training asks for, and whole numbers of actions, one a row,
whoever calls: a command, a notebook that passes stored frames, or a test that passes the number of an action.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from dmotion_bench.actions import require_discrete
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
    "feature_maps": 1,
    "moved_maps": 2,
}
"""How many of a method's first arguments are images."""

ACTION: Final = {"predict": 2, "advance": 1, "rollout": 2}
"""Which of a method's arguments is the action."""

BATCHES: Final = ("losses", "align")
"""Methods whose one argument holds triplets of images. The library alone makes these, in the right form."""


def guarded(method: MethodT, name: str | None = None) -> MethodT:
    """Wrap a method of the contract so that its arguments are checked; leave any other method unchanged.

    Args:
        method: A function in a class's body.
        name: Of the method; the function's own if left out.
    """
    name = name or method.__name__
    if name in BATCHES:

        @functools.wraps(method)
        def with_batch(self: ForwardModel[Any], batch: Any) -> Any:
            if not self.channels_last:
                frames = {one: getattr(batch, one).contiguous() for one in ("previous", "current", "next")}
                batch = replace(batch, **frames)
            return method(self, batch)

        return cast(MethodT, with_batch)
    if name not in IMAGES and name not in ACTION:
        return method

    @functools.wraps(method)
    def with_arguments(self: ForwardModel[Any], *given: Any, **named: Any) -> Any:
        if named:
            given = inspect.signature(method).bind(self, *given, **named).args[1:]
        arguments = list(given)
        for place in range(min(IMAGES.get(name, 0), len(arguments))):
            arguments[place] = _images(self, f"{name}()", arguments[place])
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
            return images if model.channels_last else images.contiguous()
    raise UsageError(
        f"{type(model).__name__}.{method} was given {_described(value)} as images; it takes a batch of floating-point "
        f"images (b, 3, {size[0]}, {size[1]}) in [-1, 1], or of stored frames (b, {size[0]}, {size[1]}, 3) of uint8; "
        "dmotion_bench.learning.images.to_model makes the one of the other."
    )


def _actions(model: ForwardModel[Any], method: str, value: Any, like: Tensor, sequences: bool) -> Tensor:
    """Actions as whole numbers, one a row or, of a rollout, one a row and step; a single one is every row's."""
    try:
        actions = torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError):
        actions = torch.empty(0)
    whole = not actions.is_floating_point() and actions.dtype != torch.bool
    count = len(require_discrete(model.inputs.actions, f"{type(model).__name__}.{method}"))
    rows, axes = len(like), 2 if sequences else 1
    if whole and actions.ndim == axes - 1:
        actions = actions.expand(rows, *actions.shape)
    if whole and actions.ndim == axes and len(actions) == rows:
        known = isinstance(value, Tensor) or not actions.numel()  # what the library made is in range
        if not known and not 0 <= int(actions.min()) <= int(actions.max()) < count:
            raise UsageError(
                f"{type(model).__name__}.{method} was given the action {shown(value)}; the model was made for {count} "
                "actions, numbered from 0."
            )
        return actions.to(like.device, torch.long)
    wanted = f"({rows}, steps)" if sequences else f"({rows},)"
    raise UsageError(
        f"{type(model).__name__}.{method} was given {_described(value)} as actions; it takes whole numbers of the "
        f"shape {wanted}, a row for each of the {rows} images, or {'one sequence' if sequences else 'one number'} for "
        "all of them."
    )


def _described(value: Any) -> str:
    if isinstance(value, Tensor | np.ndarray):
        return f"{str(value.dtype).removeprefix('torch.')} of the shape {tuple(value.shape)}"
    return shown(value)
