"""How far a training has got: its step, its lowest validation loss, and the time that it took."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from dmotion_bench.execution.job_progress import JobProgress
from dmotion_bench.learning.data.curriculum import Part
from dmotion_bench.learning.training.resuming import LastFacts, NextRow


@dataclass(frozen=True, kw_only=True)
class StepReport:
    """The progress of a training; given to the progress callback after every step.

    Attributes:
        step, steps: Taken, and in all.
        phase: The name of the present one.
        loss: Of this step, before it was taken; of this process's part of the batch.
        triplets_per_s: Since this process began.
    """

    step: int
    steps: int
    phase: str
    loss: float
    triplets_per_s: float

    def as_progress(self, what: str) -> JobProgress:
        """It as progress of the work that is called ``what``."""
        status = f"{self.phase} loss {self.loss:.4f}, {self.triplets_per_s:.0f} triplets/s"
        return JobProgress(what=what, done=self.step, total=self.steps, status=status, unit="steps")


@dataclass
class TrainingState:
    """What changes from step to step, besides the tensors.

    Attributes:
        step: Steps taken, those that an early end left out counted as taken.
        best: Lowest validation loss of the present phase; infinite before there is one.
        best_step: Where it was.
        ended: Where phases ended early, by their names.
        row: What the next row of the log has so far, of this process's part of the batches.
        seconds_before: Spent in steps before this process began.
        seconds, triplets: Spent and seen since.
    """

    step: int = 0
    best: float = math.inf
    best_step: int = -1
    ended: dict[str, int] = field(default_factory=dict)
    row: NextRow = field(default_factory=NextRow)
    seconds_before: float = 0.0
    seconds: float = 0.0
    triplets: int = 0

    @property
    def triplets_per_s(self) -> float:
        """Since this process began."""
        return self.triplets / self.seconds if self.seconds else 0.0

    @property
    def seconds_in_all(self) -> float:
        """Spent in steps."""
        return self.seconds_before + self.seconds

    def enter(self, part: Part) -> None:
        """Begin a phase, or go on with it: losses of different phases do not compare, and no row is of two phases."""
        if self.step == part.start:
            self.best, self.row = math.inf, NextRow()  # a phase that ended early has left some

    def is_lower(self, loss: float) -> bool:
        """Whether a validation loss is the lowest of its phase; then it is kept."""
        if lower := loss < self.best:
            self.best, self.best_step = loss, self.step
        return lower

    def end_early(self, part: Part, validate_every: int, patience: int) -> None:
        """After a validation: leave out what is left of the phase if ``patience`` of them brought no lower loss.

        Args:
            part: The present phase.
            validate_every: Steps from one validation to the next.
            patience: 0 waits to the phase's end.
        """
        waited = self.step // validate_every - self.best_step // validate_every
        if patience and waited >= patience and self.step < part.stop:
            self.ended[part.phase.name] = self.step
            self.step = part.stop

    def steps_of(self, part: Part) -> int:
        """The steps that a phase that is over took."""
        return self.ended.get(part.phase.name, part.stop) - part.start

    def report(self, part: Part, steps: int, loss: float) -> StepReport:
        """What is told after a step of a phase, of so many ``steps`` in all."""
        return StepReport(
            step=self.step, steps=steps, phase=part.phase.name, loss=loss, triplets_per_s=self.triplets_per_s
        )

    def facts(self, row: NextRow) -> LastFacts:
        """For a checkpoint, with the part of the next row that each process goes on from."""
        return LastFacts(
            step=self.step,
            best=self.best if math.isfinite(self.best) else None,
            best_step=self.best_step,
            seconds=self.seconds_in_all,
            ended=dict(self.ended),
            row=row if row.is_kept else NextRow(),
        )

    def restore(self, facts: LastFacts) -> None:
        """Go on from a checkpoint."""
        self.step, self.best_step = facts.step, facts.best_step
        self.best = math.inf if facts.best is None else facts.best
        self.ended, self.seconds_before = dict(facts.ended), facts.seconds
        self.row = NextRow(sums=dict(facts.row.sums), steps=facts.row.steps)
