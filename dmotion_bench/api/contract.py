"""What somebody's own model breaks of its contract, asked before a training begins and said where one fails."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterable, Iterator, Mapping

from dmotion_bench.entry_points import MODELS, is_built_in
from dmotion_bench.errors import DmbenchError, ModelContractBroken
from dmotion_bench.learning.hardware.precision import may_use_bf16
from dmotion_bench.learning.runs.run import Run, RunSpec
from dmotion_bench.learning.runs.start import TrainingRequest, open_run
from dmotion_bench.learning.settings import from_json
from dmotion_bench.learning.training.table import Outcome, RowResult, TableJob, train_rows
from dmotion_bench.planning.contract import using
from dmotion_bench.registry import model_class
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.testing import check_before_training
from dmotion_bench.testing.declaration import check_class, check_settings
from dmotion_bench.workspace import Workspace


def breach_before(run: Run) -> ModelContractBroken | None:
    """In which way the model of a training that is to begin breaks its contract.

    Found in seconds, where a training may fail after hours. The tests of this project keep its own models to theirs,
    and what goes on was asked when it began.
    """
    if run.last.exists() or is_built_in(MODELS, run.spec.model):
        return None
    return _breach(run.spec)


def breaches_before(
    asked: Iterable[tuple[TrainingRequest, Dataset]], workspace: Workspace
) -> dict[str, ModelContractBroken]:
    """As ``breach_before``, of many trainings that others are to do; by the name of the model.

    Label budgets and seeds change nothing of it: each model is tried once for every kind of frames, actions and
    settings. A request that cannot be opened is left to whoever trains it, who says why.
    """
    tried: list[tuple[object, ...]] = []
    found: dict[str, ModelContractBroken] = {}
    for request, dataset in asked:
        if is_built_in(MODELS, request.model):
            continue
        with contextlib.suppress(Exception):  # a stranger's class may raise anything where it is configured
            run = open_run(request, dataset, None, workspace)
            spec = run.spec
            trial = (spec.model, spec.arch, spec.inputs, spec.config, spec.training_config.precision)
            if run.result is None and trial not in tried:
                tried.append(trial)
                if (breach := breach_before(run)) is not None:
                    found.setdefault(spec.model, breach)
    return found


def _breach(spec: RunSpec) -> ModelContractBroken | None:
    kind = model_class(spec.model)
    try:
        bf16 = may_use_bf16(spec.training_config.precision)
        check_before_training(kind, spec.arch, spec.inputs, from_json(kind.Config, spec.config), bf16=bf16)
    except ModelContractBroken as error:
        return error
    return None


def begins_all_the_same(breach: ModelContractBroken) -> str:
    """The warning of a training that begins with a breach."""
    return f"{breach} The training begins all the same."


def train_rows_explained(job: TableJob) -> list[RowResult]:
    """As ``train_rows``, where others do it: a failure names the line of somebody's own model, as in this process."""
    return train_rows(job, lambda run: explaining(run.spec.model, None))


def with_breach(outcome: Outcome, breaches: Mapping[str, ModelContractBroken]) -> Outcome:
    """The outcome of a training that others did; if it failed, with what its model breaks of the contract."""
    if outcome.error is None or outcome.busy or (breach := breaches.get(outcome.row.model)) is None:
        return outcome
    return dataclasses.replace(outcome, error=_failed_after(breach, outcome.error))


def _failed_after(breach: ModelContractBroken, error: str) -> str:
    return f"the training failed: {error.rstrip('.')}. Before it began: {breach}"


@contextlib.contextmanager
def explaining(model: str, breach: ModelContractBroken | None) -> Iterator[None]:
    """Say of a training that fails which line of somebody's own model raised, and whether it breaks the contract.

    Raises:
        ModelContractBroken: The model is to blame.
    """
    naming = contextlib.nullcontext() if is_built_in(MODELS, model) else using(model_class(model))
    try:
        with naming:
            yield
    except ModelContractBroken as error:
        if breach is None:
            raise
        raise ModelContractBroken(_failed_after(breach, str(error))) from error
    except DmbenchError:
        raise
    except Exception as error:
        if breach is None or isinstance(error, MemoryError):
            raise
        told = (
            f"the training failed ({type(error).__name__}: {str(error).rstrip('.')}), and its model breaks the contract"
        )
        raise ModelContractBroken(f"{told}: {breach}") from error


@contextlib.contextmanager
def explaining_settings(model: str) -> Iterator[None]:
    """Say of a request that fails that the model's class declares something wrong, if it does.

    Raises:
        ModelContractBroken: It does.
    """
    try:
        yield
    except DmbenchError:
        raise
    except Exception:
        kind = model_class(model)
        check_class(kind)
        check_settings(kind)
        raise
