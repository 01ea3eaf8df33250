"""Comparisons of two models by paired differences: both predict the same triplets and work on the same tasks.

Most of the spread of an error is that of the frames, which are the same for both models; in the difference it
cancels. The interval is a bootstrap over episodes (``scoring/statistics.py``), and "better" is said only where it
lies on one side of zero. It speaks of these two trained models on episodes like these, not of other seeds.
Figures that were measured with different settings are left out: their difference would be that of the settings, too.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float, Shaped

from dmotion_bench.errors import RunMismatch, RunMissing
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.decisive import sample_settings
from dmotion_bench.scoring.figures import PUSH, ROLLOUT_COLUMNS, is_solved
from dmotion_bench.scoring.report import (
    REPORT_FOLDER,
    TRANSFERS,
    Report,
    read_report,
    read_report_samples,
    report_place,
)
from dmotion_bench.scoring.samples import (
    CONTROL,
    FIGURE_COLUMNS,
    GAIN,
    IDENTIFICATION_COLUMNS,
    PICTURE_CONTROL,
    column,
)
from dmotion_bench.scoring.statistics import EpisodeBootstrap, Estimate, paired_difference
from dmotion_bench.scoring.transfer import report_folder
from dmotion_bench.specs import SplitName
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.storage.split import SPLIT_NAMES
from dmotion_bench.wording import command, shown

HIGHER_IS_BETTER: Final = frozenset(
    {
        "psnr",
        "ssim",
        "agent_iou",
        "motion_probe_accuracy",
        "inverse_accuracy",
        "hit_at_1",
        "reciprocal_rank",
        "control_success",
        "planning_gain",
        "state_probe",
    }
)
NEITHER_IS_BETTER: Final = frozenset({"motion_swap_change"})
Better = Literal["first", "second"]
Standing = Literal["behind", "tie", "unknown"]
_Otherwise = Mapping[str, Sequence[str]]
_PAIRED: Final = ("prediction", "rollout", GAIN, CONTROL, PICTURE_CONTROL)
"""The metrics of samples, in the order of their figures."""
_LOG: Final = logging.getLogger(__name__)
_KEY: Final = ("episode", "step", "ahead")
_KEYS: Final[Mapping[str, tuple[str, ...]]] = {
    CONTROL: ("task", "ahead"),
    PICTURE_CONTROL: ("task", "ahead"),
    GAIN: (*_KEY, "best_gain"),  # two stretches of an episode may have their moments at one frame, with other goals
}
"""Of samples that ``_KEY`` does not name."""


@dataclass(frozen=True, kw_only=True)
class Difference:
    """The difference of two models in one figure.

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
        """Which of the two models is better; None if the interval contains zero."""
        return better(self.figure, self.difference.low, self.difference.high)

    @property
    def verdict(self) -> str:
        """Which is better, or why that is not said: they are tied, or too few episodes have no interval."""
        return self.better or (_unknown(self.difference) if standing(self.difference) == "unknown" else "tied")


def better(figure: str, low: float | None, high: float | None) -> Better | None:
    """Which of two models is better, by the interval of first - second; None if the interval contains zero."""
    if low is None or high is None or low <= 0 <= high:
        return None
    base = figure.removeprefix("rollout_").partition("[")[0].removesuffix(PUSH)
    if base in NEITHER_IS_BETTER:
        return None
    return "first" if (low > 0) == (base in HIGHER_IS_BETTER) else "second"


def scored(run: Path, folder: Path | None = None, dataset: ReadableDataset | None = None) -> tuple[Report, pa.Table]:
    """A run's report and samples.

    Args:
        run: Its folder.
        folder: Of a report on another data set; its own if left out.
        dataset: What the report must be about, where that is asked.

    Raises:
        RunMissing: The run is not scored, its samples are not those of the report, or it was scored on other data.
    """
    folder = run / REPORT_FOLDER if folder is None else folder
    report = read_report(folder)
    samples = None if report is None else read_report_samples(folder, report)
    there, split = (folder.parent, ("--split", folder.name)) if folder.name in SPLIT_NAMES else (folder, ())
    data = str(dataset.path) if dataset is not None else there.name if there.parent.name == TRANSFERS else None
    score = command("dmbench score", run, *(() if data is None else ("--data", data)), *split)
    if report is None or samples is None:
        raise RunMissing(f"the run {str(run)!r} has no whole report; score it with {score}.")
    if dataset is not None and report.dataset["fingerprint"] != dataset.fingerprint:
        raise RunMissing(
            f"the report {str(folder)!r} is not of the data set in {str(dataset.path)!r}, but of one with the "
            f"fingerprint {report.dataset['fingerprint'][:12]}; score the run with {score}."
        )
    return report, samples


