"""A model's predictions of an episode as arrays: single steps, a whole rollout, maps and motions.

The first two frames of an episode are given. From then on two predictions of every frame stand beside it:

- **one step**: from the two true frames before it and the action taken there;
- **imagined**: from the model's own last two frames; only the actions are still the recorded ones.

Where the actions are not known, a model with a latent action (``LatentActionModel``) is told the one that
it reads off the true frames instead, as in ``scoring/explanation.py``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped, UInt8
from torch import Tensor

from dmotion_bench.errors import LabelsNotAvailable
from dmotion_bench.learning.action_encoding import as_tensor
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.positions import PositionFinder
from dmotion_bench.scoring.identification import motions_of
from dmotion_bench.scoring.latent_models import LatentActionModel, ShiftModel
from dmotion_bench.scoring.pixels import mean_squared_error
from dmotion_bench.scoring.position_errors import position_errors
from dmotion_bench.scoring.prediction import predicting
from dmotion_bench.specs import EnvSpec, EpisodeLabels
from dmotion_bench.viewing.maps import MapModel

GIVEN = 2
"""True frames that a model is given."""

BATCH = 16


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Predicted frames GIVEN ... t-1 of an episode of t frames, and how good they are.

    Attributes:
        frames: Predicted.
        mse: Of each, over pixels and channels, 0-255.
        places: Where the things are that are found in them [px]; NaN where one is not found.
        position_error: Mean distance of the things that are found in both frames [px]; NaN where none is.
        missed: Share of the things in the true frame that are not found in the predicted one.
    """

    frames: UInt8[np.ndarray, "s h w 3"]
    mse: Float[np.ndarray, " s"]
    places: Float[np.ndarray, "s k 2"] | None
    position_error: Float[np.ndarray, " s"] | None
    missed: Float[np.ndarray, " s"] | None


@dataclass(frozen=True, kw_only=True)
class Imagination:
    """An episode and a model's predictions of it.

    Attributes:
        frames: The true ones.
        places: Of the things that are found in them [px]; None where nothing has a colour of its own.
        one_step, imagined, copied: Predictions; the last repeats the frame before, the least that one can do.
        maps, moved: The feature maps of frames 0 ... t-2, and the same moved to the frame after.
        shift: How far each agent moves from each of these frames to the next, as the model sees it [px].
        by_motion: Whether the motions of the true frames were told instead of the actions.
    """

    frames: UInt8[np.ndarray, "t h w 3"]
    places: Float[np.ndarray, "t k 2"] | None
    one_step: Prediction
    imagined: Prediction
    copied: Prediction
    maps: Float[np.ndarray, "n m y x"] | None
    moved: Float[np.ndarray, "n m y x"] | None
    shift: Float[np.ndarray, "a n 2"] | None
    by_motion: bool = False


def can_imagine(model: ForwardModel[Any], labels: EpisodeLabels | None) -> bool:
    """Whether a model can predict an episode: from its actions or, if these are unknown, from latent actions."""
    return labels is not None or isinstance(model, LatentActionModel)


def imagine(
    model: ForwardModel[Any], frames: UInt8[np.ndarray, "t h w 3"], labels: EpisodeLabels | None, spec: EnvSpec
) -> Imagination:
    """Run a model over an episode of at least three frames; one that ``can_imagine`` it.

    Raises:
        LabelsNotAvailable: The actions are not known, and the model predicts by actions alone.
    """
    images = to_model(torch.from_numpy(frames))
    with predicting(torch.device("cpu")):
        if labels is not None:
            steps, imagined = _by_actions(model, images, as_tensor(labels.actions))
        elif isinstance(model, LatentActionModel):
            steps, imagined = _by_latent(model, images)
        else:
            raise LabelsNotAvailable("the actions are not known, and this model predicts by actions alone.")
        maps, moved = _maps(model, images)
        shift = _shift(model, images)
    judge = _Judge(spec, torch.from_numpy(frames))
    return Imagination(
        frames=frames,
        places=judge.places,
        one_step=judge.of(steps),
        imagined=judge.of(imagined),
        copied=judge.of(torch.from_numpy(frames[1:-1])),
        maps=maps,
        moved=moved,
        shift=shift,
        by_motion=labels is None,
    )


