"""Is one model better than another? Only paired differences tell: the same triplets, the same tasks, two predictions.

Most of the spread of an error is that of the frames, which are the same for both models; in the difference it
cancels. The interval is a bootstrap over episodes (``scoring/statistics.py``), and "better" is said only where it
lies on one side of zero. It speaks of these two trained models on episodes like these, not of other seeds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float

from dmotion_bench.errors import RunMismatch, RunMissing
from dmotion_bench.scoring.figures import PUSH, ROLLOUT_COLUMNS
from dmotion_bench.scoring.report import REPORT_FOLDER, Report, read_report, read_report_samples
from dmotion_bench.scoring.samples import FIGURE_COLUMNS, IDENTIFICATION_COLUMNS, column
from dmotion_bench.scoring.statistics import EpisodeBootstrap, Estimate, paired_difference

HIGHER_IS_BETTER: Final = frozenset({"psnr", "ssim", "agent_iou", "motion_probe_accuracy", "control_success"})
NEITHER_IS_BETTER: Final = frozenset({"motion_swap_change"})
BY_EPISODE: Final = ("mse", "mse_push", "position_error_paper")
"""Figures whose sums stand in an entry. Which frames have a value is a matter of the true frames alone."""

Better = Literal["first", "second"]
_KEY: Final = ("metric", "episode", "step", "ahead")


@dataclass(frozen=True, kw_only=True)
class Difference:
    """How two models differ in one figure.

    Attributes:
        figure: By its fixed name.
        first, second: The means over the samples that both have.
        difference: Of first - second.
    """

    figure: str
    first: float
    second: float
    difference: Estimate

    @property
    def better(self) -> Better | None:
        """Which of the two is better; None where the interval does not say so."""
        return better(self.figure, self.difference.low, self.difference.high)


def better(figure: str, low: float | None, high: float | None) -> Better | None:
    """Which of two models is better by the interval of first - second; None where it reaches zero."""
    if low is None or high is None or low <= 0 <= high:
        return None
    base = figure.removeprefix("rollout_").partition("[")[0].removesuffix(PUSH)
    if base in NEITHER_IS_BETTER:
        return None
    return "first" if (low > 0) == (base in HIGHER_IS_BETTER) else "second"


def scored(run: Path) -> tuple[Report, pa.Table]:
    """A run's report and samples.

    Raises:
        RunMissing: The run is not scored, or its samples are not those of the report.
    """
    report = read_report(run / REPORT_FOLDER)
    samples = None if report is None else read_report_samples(run / REPORT_FOLDER, report)
    if report is None or samples is None:
        raise RunMissing(f"the run {str(run)!r} has no whole report; score it with 'dmbench score {run}'.")
    return report, samples


def compare_runs(first: Path, second: Path) -> list[Difference]:
    """Every figure of two runs that can be paired, in the report's order.

    Raises:
        RunMissing: One of them is not scored.
        RunMismatch: They were not scored on the same triplets.
    """
    (one, one_samples), (other, other_samples) = scored(first), scored(second)
    for what, left, right in (
        ("data set", one.dataset["fingerprint"], other.dataset["fingerprint"]),
        ("split", one.settings["split"], other.settings["split"]),
        ("split's protocol", one.settings["protocol"], other.settings["protocol"]),
    ):
        if left != right:
            raise RunMismatch(
                f"{one.run!r} and {other.run!r} were not scored on the same triplets: the {what} is {left!r} of the "
                f"first and {right!r} of the second; differences are paired or not at all."
            )
    return list(_differences(_of_model(one_samples), _of_model(other_samples)))


def _of_model(samples: pa.Table) -> pa.Table:
    return samples.filter(pc.equal(samples["predictor"], "model"))


def _differences(first: pa.Table, second: pa.Table) -> Iterator[Difference]:
    for metric in ("prediction", "rollout"):
        one, other = (samples.filter(pc.equal(samples["metric"], metric)) for samples in (first, second))
        one, other = _aligned(one, other)
        if not len(one):
            continue
        episode, ahead = column(one, "episode"), column(one, "ahead")
        pushed = column(one, "pushed").astype(bool)
        parts: list[tuple[str, str, Any]] = []
        if metric == "prediction":
            everything = np.ones(len(one), bool)
            parts += [(name, name, everything) for name in FIGURE_COLUMNS]
            parts += [(name + PUSH, name, pushed) for name in FIGURE_COLUMNS if name not in IDENTIFICATION_COLUMNS]
        else:
            steps = np.unique(ahead).tolist()
            parts += [(f"rollout_{name}[{step}]", name, ahead == step) for name in ROLLOUT_COLUMNS for step in steps]
        for figure, name, rows in parts:
            left, right = column(one, name)[rows], column(other, name)[rows]
            estimate = paired_difference(left, right, episode[rows])
            if estimate is not None:
                both = np.isfinite(left) & np.isfinite(right)
                yield Difference(
                    figure=figure,
                    first=float(left[both].astype(np.float64).mean()),
                    second=float(right[both].astype(np.float64).mean()),
                    difference=estimate,
                )


def _aligned(first: pa.Table, second: pa.Table) -> tuple[pa.Table, pa.Table]:
    """The rows that both have, in the same order."""
    keys = [np.stack([column(table, name) for name in _KEY[1:]], axis=1) for table in (first, second)]
    places = [{tuple(key): place for place, key in enumerate(table.tolist())} for table in keys]
    common = [key for key in places[0] if key in places[1]]
    left, right = ([own[key] for key in common] for own in places)
    return first.take(pa.array(left, pa.int64())), second.take(pa.array(right, pa.int64()))


def sums_by_episode(samples: pa.Table) -> dict[str, dict[str, list[Any]]]:
    """For the figures of ``BY_EPISODE``: each episode's sum over its samples, and how many they are."""
    rows = _of_model(samples)
    rows = rows.filter(pc.equal(rows["metric"], "prediction"))
    found: dict[str, dict[str, list[Any]]] = {}
    if not len(rows):
        return found
    episode, pushed = column(rows, "episode"), column(rows, "pushed").astype(bool)
    for figure in BY_EPISODE:
        values = column(rows, figure.removesuffix(PUSH)).astype(np.float64)
        counted = np.isfinite(values) & (pushed if figure.endswith(PUSH) else True)
        numbers, index = np.unique(episode[counted], return_inverse=True)
        if len(numbers):
            found[figure] = {
                "episode": numbers.tolist(),
                "n": np.bincount(index).tolist(),
                "sum": np.bincount(index, values[counted]).tolist(),
            }
    return found