def scored_on(run: Path, dataset: ReadableDataset | None = None, split: SplitName = "test") -> tuple[Report, pa.Table]:
    """A run's report on a data set, its own (also by None) or another, and the samples.

    Raises:
        RunMissing: There is none.
        RunCorrupt: The run, or a report on a data set of the same name, cannot be read.
    """
    if dataset is None:
        return scored(run, run / report_place(None, split))
    return scored(run, report_folder(run, Run.open(run).spec.fingerprint, dataset, split), dataset)


def compare_runs(
    first: Path,
    second: Path,
    dataset: ReadableDataset | None = None,
    split: SplitName = "test",
    *,
    warn: Callable[[str], None] = _LOG.warning,
) -> list[Difference]:
    """Every figure of two runs that can be paired, in the report's order.

    Args:
        first, second: The runs' folders.
        dataset: What both were scored on; each one's own data set if left out.
        split: Whose episodes both were scored on.
        warn: Told in a sentence which figures are left out, since they were measured with different settings.

    Raises:
        RunMissing: One of them is not scored.
        RunMismatch: They were not scored on the same triplets, or all that both have with different settings.
    """
    (one, one_samples), (other, other_samples) = (scored_on(run, dataset, split) for run in (first, second))
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
    left_out = _measured_otherwise(one, one_samples, other, other_samples)
    told = [
        f"the figures of {' and '.join(metrics)} of {one.run!r} and {other.run!r} were measured with different "
        f"settings, so they are not compared: {why}; score both runs with the same ones."
        for why, metrics in left_out.items()
    ]
    apart = [metric for metrics in left_out.values() for metric in metrics]
    tables = [_of_model(samples) for samples in (one_samples, other_samples)]
    found = list(_differences(*(_without(table, apart) for table in tables)))
    if told and not found:
        raise RunMismatch(" ".join(told))
    for sentence in told:
        warn(sentence)
    return found


def _measured_otherwise(one: Report, one_samples: pa.Table, other: Report, other_samples: pa.Table) -> _Otherwise:
    """By the settings that differ, the metrics that both reports have and whose samples these settings decide."""
    both = set(pc.unique(one_samples["metric"]).to_pylist()) & set(pc.unique(other_samples["metric"]).to_pylist())
    found: dict[str, list[str]] = {}
    for metric in _PAIRED:
        mine, theirs = (sample_settings(metric, report.settings) for report in (one, other))
        if metric in both and mine != theirs:
            found.setdefault(_apart(mine, theirs), []).append(metric)
    return found


def _apart(first: Mapping[str, Any], second: Mapping[str, Any]) -> str:
    """The settings that differ, in words."""
    differing = (name for name in {**first, **second} if first.get(name) != second.get(name))
    return ", ".join(
        f"{name} is {shown(first.get(name))} of the first and {shown(second.get(name))} of the second"
        for name in differing
    )


def _without(samples: pa.Table, metrics: Sequence[str]) -> pa.Table:
    return samples.filter(pc.invert(pc.is_in(samples["metric"], pa.array(metrics, pa.string()))))


def behind(samples: pa.Table, best: pa.Table, figure: str = "mse") -> Estimate | None:
    """The paired difference of a single-step figure from the best; None if the runs share no sample."""
    one, other = (_single_steps(_of_model(table)) for table in (samples, best))
    one, other = _aligned(one, other, _KEY)
    if not len(one):
        return None
    left, right = (column(table, figure).astype(np.float64) for table in (one, other))
    return paired_difference(left, right, column(one, "episode"))


def standing(difference: Estimate) -> Standing:
    """Whether a run with this difference is behind the best or tied with it; unknown with too few episodes."""
    if difference.low is None or difference.high is None:
        return "unknown"
    return "tie" if difference.low <= 0 <= difference.high else "behind"


def standing_words(difference: Estimate, above: str, between: str) -> str:
    """A run's standing in words; ``above`` is its difference from the best as text, ``between`` the interval."""
    words = {"behind": f"{above} ({between})", "tie": f"tied ({between})", "unknown": _unknown(difference)}
    return words[standing(difference)]


