"""check_model refuses what would else go unnoticed: a model that trains, and is wrong in another process or a plan."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Any, NamedTuple

import pytest
import torch
from sound_models import Reading, Recurrent, Sound, SoundVideo, begun_with, breaks
from torch import Tensor, nn

from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.model import Losses
from dmotion_bench.testing import check_model


@pytest.mark.parametrize("kind", [Recurrent, Reading])
def test_what_a_model_may_offer_besides_is_no_breach(kind: type) -> None:
    check_model(kind, size=16)


def _listed(self: Any) -> None:
    self.more = [nn.Conv2d(3, 3, 1)]


def _random(self: Any) -> None:
    self.frequency = torch.randn(3, 1, 1)


def _counted(self: Any, batch: Any) -> Losses:
    self.mean = getattr(self, "mean", 0.0) + float(batch.current.std())
    return Sound.losses(self, batch)


def _losses(**values: Any) -> Any:
    def losses(self: Any, batch: Any) -> Losses:
        found = Sound.losses(self, batch)
        for name, value in values.items():  # the shape checker, at work in these tests alone, would refuse them
            object.__setattr__(found, name, value(found.total))
        return found

    return losses


def _moves(batch: Any) -> Tensor:
    return (batch.next - batch.current).square().mean((1, 2, 3))


def _scaled(total: Tensor) -> Tensor:
    return total * (1 + random.random())


class _State(NamedTuple):
    hidden: Tensor


def _hides(self: Any, state: Any, action: Any) -> Any:
    self.hidden = Recurrent.advance(self, (self.hidden,), action)[0]
    return (self.hidden,)


def _begins_hidden(self: Any, previous: Any, current: Any) -> Any:
    (self.hidden,) = Recurrent.begin(self, previous, current)
    return (self.hidden,)


def _overwrites(self: Any, state: Any, action: Any) -> Any:
    after = Recurrent.advance(self, state, action)[0]
    return (after if self.training else state[0].copy_(after),)


@dataclass(frozen=True, kw_only=True)
class _Untyped:
    width: int = 0.5  # type: ignore[assignment]


@dataclass(frozen=True, kw_only=True)
class _Unknown:
    width: Nowhere = 4  # type: ignore[name-defined]


@dataclass(frozen=True, kw_only=True)
class _Training:
    width: int = 4
    learning_rate: float = 0.1


LOST = r"predict gives other frames once its weights are saved and loaded .*: layers in a list in nn.ModuleList"
BREACHES: dict[str, tuple[type, str]] = {
    "list of layers": (
        breaks(Sound, __init__=begun_with(_listed), predict=lambda self, *a: self.more[0](Sound.predict(self, *a))),
        LOST,
    ),
    "random numbers outside the state": (
        breaks(Sound, __init__=begun_with(_random), predict=lambda self, *a: Sound.predict(self, *a) * self.frequency),
        LOST,
    ),
    "learned number outside the state": (
        breaks(Sound, losses=_counted, predict=lambda self, *a: Sound.predict(self, *a) + getattr(self, "mean", 0)),
        LOST,
    ),
    "state in place": (breaks(Recurrent, advance=_overwrites), r"advance changes the state that it is given in place"),
    "state in the model": (
        breaks(Recurrent, begin=_begins_hidden, advance=_hides),
        r"advance goes on otherwise from the rows of an earlier state .*must be in its state, not in the model",
    ),
    "named state": (
        breaks(
            Recurrent,
            begin=lambda self, *a: _State(*Recurrent.begin(self, *a)),
            advance=lambda self, state, a: _State(*Recurrent.advance(self, (state.hidden,), a)),
        ),
        r"rows of an earlier state as a plain tuple, raised AttributeError: 'tuple' object has no attribute 'hidden'",
    ),
    "bare state": (
        breaks(
            Recurrent,
            begin=lambda self, *a: Recurrent.begin(self, *a)[0],
            advance=lambda self, state, a: Recurrent.advance(self, (state,), a)[0],
            frame=lambda self, state: Recurrent.frame(self, (state,)),
        ),
        r"a state is no tuple of tensors whose first axis is the batch",
    ),
    "branch": (
        breaks(
            Recurrent,
            branch=lambda self, state, parent, a: self.advance(
                (state[0][: len(parent)].repeat(2, 1, 1, 1)[: len(parent)],), a
            ),
        ),
        r"branch\(state, parent, action\) leads to other frames than advance of the parents' rows",
    ),
    "branch of latent actions": (
        breaks(
            Reading,
            branch_with_latent=lambda self, state, parent, z: Reading.branch_with_latent(self, state, parent * 0, z),
        ),
        r"branch_with_latent\(state, parent, latent\) leads to other frames than predict_with_latent",
    ),
    "pixels": (
        breaks(Recurrent, pixels=lambda self, state: 255 - Recurrent.pixels(self, state)),
        r"pixels\(state\) differs from the pixels of frame\(state\) by up to \d+",
    ),
    "pixels of another type": (
        breaks(Recurrent, pixels=lambda self, state: Recurrent.pixels(self, state).movedim(-1, 1)),
        r"pixels\(state\) gave the shape \(3, 3, 16, 16\), not uint8 of the shape \(3, 16, 16, 3\)",
    ),
    "features": (
        breaks(Recurrent, features=lambda self, state: state[0].mean()),
        r"features\(state\) gave the shape \(\), not a vector for each of 3 rows",
    ),
    "features of several axes": (
        breaks(Recurrent, features=lambda self, state: state[0]),
        r"features\(state\) gave the shape \(3, .*\), not a vector for each of 3 rows",
    ),
    "named actions": (
        breaks(Recurrent, infer_action=lambda self, *frames: torch.zeros(3, 1, dtype=torch.int64)),
        r"infer_action\(previous, current, following\) gave the shape \(3, 1\), not an action for each of 3 rows: the ",
    ),
    "chances in place of named actions": (
        breaks(Recurrent, infer_action=lambda self, *frames: torch.zeros(3)),
        r"infer_action\(previous, current, following\) gave the shape \(3,\), not an action for each of 3 rows",
    ),
    "codes": (
        breaks(Reading, codebook_sizes=(2,), chosen_codes=lambda self, *frames: torch.full((3, 1, 2), 2)),
        r"chosen_codes\(previous, current, following\) gave the codes 2 to 2 of codebook 0, which has 2",
    ),
    "codes of one codebook": (
        breaks(Reading, codebook_sizes=(2, 2), chosen_codes=lambda self, *frames: torch.zeros(3, 1, 1).long()),
        r"gave codes of the shape \(3, 1, 1\), not \(3, 2, codes of each codebook\)",
    ),
    "embedding": (
        breaks(Recurrent, embedding=lambda self, state: state[0] / 0),
        r"embedding\(state\) gave numbers that are not finite",
    ),
    "latent action": (
        breaks(Reading, latent_action=lambda self, *frames: Reading.latent_action(self, *frames)[0]),
        r"latent_action\(previous, current, following\) gave the shape \(3,\), not a vector for each of 3 rows",
    ),
    "latent action of several axes": (
        breaks(Reading, latent_action=lambda self, *frames: Reading.latent_action(self, *frames)[:, None]),
        r"latent_action\(previous, current, following\) gave the shape \(3, 1, 3\), not a vector for each of 3 rows",
    ),
    "prediction with a latent action": (
        breaks(Reading, predict_with_latent=lambda self, *a: Reading.predict_with_latent(self, *a)[..., :8]),
        r"predict_with_latent\(previous, current, latent\) gave the shape \(3, 3, 16, 8\)",
    ),
    "random numbers of the process": (
        breaks(SoundVideo, losses=lambda self, batch: Losses(total=_scaled(SoundVideo.losses(self, batch).total))),
        r"of two equal models differ after the same torch.manual_seed, in the phase 'train'; a run must repeat",
    ),
    "loss of what stands still": (
        breaks(
            Sound, losses=lambda self, batch: Losses(total=(Sound.losses(self, batch).total / _moves(batch)).mean())
        ),
        r"total is inf in the phase 'train' for triplets in which nothing moves",
    ),
    "gradient of what stands still": (
        breaks(
            Sound,
            losses=lambda self, batch: Losses(
                total=Sound.losses(self, batch).total + (self.layer.bias.mean() * _moves(batch)).square().sqrt().mean()
            ),
        ),
        r"a gradient is not finite in the phase 'train' for triplets in which nothing moves",
    ),
    "prediction of what stands still": (
        breaks(Sound, predict=lambda self, p, c, a: Sound.predict(self, p, c, a) / (c - p).norm(dim=1, keepdim=True)),
        r"not finite where both images are the same",
    ),
    "gradients in a prediction": (
        breaks(Sound, predict=lambda self, p, c, a: (self._next(p, c, a).mean().backward(), self._next(p, c, a))[1]),
        r"predict\(previous, current, action\) raised RuntimeError",
    ),
    "weights that each validation would begin anew": (
        breaks(Sound, enter=lambda self, phase: nn.init.zeros_(self.layer.bias)),
        r"enter\('train'\) changes layer.bias; it is called again on resuming and after each validation",
    ),
    "number as total": (
        breaks(Sound, losses=_losses(total=Tensor.item)),
        r"losses\(batch\).total is a float, not a tensor",
    ),
    "number as term": (
        breaks(Sound, losses=_losses(terms=lambda total: {"error": total.item()})),
        r"losses\(batch\).terms\['error'\] is a float, not a tensor",
    ),
    "list of terms": (
        breaks(Sound, losses=_losses(terms=lambda total: [total.detach()])),
        r"losses\(batch\).terms is a list, not a dictionary",
    ),
    "list of losses": (
        breaks(Sound, losses=_losses(per_triplet=lambda total: [total.item()] * 3)),
        r"losses\(batch\).per_triplet is a list, not a tensor",
    ),
    "another loss": (
        breaks(Sound, losses=_losses(terms=lambda total: {"loss": total.detach() * 2})),
        r"one of the terms of its losses is named 'loss'",
    ),
    "extra state": (
        breaks(Sound, get_extra_state=lambda self: {"step": 1}, set_extra_state=lambda self, state: None),
        r"its state_dict\(\) holds '_extra_state', a dict; a checkpoint holds tensors alone",
    ),
    "lazy layer": (
        breaks(Sound, __init__=begun_with(lambda self: setattr(self, "layer", nn.LazyConv2d(3, 3, padding=1)))),
        r"its weights 'layer.weight' have no shape before the first batch",
    ),
    "setting of another type": (
        breaks(Sound, Config=_Untyped),
        r"its Config does not survive JSON, .* \(a stored _Untyped cannot be read: width is 0.5\)",
    ),
    "setting of the training": (
        breaks(Sound, Config=_Training),
        r"its Config has fields of TrainingConfig \(learning_rate\), so '--set' would not reach the training's",
    ),
    "setting of no type": (
        breaks(Sound, Config=_Unknown),
        r"does not survive JSON, .* \(the types of the fields of _Unknown .* 'Nowhere' is not defined; import it",
    ),
}


@pytest.mark.filterwarnings("ignore:Lazy modules")
@pytest.mark.parametrize("name", BREACHES)
def test_every_silent_breach_is_said(name: str) -> None:
    kind, sentence = BREACHES[name]
    with pytest.raises(ModelContractBroken, match=sentence):
        check_model(kind, size=16)


def test_a_buffer_may_hold_no_numbers_until_the_model_is_aligned() -> None:
    empty = begun_with(lambda self: self.register_buffer("known", torch.full((2,), torch.nan)))
    check_model(breaks(Sound, __init__=empty), size=16)
