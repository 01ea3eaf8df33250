"""The training loop: one for every model, on the CPU, a GPU, or in several processes on one machine or more.

What a run computes is a function of its spec, its data and its conditions (threads and precision), which are recorded
before the first step. The order of the triplets and the random numbers of a step are functions of (seed, step), so a
run that was killed and resumed ends with the same bits on the CPU as one that never stopped.

Several processes compute a part of each batch each, and average their gradients (DDP of lightning-fabric). The batches
are those of a single process, and so is the checkpoint: a run may go on with another number of processes.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import torch

from dmotion_bench.errors import UsageError
from dmotion_bench.interrupts import stop_between_steps
from dmotion_bench.learning.data.curriculum import Part, TrainingData, demonstrations_of, parts_of, steps_before_labels
from dmotion_bench.learning.hardware.fabric_setup import set_up
from dmotion_bench.learning.hardware.threads import using_threads
from dmotion_bench.learning.model import TrainingConfig
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.manifest import Conditions, RunResult
from dmotion_bench.learning.runs.run import SAMPLES, Run
from dmotion_bench.learning.training.adaptation import adapt, require_adaptable
from dmotion_bench.learning.training.companions import Companions
from dmotion_bench.learning.training.conditions import choose_conditions
from dmotion_bench.learning.training.hardness import Hardness
from dmotion_bench.learning.training.metrics_log import MetricsLog
from dmotion_bench.learning.training.optimizer import AveragedWeights, learning_rate, optimizer_of, set_learning_rate
from dmotion_bench.learning.training.resuming import BestFacts, Checkpoints, NextRow
from dmotion_bench.learning.training.samples import write_sample
from dmotion_bench.learning.training.state import StepReport, TrainingState
from dmotion_bench.learning.training.step import Stepper
from dmotion_bench.learning.training.tracking import tracked
from dmotion_bench.learning.training.validation import require_finite, validation_losses, validation_picture
from dmotion_bench.specs import Supervision
from dmotion_bench.storage.atomic import remove_leftovers, write_atomically
from dmotion_bench.storage.lock import held

if TYPE_CHECKING:
    from lightning_fabric import Fabric

CHECKPOINT_SECONDS = 60.0
LOG_ROWS = 200  # rows of metrics.jsonl in a training
_STOP: Final = 2  # 1 asks for a checkpoint alone


def train(
    run: Run,
    data: TrainingData,
    fabric: Fabric,
    on_step: Callable[[StepReport], None],
    trackers: Sequence[str] = (),
) -> dict[str, Any]:
    """Train a run from its last checkpoint to the end, align it, and write its result.

    Args:
        run: Its folder may hold a checkpoint; training goes on from there.
        data: Training and validation triplets and the label budget.
        fabric: The device, and the other processes if there are any; launched already.
        on_step: Told after every step; may raise to stop, after which the run can be resumed.
        trackers: Where the curves go besides ``metrics.jsonl``: ``tensorboard``, ``wandb``.

    Returns:
        What ``run.json`` keeps as the result.

    Raises:
        PackageNotInstalled: One that a tracker needs is not there.
        LabelsNotAvailable: The budget asks for labels that are not there; before the first step.
        FolderInUse: Another training of the run is going on.
        RunMismatch: Another command has begun a run with other settings in the folder since this one was looked up.
        ProcessLost: Another process of several that train together has ended.
        KeyboardInterrupt: After the checkpoint of the step that was interrupted has been written.
    """
    companions = Companions(fabric)
    with companions.noticing_losses():
        if (result := companions.of_first(lambda: run.result)) is not None:
            return result
        return _train(run, data, fabric, companions, on_step, trackers)


def _train(
    run: Run,
    data: TrainingData,
    fabric: Fabric,
    companions: Companions,
    on_step: Callable[[StepReport], None],
    trackers: Sequence[str],
) -> dict[str, Any]:
    with using_threads(companions.of_first(lambda: run.threads or torch.get_num_threads())):
        trainer = _Trainer(run, data, fabric, companions)  # what is missing is said here, before anything is written
        if not companions.is_first:
            return trainer.fit(on_step, ())
        run.path.mkdir(parents=True, exist_ok=True)
        with held(run.path):
            for folder in (run.path, run.path / SAMPLES):
                remove_leftovers(folder)
            return trainer.fit(on_step, trackers)


class _Trainer:
    def __init__(self, run: Run, data: TrainingData, fabric: Fabric, companions: Companions) -> None:
        self.run, self.data, self.fabric, self.companions = run, data, fabric, companions
        self.config: TrainingConfig = run.spec.training_config
        self.model = run.spec.build().laid_out()
        # asked for first: what is missing is said before the work
        require_adaptable(self.model, self.config)
        self.demonstrations = demonstrations_of(data, self.model.supervision, fabric.device)
        shown = self.demonstrations if self.model.supervision is Supervision.FEW else None
        self.parts = parts_of(self.model.phases(), data, self.config, run.spec.seed, fabric.device, shown)
        self._require_batches()
        self.steps, self.unlabelled_steps = self.parts[-1].stop, steps_before_labels(self.parts)
        losses, self.optimizer = set_up(fabric, self.model, optimizer_of(self.model, self.config))
        self.step = Stepper(
            model=self.model,
            losses=losses,
            backward=fabric.backward,
            optimizer=self.optimizer,
            clip_norm=self.config.clip_norm,
            seed=run.spec.seed,
            device=fabric.device,
            rank=companions.rank,
        )
        self.average = AveragedWeights(self.model, self.config.ema) if self.config.ema else None
        self.hardness = Hardness(self.parts, self.config)
        self.checkpoints = Checkpoints(
            run=run,
            model=self.model,
            optimizer=self.optimizer,
            average=self.average,
            hardness=self.hardness.of_phases,
            config=self.config,
            steps=self.steps,
            starts=frozenset(part.start for part in self.parts),
        )
        self.state = TrainingState()

    def _require_batches(self) -> None:
        smallest = min(part.order.batch_size for part in self.parts)
        if smallest < self.companions.world:
            raise UsageError(
                f"{self.companions.world} processes cannot share a batch of {smallest}; start at most {smallest}, or "
                "give a larger '--set batch_size=N' in a new run (--out DIR)."
            )

    def _settle(self) -> Conditions:
        """The run's conditions; those of a run that begins are recorded before its first step."""
        run = self.run
        conditions = self.companions.of_first(lambda: run.conditions) or choose_conditions(
            run.spec, self.parts, self.fabric.device, self.companions, run.threads
        )

        def begun() -> Conditions:
            run.begin(conditions)
            return conditions

        return self.companions.of_first(begun)

    def _result(self) -> dict[str, Any] | None:
        """The run's result, if another command has finished it since it was looked up."""
        self.run.read_again()
        return self.run.result

    def fit(self, on_step: Callable[[StepReport], None], trackers: Sequence[str]) -> dict[str, Any]:
        if (result := self.companions.of_first(self._result)) is not None:  # here, where nobody else trains the run
            return result
        self.conditions = self._settle()
        torch.set_num_threads(self.conditions.threads)
        self._resume()
        with contextlib.ExitStack() as opened:
            for part in self.parts:
                opened.callback(part.batches.close)
            self.trackers = opened.enter_context(tracked(trackers, self.run, self.state.step))
            return self._fit(on_step)

    def _fit(self, on_step: Callable[[StepReport], None]) -> dict[str, Any]:
        validate_every = max(1, self.steps // self.config.validations)
        log_every = max(1, self.steps // LOG_ROWS)
        saved = time.monotonic()
        self.model.train()
        with self._log() as log, stop_between_steps() as stopping:
            for part in self.parts:
                if self.state.step >= part.stop:
                    continue
                self.model.enter(part.phase)
                self.state.enter(part)
                while self.state.step < part.stop:
                    on_step(self._take_step(part))
                    is_last = self.state.step == part.stop
                    if self.state.step % log_every == 0 or is_last:
                        self._write_row(log)
                    if validated := self.state.step % validate_every == 0 or is_last:
                        self._validate(part, log)
                        self.state.end_early(part, validate_every, self.config.patience)
                        if self.state.step == part.stop < self.steps:
                            self._take_best()
                        if self.state.step == self.unlabelled_steps:  # first: a kill in between takes this step again
                            self._write_checkpoint(self.run.unlabelled_stage)
                        saved = self._save()
                    wanted = _STOP if stopping() else int(time.monotonic() - saved > CHECKPOINT_SECONDS)
                    wanted = self.companions.highest(wanted)  # all at the same step; a signal comes to each alone
                    if wanted and not validated:
                        saved = self._save()
                    if wanted == _STOP:
                        self.companions.any(True)  # nobody leaves before the checkpoint is written
                        raise KeyboardInterrupt
                part.batches.close()
        return self._finish()

    def _take_step(self, part: Part) -> StepReport:
        """Take a step, and count it."""
        terms, weight = self._train(part, self.state.step)
        self.state.step += 1
        self.state.row.add(terms, weight)
        return self.state.report(part, self.steps, terms["loss"])

    def _train(self, part: Part, step: int) -> tuple[dict[str, float], float]:
        """Take a step; the terms of this process's part of the batch, and the weight of that part in their mean."""
        began = time.perf_counter()
        progress = (step - part.start) / (part.stop - part.start)
        set_learning_rate(self.optimizer, learning_rate(self.config, progress))
        chosen = part.order.mixed_batch(step - part.start, self.hardness.of(part), self.config.hard_share)
        companions = self.companions
        index = part.order.share(chosen, companions.rank, companions.world)
        weight = len(index) * companions.world / len(chosen)
        self.model.progress(progress)
        part.batches.expect(step - part.start, companions.rank, companions.world)
        figures = self.step(part.batches(index), step, self.conditions.precision, weight)
        if self.average is not None:
            self.average.update(self.model, step)
        terms = figures.terms
        if self.config.hard_share and (each := figures.per_triplet) is not None:
            parts, means = zip(*companions.gathered((each, terms["loss"])), strict=True)
            if np.isfinite(means).all():  # if not, the training has diverged, which the next validation says
                model, each = type(self.model).__qualname__, np.concatenate(parts)
                self.hardness.remember(part, chosen, each, model=model, step=self.state.step + 1)
        elif self.config.hard_share and step == self.parts[-1].start and companions.is_first:
            self.hardness.warn_of_none(type(self.model).__qualname__)
        self.state.seconds += time.perf_counter() - began
        self.state.triplets += part.order.batch_size
        return terms, weight

    @torch.no_grad()
    def _validate(self, part: Part, log: MetricsLog) -> None:
        """Average the losses over the validation triplets; keep the weights if they are the best so far."""
        self.companions.level(self.model.buffers())
        if self.average is not None:
            self.companions.level(self.average.tensors.values())
        chosen = self.average.swapped_into(self.model) if self.average else contextlib.nullcontext()
        with chosen:
            self.model.eval()
            means = validation_losses(self.model, part, self.companions, self.conditions.precision, self.fabric.device)
            require_finite(self.model, means["loss"], self.state.step, validated=True)
            if self.state.is_lower(means["loss"]):
                self._save_best()
            self._sample()
            self.model.train()
        self.model.enter(part.phase)
        self._write(log, {f"validation_{name}": value for name, value in means.items()})

    def _sample(self) -> None:
        """Keep a picture of what the model predicts now."""
        if not self.companions.is_first or not self.model.needs_pixels:
            return
        picture = validation_picture(
            self.model, self.demonstrations, self.parts, self.conditions.precision, self.fabric.device
        )
        if picture is not None:
            write_sample(self.run.path, self.state.step, picture)
            self.trackers.picture(self.state.step, picture)

    def _save_best(self) -> None:
        if self.companions.is_first:
            self.checkpoints.save_best(BestFacts(step=self.state.step, validation_loss=self.state.best))

    def _take_best(self) -> None:
        """At the end of a phase: go on from its best weights, as they are kept at the end of the last one."""
        self.companions.of_first(self.checkpoints.restore_best)
        self.companions.level(self.model.state_dict().values())
        if self.average is not None:
            self.average.restore(self.model.state_dict())

    def _save(self) -> float:
        """Write all that resuming needs."""
        self._write_checkpoint(self.run.last)
        return time.monotonic()

    def _write_checkpoint(self, path: Path) -> None:
        row = self._row_of_each()
        if self.companions.is_first:
            begun = [part.phase.name for part in self.parts if part.start < self.state.step]
            self.checkpoints.save(
                path, self.state.facts(row), [name for name in begun if name in self.hardness.of_phases]
            )

    def _row_of_each(self) -> NextRow:
        """What the next row has so far, in equal shares: any number of processes can go on with it."""
        sums = self.companions.summed(self.state.row.sums)
        return NextRow(
            sums={name: total / self.companions.world for name, total in sums.items()}, steps=self.state.row.steps
        )

    def _resume(self) -> None:
        facts = self.checkpoints.restore()
        if self.companions.world > 1:  # nothing is written before everybody has answered this
            seen = facts and (facts, checkpoint.weights_hash(self.model.state_dict()))
            self.companions.require_same(f"checkpoint {str(self.run.last)!r}", seen)
        if facts is not None:
            self.state.restore(facts)

    def _log(self) -> contextlib.AbstractContextManager[MetricsLog]:
        if not self.companions.is_first:
            return contextlib.nullcontext(MetricsLog(None))
        return MetricsLog.resumed(self.run.metrics, self.state.step)

    def _write_row(self, log: MetricsLog) -> None:
        """Write the mean losses of all processes since the last row; they must be finite."""
        everybodys = self.companions.summed(self.state.row.sums)
        counted = self.state.row.steps * self.companions.world
        means = {name: total / counted for name, total in everybodys.items()}
        self._write(log, means)
        require_finite(self.model, means["loss"], self.state.step, validated=False)
        self.state.row = NextRow()

    def _write(self, log: MetricsLog, values: Mapping[str, float]) -> None:
        rate = self.optimizer.param_groups[0]["lr"]
        log.write(
            step=self.state.step,
            seconds=self.state.seconds_in_all,
            triplets_per_s=self.state.triplets_per_s,
            learning_rate=rate,
            values=values,
        )
        self.trackers.write(
            self.state.step, {"triplets_per_s": self.state.triplets_per_s, "learning_rate": rate, **values}
        )

    def _finish(self) -> dict[str, Any]:
        return self.companions.of_first(self._finished)

    def _finished(self) -> dict[str, Any]:
        """Align the best weights, write them, and record the result of the training."""
        before = None if self.demonstrations is None else self.run.unadapted
        if before is not None and not before.exists():  # a kill from here on begins with these weights again
            write_atomically(before, self.run.best.read_bytes())
        facts = self.checkpoints.restore_best(before)
        self.model.eval()
        adapted: int | None = None
        if self.demonstrations is not None:
            how = self.run.spec, self.conditions.precision, self.fabric.device
            adapted = adapt(self.model, self.demonstrations, self.data, *how)
        weights = self.model.state_dict()
        state, budget = self.state, self.data.budget
        triplets = sum(state.steps_of(part) * part.order.batch_size for part in self.parts)
        result = RunResult(
            weights=checkpoint.weights_hash(weights),
            steps=sum(map(state.steps_of, self.parts)),
            triplets=triplets,
            seconds=round(state.seconds_in_all, 3),
            triplets_per_s=round(triplets / max(state.seconds_in_all, 1e-9), 2),
            parameters=sum(parameter.numel() for parameter in self.model.parameters()),
            best_step=state.best_step,
            validation_loss=state.best,
            labels=dict(budget.given),
            labels_total=budget.total,
            device=str(self.fabric.device),
            processes=self.fabric.world_size,
            threads=self.conditions.threads,
            precision=self.conditions.precision,
            adapted_steps=adapted,
            ended=dict(state.ended),
        )
        self.checkpoints.save_best(facts)
        self.run.finish(asdict(result))
        return asdict(result)
