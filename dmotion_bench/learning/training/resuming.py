"""The content of a training's checkpoints, and the checks before resuming from them."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.model import ForwardModel, TrainingConfig
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.checkpoint import Form, Forms, damaged
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.settings import from_json
from dmotion_bench.learning.training.optimizer import AveragedWeights, has_own_optimizer, named_optimizer, optimizer_of

LARGEST_ROW: Final = checkpoint.LARGEST_FACTS // 2
"""Characters of the terms of a row that a checkpoint holds."""


@dataclass(kw_only=True)
class NextRow:
    """What was measured since the last row of ``metrics.jsonl``: a training that goes on writes the same next row.

    Attributes:
        sums: Of each term over the steps.
        steps: How many.
    """

    sums: dict[str, float] = field(default_factory=dict)
    steps: int = 0

    def __post_init__(self) -> None:
        if self.steps < 0 or not all(type(total) in (int, float) for total in self.sums.values()):
            raise InvalidSetting("its sums cannot be.")

    def add(self, terms: Mapping[str, float], weight: float) -> None:
        """Count a step; ``weight`` is that of its terms in their mean over all processes."""
        for name, value in terms.items():
            self.sums[name] = self.sums.get(name, 0.0) + value * weight
        self.steps += 1

    @property
    def is_kept(self) -> bool:
        """Whether a checkpoint can hold it: its numbers are finite, and there are not too many."""
        return all(map(math.isfinite, self.sums.values())) and len(json.dumps(self.sums)) <= LARGEST_ROW


@dataclass(frozen=True, kw_only=True)
class LastFacts:
    """The facts beside the tensors of ``last.safetensors``.

    Attributes:
        step: Steps taken.
        best: Lowest validation loss of the phase; None before there is one.
        best_step: Where it was.
        seconds: Spent in steps.
        ended: Where phases ended early, by their names.
        row: What the next row of the log has so far: an equal share, where several processes share the batches.
    """

    step: int
    best: float | None
    best_step: int
    seconds: float
    ended: Mapping[str, int] = field(default_factory=dict)
    row: NextRow = field(default_factory=NextRow)

    def __post_init__(self) -> None:
        if not -1 <= self.best_step <= self.step or not 0 <= self.seconds < math.inf:
            raise InvalidSetting("its numbers cannot be.")
        if not all(type(step) is int and 0 < step < self.step for step in self.ended.values()):
            raise InvalidSetting("a phase cannot have ended there.")


@dataclass(frozen=True, kw_only=True)
class BestFacts:
    """Beside the tensors of ``best.safetensors``: where the weights are from, and how good they are."""

    step: int
    validation_loss: float


FactsT = TypeVar("FactsT", LastFacts, BestFacts)


def _facts(kind: type[FactsT], facts: Mapping[str, Any], path: Path, steps: int) -> FactsT:
    """The facts of a checkpoint.

    Args:
        kind: What is expected.
        facts: As they were read.
        path: Of the checkpoint.
        steps: Of the whole training.

    Raises:
        RunCorrupt: They lack something or cannot be.
    """
    try:
        read = from_json(kind, facts)
    except InvalidSetting as error:
        raise damaged(path, f"cannot be read: {str(error).rstrip('.')}") from None
    if not 0 <= read.step <= steps:
        raise damaged(path, f"cannot be read: it is of step {read.step}, and the training has {steps}")
    return read


def optimizer_forms(
    optimizer: torch.optim.Optimizer, model: ForwardModel[Any], config: TrainingConfig
) -> tuple[dict[str, Form], set[str]]:
    """The tensors of an optimiser's state once it has taken a step, and the names of those that stand for numbers.

    A second optimiser of the same kind takes that step: over parameters of one number each or, if it is the model's
    own, whose groups may depend on the model, over those of a copy.
    """
    own = has_own_optimizer(model)
    if own:
        copied = copy.deepcopy(model)
        for parameter in copied.parameters():
            parameter.grad = torch.zeros_like(parameter)
        twin = optimizer_of(copied, config)
    else:
        twin = named_optimizer(nn.ParameterList(_small(parameter) for parameter in model.parameters()), config)
    twin.step()
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    forms, numbers = dict[str, Form](), set[str]()
    for index, state in twin.state_dict()["state"].items():
        for key, value in state.items():
            name, kept, weights = f"optimizer/{index}/{key}", checkpoint.state_tensor(value), parameters[index]
            # of small stand-ins only the number of axes says whether it is one number or one for each weight
            like = kept if own or kept.ndim != weights.ndim else weights
            forms[name] = Form(Form.of(kept).dtype, tuple(like.shape))
            if not torch.is_tensor(value):
                numbers.add(name)
    return forms, numbers


def _small(parameter: nn.Parameter) -> nn.Parameter:
    """A small stand-in for a parameter, which an optimiser treats alike: same type, number of axes and marks."""
    small = nn.Parameter(torch.zeros((1,) * parameter.ndim, dtype=parameter.dtype))
    small.__dict__.update(vars(parameter))
    small.grad = torch.zeros_like(small)
    return small


def _require_whole_states(found: Iterable[str], forms: Forms, path: Path) -> None:
    """Refuse an optimiser's state that lacks a part; parameters that were never trained have none at all.

    Raises:
        RunCorrupt: A parameter has one part of its state and lacks another.
    """
    there = {name for name in found if name in forms}
    begun = {name.rpartition("/")[0] for name in there}
    for name in forms:
        if name.rpartition("/")[0] in begun and name not in there:
            raise damaged(path, f"holds other tensors than the training has: there is no {name!r}")


@dataclass(frozen=True, kw_only=True)
class Checkpoints:
    """Saves the changing state of a training in checkpoints, and restores it.

    Attributes:
        run: Whose folder they are in.
        model, optimizer, average: Of the training.
        hardness: Latest loss of each triplet, by phase.
        config: How the model is optimised.
        steps: Of the whole training.
        starts: Steps at which a phase begins: there are no best weights of that phase yet.
    """

    run: Run
    model: ForwardModel[Any]
    optimizer: torch.optim.Optimizer
    average: AveragedWeights | None
    hardness: Mapping[str, Float[np.ndarray, " n"]]
    config: TrainingConfig
    steps: int
    starts: frozenset[int]

    def save_best(self, facts: BestFacts) -> None:
        """Keep the model's weights as the best so far."""
        weights = checkpoint.with_prefix("model", self.model.state_dict())
        checkpoint.save(self.run.best, weights, dataclasses.asdict(facts))

    def restore_best(self, path: Path | None = None) -> BestFacts:
        """Put the best weights into the model.

        Args:
            path: Where they are, if not in the usual place.

        Raises:
            RunMissing, RunCorrupt: They are not there, or cannot be read.
        """
        tensors, facts = self._load_best(path)
        self.model.load_state_dict(checkpoint.without_prefix("model", tensors))
        return facts

    def save(self, path: Path, facts: LastFacts, begun: Iterable[str]) -> None:
        """Write all that going on needs; of the phases that have begun, what each triplet's loss was."""
        tensors = checkpoint.with_prefix("model", self.model.state_dict())
        tensors |= checkpoint.optimizer_tensors(self.optimizer)
        if self.average is not None:
            tensors |= checkpoint.with_prefix("average", self.average.tensors)
        tensors |= {f"hardness/{name}": torch.from_numpy(self.hardness[name]) for name in begun}
        checkpoint.save(path, tensors, dataclasses.asdict(facts))

    def restore(self) -> LastFacts | None:
        """Restore the last checkpoint, if there is one, and check that the best weights exist.

        Raises:
            RunMissing, RunCorrupt: The best weights are gone, or one of the two cannot be read or is of other steps.
        """
        path = self.run.last
        if not path.exists():
            return None
        state, numbers = optimizer_forms(self.optimizer, self.model, self.config)
        required = self._forms("model") | (self._forms("average") if self.average else {})
        hardness = {f"hardness/{name}": Form("F32", values.shape) for name, values in self.hardness.items()}
        tensors, read = checkpoint.load(path, required=required, optional=state | hardness)
        facts = _facts(LastFacts, read, path, self.steps)
        _require_whole_states(tensors, state, path)
        is_known = facts.best is not None and facts.step not in self.starts
        if is_known and self._load_best()[1].step < facts.best_step:
            raise damaged(self.run.best, f"is older than step {facts.best_step}, the best that {path.name!r} knows of")
        self.model.load_state_dict(checkpoint.without_prefix("model", tensors))
        checkpoint.restore_optimizer(self.optimizer, tensors, numbers)
        if self.average is not None:
            self.average.restore(checkpoint.without_prefix("average", tensors))
        for name, values in checkpoint.without_prefix("hardness", tensors).items():
            self.hardness[name][:] = values.numpy()
        return facts

    def _load_best(self, path: Path | None = None) -> tuple[dict[str, Tensor], BestFacts]:
        path = path or self.run.best
        tensors, facts = checkpoint.load(path, required=self._forms("model"))
        return tensors, _facts(BestFacts, facts, path, self.steps)

    def _forms(self, prefix: str) -> dict[str, Form]:
        return checkpoint.with_prefix(prefix, checkpoint.forms_of(self.model.state_dict()))