def _unknown(difference: Estimate) -> str:
    """That a difference without an interval says nothing, and of how few episodes it is."""
    count = difference.episodes
    return "unknown" if count is None else f"unknown: {'one episode' if count == 1 else f'{count} episodes'}"


def _single_steps(samples: pa.Table) -> pa.Table:
    return samples.filter(pc.equal(samples["metric"], "prediction"))


def _of_model(samples: pa.Table) -> pa.Table:
    return samples.filter(pc.equal(samples["predictor"], "model"))


def _differences(first: pa.Table, second: pa.Table) -> Iterator[Difference]:
    for metric in _PAIRED:
        one, other = (samples.filter(pc.equal(samples["metric"], metric)) for samples in (first, second))
        one, other = _aligned(one, other, _KEYS.get(metric, _KEY))
        if not len(one):
            continue
        episode, ahead = column(one, "episode"), column(one, "ahead")
        pushed = np.nan_to_num(column(one, "pushed").astype(np.float64)).astype(bool)
        if metric == GAIN:
            yield from _gain_difference(one, other)
            continue
        parts: list[tuple[str, str, Any]] = []
        if metric == "prediction":
            everything = np.ones(len(one), bool)
            parts += [(name, name, everything) for name in FIGURE_COLUMNS]
            parts += [(name + PUSH, name, pushed) for name in FIGURE_COLUMNS if name not in IDENTIFICATION_COLUMNS]
        elif metric == PICTURE_CONTROL:
            steps = [step for step in np.unique(ahead).tolist() if step > 0]
            parts += [(f"control_picture_distance[{step}]", "control_distance", ahead == step) for step in steps]
        elif metric == CONTROL:
            steps = [step for step in np.unique(ahead).tolist() if step > 0]  # at the start all are 1 away
            parts += [(f"control_distance[{step}]", "control_distance", ahead == step) for step in steps]
            parts += [(name, name, ahead == ahead.max()) for name in ("control_success", "control_lost")]
        else:
            steps = np.unique(ahead).tolist()
            parts += [(f"rollout_{name}[{step}]", name, ahead == step) for name in ROLLOUT_COLUMNS for step in steps]
        for figure, name, rows in parts:
            left, right = (_values(table, name)[rows] for table in (one, other))
            estimate = paired_difference(left, right, episode[rows])
            if estimate is not None:
                both = np.isfinite(left) & np.isfinite(right)
                yield Difference(
                    figure=figure,
                    first=float(left[both].mean()),
                    second=float(right[both].mean()),
                    difference=estimate,
                )


def _gain_difference(first: pa.Table, second: pa.Table) -> Iterator[Difference]:
    """The difference in the gain captured at the same moments; as much can be gained at each in both."""
    best = _values(first, "best_gain")
    left, right = (_values(table, "gain") for table in (first, second))
    estimate = EpisodeBootstrap(column(first, "episode")).ratio(left - right, best)
    if estimate is not None:
        both = np.isfinite(left) & np.isfinite(right) & (best > 0)
        means = (float(one[both].sum() / best[both].sum()) for one in (left, right))
        yield Difference(figure="planning_gain", first=next(means), second=next(means), difference=estimate)


def _values(samples: pa.Table, name: str) -> Float[np.ndarray, " n"]:
    if name == "control_success":
        return is_solved(column(samples, "control_distance"))
    return column(samples, name).astype(np.float64)


def _aligned(first: pa.Table, second: pa.Table, key: Sequence[str]) -> tuple[pa.Table, pa.Table]:
    """The rows that both have, in the same order."""
    if not len(first) or not len(second):
        return first.slice(0, 0), second.slice(0, 0)
    places = [_places(np.stack([column(table, name) for name in key], axis=1)) for table in (first, second)]
    common = [key for key in places[0] if key in places[1]]
    left, right = ([own[key] for key in common] for own in places)
    return first.take(pa.array(left, pa.int64())), second.take(pa.array(right, pa.int64()))


def _places(keys: Shaped[np.ndarray, "n k"]) -> dict[tuple[float, ...], int]:
    """The row of each key; the last number of a key says how many rows before had the same."""
    met, found = Counter[tuple[float, ...]](), dict[tuple[float, ...], int]()
    for place, key in enumerate(map(tuple, keys.tolist())):
        found[*key, met[key]] = place
        met[key] += 1
    return found