_Drawn = tuple[UInt8[Tensor, "s h w 3"], UInt8[Tensor, "s h w 3"]]


def _by_actions(
    model: ForwardModel[Any], images: Float[Tensor, "t c h w"], actions: Int[Tensor, " m"] | Float[Tensor, "m a"]
) -> _Drawn:
    """One step, and imagined, from the recorded actions."""
    steps = [
        to_pixels(model.predict(before, now, action))
        for before, now, action in zip(_parts(images[:-2]), _parts(images[1:-1]), _parts(actions[1:]), strict=True)
    ]
    return torch.cat(steps), to_pixels(model.rollout(images[:1], images[1:2], actions[None, 1:])[0])


def _by_latent(model: LatentActionModel, images: Float[Tensor, "t c h w"]) -> _Drawn:
    """The same from the latent actions that the model reads off the true frames."""
    given = zip(_parts(images[:-2]), _parts(images[1:-1]), _parts(images[2:]), strict=True)
    latents = [model.latent_action(before, now, after) for before, now, after in given]
    steps = [
        to_pixels(model.predict_with_latent(before, now, latent))
        for before, now, latent in zip(_parts(images[:-2]), _parts(images[1:-1]), latents, strict=True)
    ]
    own = [images[:1], images[1:2]]
    for latent in torch.cat(latents):
        own.append(model.predict_with_latent(own[-2], own[-1], latent[None]))
    return torch.cat(steps), to_pixels(torch.cat(own[GIVEN:]))


def _parts(whole: Shaped[Tensor, "t *rest"]) -> tuple[Shaped[Tensor, "b *rest"], ...]:
    parts: tuple[Tensor, ...] = torch.split(whole, BATCH)
    return parts


class _Judge:
    """Compares predictions with the frames of an episode, as the scores do."""

    def __init__(self, spec: EnvSpec, frames: UInt8[Tensor, "t h w 3"]) -> None:
        things = spec.objects or spec.agent_has_color
        self._finder = PositionFinder(spec) if things else None
        self._truth = frames[GIVEN:]
        self._found = self._finder.find(self._truth) if self._finder else None
        self.places = self._finder.find(frames).centre.numpy() if self._finder else None

    def of(self, predicted: UInt8[Tensor, "s h w 3"]) -> Prediction:
        places = self._finder.find(predicted) if self._finder else None
        errors = position_errors(places, self._found) if places is not None and self._found is not None else None
        return Prediction(
            frames=predicted.numpy(),
            mse=mean_squared_error(predicted, self._truth).numpy(),
            places=None if places is None else places.centre.numpy(),
            position_error=None if errors is None else errors.position_error.numpy(),
            missed=None if errors is None else errors.miss_rate.numpy(),
        )


def _maps(
    model: ForwardModel[Any], images: Float[Tensor, "t c h w"]
) -> tuple[Float[np.ndarray, "s m y x"], Float[np.ndarray, "s m y x"]] | tuple[None, None]:
    if not isinstance(model, MapModel):
        return None, None
    before = [model.feature_maps(now) for now in _parts(images[:-1])]
    after = [
        model.moved_maps(now, following) for now, following in zip(_parts(images[:-1]), _parts(images[1:]), strict=True)
    ]
    return torch.cat(before).float().numpy(), torch.cat(after).float().numpy()


def _shift(model: ForwardModel[Any], images: Float[Tensor, "t c h w"]) -> Float[np.ndarray, "a s 2"] | None:
    if not isinstance(model, LatentActionModel) or not isinstance(model, ShiftModel):
        return None
    before = torch.cat([images[:1], images[:-2]])  # nothing is known of what was before the first
    latent = model.latent_action(before, images[:-1], images[1:])
    return np.stack([model.pixel_shift(part).float().numpy() for part in motions_of(model, latent).unbind(1)])
