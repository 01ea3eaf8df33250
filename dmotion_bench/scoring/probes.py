"""What a latent action holds: probes that read true factors from it, each beside a control.

A linear and a small non-linear probe are fitted to each factor (``true_factors.py``) on some episodes and asked on the
others, so no episode is in its own fit. Each has a control (Hewitt and Liang 2019): the same probe on the same latents,
with the factor's values shuffled among the triplets. What the control reaches is chance.

=============  ==========================================================================================
linear         discriminant analysis for names, a ridge regression with leave-one-out penalty for numbers
mlp            one hidden layer of 32; it begins as the mean, or the classes' shares, and ends where the loss on other
               episodes than those it is fitted on was least. So a latent that tells nothing leaves it at chance. Of
               two episodes in all, other rows of the same one say where it ends
=============  ==========================================================================================

A score is 1 - sum of errors / sum of wholes, over all triplets. For names an error is 0 or 1 and a whole is 1: the
score is the accuracy. For numbers they are squared distances, from the truth to what was read and to the mean, each
number in units of its standard deviation: the score is R^2, the mean of that of the factor's numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from dmotion_bench.learning.action_to_latent import ridge
from dmotion_bench.scoring.statistics import EpisodeBootstrap, Estimate

PROBES: Final = ("linear", "mlp")
SHUFFLED: Final = "_shuffled"
"""After the name of a probe: its control."""

WIDTH: Final = 2 * (1 + len(PROBES))
"""Numbers that ``probe`` gives for each triplet: a whole and the error of each probe, then the same of the controls."""

FOLDS: Final = 5
MOST_PROBED: Final = 2000  # triplets, evenly spread: more make no figure surer than its episodes allow
LEAST_VARIANCE: Final = 1e-6  # within a class, of the whole variance: keeps the discriminant's covariance invertible
_HIDDEN: Final = 32
_PASSES: Final = 40  # over the rows that a small network is fitted on, in at most _MOST_STEPS
_MOST_STEPS: Final = 200
_LOOKS: Final = 10  # at the rows that say when it has learnt enough
_BATCH: Final = 64
_RATE: Final = 0.02
_LONGEST: Final = 8.0  # standard deviations from the mean that an input of the small network may have


@dataclass(frozen=True, kw_only=True)
class Factor:
    """What is true of each triplet, and may stand in a latent action.

    Attributes:
        names: The number of a name, such as that of a discrete action; None for numbers.
        numbers: Numbers, such as a displacement; rows with NaN are left out.
    """

    names: Int[np.ndarray, " n"] | None = None
    numbers: Float[np.ndarray, "n d"] | None = None


def probe(
    latent: Float[np.ndarray, "n l"], factors: Mapping[str, Factor], episode: Shaped[np.ndarray, " n"]
) -> dict[str, Float[np.ndarray, "n 6"]]:
    """``WIDTH`` numbers for each triplet, by the factor's name; NaN where no probe was asked.

    Factors that never change are left out, and all of them where there is one episode alone.
    """
    rows = np.unique(np.linspace(0, len(latent) - 1, min(len(latent), MOST_PROBED)).round().astype(np.int64))
    fold = np.unique(episode[rows], return_inverse=True)[1] % FOLDS
    asked = {name: _target(factor, rows) for name, factor in factors.items()}
    known = {name: target for name, target in asked.items() if target is not None}
    if len(np.unique(fold)) < 2 or not known:
        return {}
    inputs = _standardised(latent[rows])
    targets = [one for target in known.values() for one in (target, target.shuffled())]
    with torch.inference_mode(False):  # scoring is within it, and its tensors cannot be trained with
        small = _small_networks(inputs, targets, fold)
    found = {}
    for number, name in enumerate(known):
        columns = np.full((len(latent), WIDTH), np.nan)
        columns[rows] = np.stack(
            [
                one
                for place in (2 * number, 2 * number + 1)
                for target in (targets[place],)
                for one in (target.whole, target.error(_linear(inputs, target, fold)), target.error(small[place]))
            ],
            axis=1,
        )
        found[name] = columns
    return found


def probe_scores(columns: Float[np.ndarray, "n 6"], bootstrap: EpisodeBootstrap) -> dict[str, Estimate]:
    """The score of each probe and control, from what ``probe`` gave for a factor.

    Its std is that of the triplets' parts in it.
    """
    columns = np.where(np.isfinite(columns).all(axis=1)[:, None], columns, np.nan)
    found = {}
    for whole, suffix in ((0, ""), (1 + len(PROBES), SHUFFLED)):
        for number, name in enumerate(PROBES):
            score = bootstrap.explained(columns[:, whole + 1 + number], columns[:, whole])
            if score is not None:
                found[name + suffix] = score
    return found


def beyond_actions(numbers: Float[np.ndarray, "n d"], action: Shaped[np.ndarray, "n *a"]) -> Float[np.ndarray, "n d"]:
    """What the action does not tell of some numbers: their distance from the mean of its class, or from a line.

    Args:
        numbers: NaN in rows that are not known.
        action: Numbers of discrete actions, or continuous ones.
    """
    known = np.isfinite(numbers).all(axis=1)
    left = np.full(numbers.shape, np.nan)
    if not known.any():
        return left
    if action.ndim == 1:
        for one in np.unique(action[known]):
            rows = known & (action == one)
            left[rows] = numbers[rows] - numbers[rows].mean(0)
        return left
    inputs, wanted = (torch.from_numpy(np.asarray(one[known], np.float64)) for one in (action, numbers))
    found = ridge(inputs, wanted)
    left[known] = (wanted - found[0] - inputs @ found[1:]).numpy()
    return left


@dataclass(frozen=True, kw_only=True)
class _Target:
    """What the probes of one factor are to read.

    Attributes:
        there: Which rows have it.
        names: Classes from 0 on; None for numbers.
        values: Numbers in units of their standard deviations, or classes as one of them 1 and the others 0.
    """

    there: Bool[np.ndarray, " m"]
    names: Int[np.ndarray, " m"] | None
    values: Float[np.ndarray, "m d"]

    @property
    def whole(self) -> Float[np.ndarray, " m"]:
        whole = np.ones(len(self.values)) if self.names is not None else (self.values**2).mean(1)
        return np.where(self.there, whole, np.nan)

    def error(self, read: Float[np.ndarray, "m d"]) -> Float[np.ndarray, " m"]:
        """Of what a probe read: numbers, or how much speaks for each class."""
        if self.names is None:
            error = ((read - self.values) ** 2).mean(1)
        else:
            error = (read.argmax(1) != self.names).astype(np.float64)
        return np.where(self.there & np.isfinite(read).all(axis=1), error, np.nan)

    def shuffled(self) -> _Target:
        """The same values at other rows."""
        rows = np.flatnonzero(self.there)
        order = np.arange(len(self.there))
        order[rows] = np.random.default_rng(0).permutation(rows)
        names = None if self.names is None else self.names[order]
        return _Target(there=self.there, names=names, values=self.values[order])


def _target(factor: Factor, rows: Int[np.ndarray, " m"]) -> _Target | None:
    """None where there is nothing to read."""
    if factor.names is not None:
        known, names = np.unique(factor.names[rows], return_inverse=True)
        if len(known) < 2:
            return None
        return _Target(there=np.ones(len(rows), np.bool_), names=names, values=np.eye(len(known))[names])
    assert factor.numbers is not None, "a factor is of one of the two kinds"
    values = factor.numbers[rows].astype(np.float64)
    there = np.isfinite(values).all(axis=1)
    if there.sum() < 2:
        return None
    mean, scale = values[there].mean(0), values[there].std(0)
    varying = scale > 1e-9 * np.maximum(1.0, np.abs(mean))
    if not varying.any():
        return None
    values = np.where(there[:, None], (values - mean) / np.where(varying, scale, 1), 0.0)[:, varying]
    return _Target(there=there, names=None, values=values)


def _standardised(latent: Float[np.ndarray, "m l"]) -> Float[np.ndarray, "m l"]:
    latent = latent.astype(np.float64)
    scale = latent.std(0)
    return np.asarray((latent - latent.mean(0)) / np.where(scale > 0, scale, 1))


def _linear(inputs: Float[np.ndarray, "m l"], target: _Target, fold: Int[np.ndarray, " m"]) -> Float[np.ndarray, "m d"]:
    """What the linear probe reads of each row; NaN where it had nothing to be fitted on."""
    read = np.full(target.values.shape, np.nan)
    for one in np.unique(fold):
        fitted, held = target.there & (fold != one), fold == one
        if not fitted.any():
            continue
        if target.names is not None:
            read[held] = _nearness(inputs[fitted], target.names[fitted], inputs[held], target.values.shape[1])
        else:
            found = ridge(torch.from_numpy(inputs[fitted]), torch.from_numpy(target.values[fitted])).numpy()
            read[held] = found[0] + inputs[held] @ found[1:]
    return read


def _nearness(
    known: Float[np.ndarray, "n l"], names: Int[np.ndarray, " n"], asked: Float[np.ndarray, "m l"], classes: int
) -> Float[np.ndarray, "m c"]:
    """How near each row is to the mean of each class, in units of the covariance that the classes share."""
    there = np.unique(names)
    means = np.stack([known[names == one].mean(0) for one in there])
    residual = known - means[np.searchsorted(there, names)]
    covariance = residual.T @ residual / len(known) + LEAST_VARIANCE * np.eye(known.shape[1])
    root = np.linalg.cholesky(covariance)
    own, middles = (np.linalg.solve(root, one.T).T for one in (asked, means))
    near = np.full((len(asked), classes), -1e9)  # a class that no fitted row has is never read
    near[:, there] = -((own[:, None] - middles[None]) ** 2).sum(-1)
    return near


def _small_networks(
    inputs: Float[np.ndarray, "m l"], targets: Sequence[_Target], fold: Int[np.ndarray, " m"]
) -> list[Float[np.ndarray, "m d"]]:
    """What a network of one hidden layer for each target reads of each row; all are trained beside each other."""
    wide = max(one.values.shape[1] for one in targets)
    wanted = np.zeros((len(targets), len(inputs), wide))
    for number, one in enumerate(targets):
        wanted[number, :, : one.values.shape[1]] = one.values
    networks = _Networks(
        inputs=torch.from_numpy(np.clip(inputs, -_LONGEST, _LONGEST)),
        wanted=torch.from_numpy(wanted),
        used=torch.from_numpy(np.stack([one.there for one in targets])).double(),
        widths=[one.values.shape[1] for one in targets],
        are_names=torch.tensor([one.names is not None for one in targets]),
    )
    read = np.full((len(targets), len(inputs), wide), np.nan)
    folds = np.unique(fold)
    for place, one in enumerate(folds):
        held = fold == one
        looked = fold == folds[(place + 1) % len(folds)] if len(folds) > 2 else ~held & (np.arange(len(fold)) % 5 == 0)
        fitted = ~held & ~looked
        if fitted.any() and looked.any():
            read[:, held] = networks.trained(*map(np.flatnonzero, (fitted, looked, held)))
    return [read[number, :, : one.values.shape[1]] for number, one in enumerate(targets)]


@dataclass(frozen=True, kw_only=True)
class _Networks:
    """Small networks, one for each target, in one batch of matrix products.

    In double precision: what rounding differs in, between processors, does not grow into a figure.

    Attributes:
        inputs: The same of all.
        wanted: What each is to say; zeros beyond its own width.
        used: 1 for rows that a target has.
        widths: Numbers that each target has.
        are_names: Which targets are classes.
    """

    inputs: Float[Tensor, "m l"]
    wanted: Float[Tensor, "k m d"]
    used: Float[Tensor, "k m"]
    widths: Sequence[int]
    are_names: Bool[Tensor, " k"]

    def trained(
        self, fitted: Int[np.ndarray, " f"], looked: Int[np.ndarray, " v"], held: Int[np.ndarray, " h"]
    ) -> Float[np.ndarray, "k h d"]:
        """What they say of ``held`` after a training on ``fitted``, as they were when ``looked`` was read best."""
        generator = torch.Generator().manual_seed(0)
        count, _, wide = self.wanted.shape
        length = self.inputs.shape[1]
        with torch.enable_grad(), torch.autocast("cpu", enabled=False):
            first = torch.randn(length, count * _HIDDEN, generator=generator, dtype=torch.float64) / length**0.5
            second = torch.zeros(count, _HIDDEN, wide, dtype=torch.float64)
            bias = torch.randn(count * _HIDDEN, generator=generator, dtype=torch.float64)
            weights = [first, bias, second, self._start(fitted)]
            weights = [one.requires_grad_() for one in weights]
            optimizer = torch.optim.Adam(weights, lr=_RATE)
            best = torch.full((count,), torch.inf, dtype=torch.float64)
            kept = torch.zeros(count, len(held), wide, dtype=torch.float64)
            steps = _LOOKS * round(min(max(2.0, _PASSES * len(fitted) / _BATCH / _LOOKS), _MOST_STEPS / _LOOKS))
            for step in range(steps + 1):
                if step % (steps // _LOOKS) == 0:
                    with torch.no_grad():
                        loss, said = self._losses(weights, looked), self._say(weights, held)
                    better = loss < best
                    best, kept = loss.where(better, best), said.where(better[:, None, None], kept)
                rows = torch.randint(len(fitted), (_BATCH,), generator=generator).numpy()
                for group in optimizer.param_groups:
                    group["lr"] = _RATE * (1 - step / (steps + 1))
                optimizer.zero_grad()
                self._losses(weights, fitted[rows]).sum().backward()  # type: ignore[no-untyped-call]
                optimizer.step()
        return np.asarray(kept.numpy())

    def _start(self, fitted: Int[np.ndarray, " f"]) -> Float[Tensor, "k 1 d"]:
        """The mean of numbers, the logarithm of the share of names: what is said of any row before the training."""
        used = self.used[:, fitted, None]
        mean = (self.wanted[:, fitted] * used).sum(1, keepdim=True) / used.sum(1, keepdim=True).clamp(min=1)
        return mean.clamp(min=1e-4).log().where(self.are_names[:, None, None], mean)

    def _say(self, weights: Sequence[Tensor], rows: Int[np.ndarray, " r"]) -> Float[Tensor, "k r d"]:
        first, bias, second, last = weights
        hidden = torch.tanh(self.inputs[rows] @ first + bias).reshape(len(rows), -1, _HIDDEN).transpose(0, 1)
        said: Tensor = hidden @ second + last
        inside = torch.arange(said.shape[2]) < torch.tensor(self.widths)[:, None]
        return said.where(inside[:, None], torch.where(self.are_names, -1e9, 0.0)[:, None, None])

    def _losses(self, weights: Sequence[Tensor], rows: Int[np.ndarray, " r"]) -> Float[Tensor, " k"]:
        """The mean loss of each network over its rows: cross-entropy of names, squared error of numbers."""
        said, wanted, used = self._say(weights, rows), self.wanted[:, rows], self.used[:, rows]
        surprise = -(F.log_softmax(said, dim=2).clamp(min=-1e4) * wanted).sum(2)
        missed = (said - wanted).square().sum(2)
        loss = surprise.where(self.are_names[:, None], missed)
        return (loss * used).sum(1) / used.sum(1).clamp(min=1)