def difference_by_episode(first: Sequence[Mapping[str, Any]], second: Sequence[Mapping[str, Any]]) -> Estimate | None:
    """The paired difference first - second of two models, each the mean over its seeds, from sums over episodes.

    The same as ``paired_difference`` of the samples; ``std`` is that over episodes' means. None where the sums are
    not over the same samples.
    """
    everything = [*first, *second]
    if (
        not first
        or not second
        or any((one["episode"], one["n"]) != (everything[0]["episode"], everything[0]["n"]) for one in everything)
    ):
        return None
    count = np.asarray(everything[0]["n"], np.float64)
    if not len(count):
        return None
    apart: Float[np.ndarray, " e"] = _mean_sum(first) - _mean_sum(second)
    bootstrap = EpisodeBootstrap(np.arange(len(count)))
    low, high = bootstrap.interval(np.stack([apart, count], axis=1), lambda sums: sums[:, 0] / sums[:, 1])
    return Estimate(
        mean=float(apart.sum() / count.sum()), std=float((apart / count).std()), low=low, high=high, n=int(count.sum())
    )


def _mean_sum(seeds: Sequence[Mapping[str, Any]]) -> Float[np.ndarray, " e"]:
    sums: Float[np.ndarray, " e"] = np.mean([np.asarray(one["sum"], np.float64) for one in seeds], axis=0)
    return sums
