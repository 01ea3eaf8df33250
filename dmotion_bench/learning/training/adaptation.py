"""What demonstrations change in a model of video: its table alone, the table by way of clusters, or all of it.

Fine-tuning trains all of the model on the demonstrations, end to end, after its table of averaged latent actions.

AdaWorld (Gao et al. 2025, section 3.3) compares two ways to tell a latent-action model what real actions are: the
average latent action of each one's demonstrations, and the same followed by training on the demonstrations. Here the
first is ``ForwardModel.align``, and the second begins where the first ends: Adam minimises the squared error of the
predicted frame over all parameters and the rows of the table, whatever the model.

Few labelled transitions are soon learned by heart. Of 8 or more an eighth is therefore left out, of the averaging too,
and says after how many steps the model predicts best. None at all is among the answers; the averages are then those of
all demonstrations. Of fewer than 8 all are trained on for the whole number of steps.
"""

from __future__ import annotations

import math
from typing import Any, Final

import torch
import torch.nn.functional as F
from jaxtyping import Int
from torch import Tensor

from dmotion_bench.errors import RunError
from dmotion_bench.learning.action_to_latent import tables_of
from dmotion_bench.learning.data.curriculum import TrainingData
from dmotion_bench.learning.data.labels import HELD_BACK
from dmotion_bench.learning.data.triplets import BatchOrder
from dmotion_bench.learning.demonstrations import Demonstrations
from dmotion_bench.learning.hardware.precision import Precision, autocast
from dmotion_bench.learning.model import ForwardModel, TrainingConfig
from dmotion_bench.learning.runs.manifest import RunSpec
from dmotion_bench.learning.training.clustering import cluster, require_clusters

CHECKS: Final = 10
"""How often the transitions that are left out are predicted."""
AT_ONCE: Final = 64


def require_adaptable(model: ForwardModel[Any], config: TrainingConfig) -> None:
    """Refuse a model that cannot be adapted as the config asks.

    Raises:
        UsageError: As of ``require_clusters``.
    """
    if config.adaptation == "clustered":
        require_clusters(model)


def adapt(
    model: ForwardModel[Any],
    shown: Demonstrations,
    data: TrainingData,
    spec: RunSpec,
    precision: Precision,
    device: torch.device,
) -> int | None:
    """Teach a trained model its actions by demonstrations, as its run's ``adaptation`` says.

    Args:
        model: In evaluation mode.
        shown: The demonstrations.
        data: Of the training, whose video says where clusters lie.
        spec: Of the run.
        precision: As for ``finetune``.
        device: Of the model.

    Returns:
        The steps of a fine-tuning that were kept; None where there was none.

    Raises:
        RunError: A fine-tuning diverged.
    """
    config = spec.training_config
    if config.adaptation == "finetuned":
        return finetune(model, shown, config, spec.seed, precision)
    _align(model, shown)
    if config.adaptation == "clustered":
        cluster(model, data, device)
    return None


def finetune(
    model: ForwardModel[Any], shown: Demonstrations, config: TrainingConfig, seed: int, precision: Precision
) -> int:
    """Train a model on demonstrations; it stays in evaluation mode, so that nothing of it is random.

    Args:
        model: As its training on video left it.
        shown: What it learns from.
        config: How long, how fast, and in which batches.
        seed: Of the order, and of what is left out.
        precision: In which matrices are multiplied.

    Returns:
        The number of steps that were kept.

    Raises:
        RunError: It diverged, and no transitions were left out that could have said when to stop.
    """
    order = torch.randperm(len(shown), generator=torch.Generator().manual_seed(seed))
    held, learned = order.tensor_split([len(shown) // HELD_BACK])
    _align(model, shown.part(learned) if len(held) else shown)
    tables = [table.rows for table in tables_of(model)]
    trained = [*model.parameters(), *tables]
    for tensor in trained:
        tensor.requires_grad_(True)
    optimizer = torch.optim.Adam(trained, config.adaptation_rate)
    batches = BatchOrder(len(learned), config.batch_size, seed)
    best, kept, state = _error(model, shown, held), 0, _copied(model)
    for step in range(1, config.adaptation_steps + 1):
        batch = _images_of(shown, learned[torch.from_numpy(batches.batch(step - 1))])
        with autocast(precision, batch.action.device):
            error = F.mse_loss(model.predict(batch.previous, batch.current, batch.action), batch.next)
        optimizer.zero_grad()
        error.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        is_last = step == config.adaptation_steps
        if len(held) and (is_last or step % max(1, config.adaptation_steps // CHECKS) == 0):
            if (now := _error(model, shown, held)) < best:
                best, kept, state = now, step, _copied(model)
        elif is_last:
            if not math.isfinite(now := _error(model, shown, learned)):
                raise RunError(
                    f"the fine-tuning diverged within its {step} steps: the error on its demonstrations is {now}. Try "
                    "a lower rate, such as --set adaptation_rate=0.00001, in a new run (--out DIR)."
                )
            kept, state = step, _copied(model)
    for table in tables:
        table.requires_grad_(False)
    model.load_state_dict(state)
    if kept == 0:
        _align(model, shown)
    return kept


@torch.no_grad()
def _align(model: ForwardModel[Any], shown: Demonstrations) -> None:
    model.align(shown)


def _copied(model: ForwardModel[Any]) -> dict[str, Tensor]:
    return {name: tensor.detach().clone() for name, tensor in model.state_dict().items()}


def _images_of(shown: Demonstrations, rows: Int[Tensor, " m"]) -> Demonstrations:
    """Some demonstrations in memory; there may be more of them than it holds as images."""
    # the second choice closes the gaps that stored triplets leave between images: rounding depends on the strides
    return shown.subset(rows).subset(torch.arange(len(rows)))


@torch.no_grad()
def _error(model: ForwardModel[Any], shown: Demonstrations, rows: Int[Tensor, " m"]) -> float:
    """The mean squared error of the frames predicted for some demonstrations; 0 of none."""
    if not len(rows):
        return 0.0
    errors = []
    for start in range(0, len(rows), AT_ONCE):
        some = _images_of(shown, rows[start : start + AT_ONCE])
        predicted = model.predict(some.previous, some.current, some.action)
        errors.append((predicted - some.next).square().mean((1, 2, 3)))
    return float(torch.cat(errors).mean())
