"""Hold an entry against its run's stored samples, and these and its pictures against those of a new scoring."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Bool

from dmotion_bench.errors import RunCorrupt
from dmotion_bench.scoring.prediction import MODEL
from dmotion_bench.scoring.references import REFERENCES
from dmotion_bench.scoring.report import SAMPLES_FILE, samples_path
from dmotion_bench.scoring.samples import (
    FIGURE_COLUMNS,
    GAIN,
    GAIN_COLUMNS,
    LATER_LISTS,
    RANK_COLUMNS,
    column,
    read_samples,
)
from dmotion_bench.scoring.score import Scores
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.shard import file_facts
from leaderboard.comparison import GAIN_CAPTURED, figures_by_samples, sums_by_episode
from leaderboard.control import FIGURES as CONTROLLED
from leaderboard.pictures import from_png, identity
from leaderboard.verdict import SAME, SHOWN, Findings

ROUNDING: Final = 1e-3
"""Relative; between the figures of two scorings."""

SAMPLE_ROUNDING: Final = 1e-2
"""Relative and absolute; between two scorings of one sample."""

LATER_DIFFERING: Final = 0.01
"""Share of the rows of ``LATER_LISTS`` that may differ: probes are fitted, and small networks round differently."""

PICTURE_ROUNDING: Final = 3  # pixel values
LATER: Final = ("probe_", "codebook_", "state_probe")
"""Figures that entries of this version of scoring may lack: they came later, and changed no other."""

_KEY: Final = ("episode", "step", "ahead")


def stored_samples(check: Findings, folder: Path) -> pa.Table | None:
    """The samples beside the run's report."""
    said = check.entry.content["samples"]
    path = samples_path(folder, said["sha256"])
    if not path.is_file():
        check.wrong.append(f"samples: there is no {str(path)!r} to hold the figures against")
        return None
    check.expect("samples.file", said["file"], SAMPLES_FILE)
    check.expect("samples.sha256", said["sha256"], file_facts(path).sha256)
    try:
        samples = read_samples(path)
    except RunCorrupt as error:
        check.wrong.append(f"samples: {error}")
        return None
    check.expect("samples.rows", said["rows"], len(samples))
    return samples


def against_samples(check: Findings, samples: pa.Table, settings: ScoreSettings, dataset: Dataset) -> None:
    """Compare every figure with the one computed from the stored samples, which are to be of test episodes."""
    content = check.entry.content
    predicted = np.isin(column(samples, "metric").astype(str), ("prediction", "rollout"))
    others = np.setdiff1d(column(samples, "episode")[predicted], dataset.split(settings.split))
    if len(others) and settings.protocol == "episode":
        check.wrong.append(f"samples: episode {', '.join(map(str, others[:SHOWN]))} is none of the test's")
    if MODEL in content["reference"]:
        check.wrong.append(f"reference.{MODEL}: the model is no reference")
    stored = np.unique(column(samples, "predictor").astype(str)).tolist()
    everything = {**{name: {} for name in (*REFERENCES, *stored)}, **content["reference"], MODEL: content["figures"]}
    for predictor, said in everything.items():
        if predictor == "paper":
            continue
        mine = figures_by_samples(samples, predictor, said, settings.resamples)
        where = "figures" if predictor == MODEL else f"reference.{predictor}"
        check.expect_figures(f"{where}, from the samples", said, mine)
        if predictor == MODEL:
            check.figures |= mine.keys()
    said, ours = content["by_episode"], sums_by_episode(samples)
    if GAIN_CAPTURED not in said:
        ours.pop(GAIN_CAPTURED, None)
    if said.keys() != ours.keys() or not all(_same_sums(said[name], ours[name]) for name in ours):
        check.wrong.append("by_episode: other sums than those of the samples")


def _same_sums(said: Mapping[str, Any], found: Mapping[str, Any]) -> bool:
    same = said["episode"] == found["episode"]
    return same and all(np.allclose(said[name], found[name], rtol=SAME, atol=SAME) for name in ("n", "sum"))


def same_scores(check: Findings, scores: Scores, metrics: Collection[str]) -> None:
    """Compare every mean with the new scoring; intervals were compared with the samples already.

    Args:
        check: Takes down what is found.
        scores: The new scoring.
        metrics: The groups of figures that were scored.
    """
    content = check.entry.content
    not_scored = (CONTROLLED,) if GAIN in metrics else (CONTROLLED, GAIN_CAPTURED)
    everything = {"figures": (content["figures"], scores.figures)}
    for name, figures in scores.reference.items():
        everything[f"reference.{name}"] = (content["reference"].get(name, {}), figures)
    for where, (said, figures) in everything.items():
        mine = {name: one.to_json() for name, one in figures.items()}
        others = {name: figure for name, figure in said.items() if not name.startswith(not_scored)}
        for later in (None, *LATER):
            ours, theirs = (
                {name: one for name, one in all_of.items() if _came(name) == later} for all_of in (mine, others)
            )
            if later is not None and ours and not theirs:
                check.remarks.append(f"{where}: the entry has none of the figures {later}..., which came later")
            if theirs or later is None:
                absolute = SAMPLE_ROUNDING if later else 0.0  # scores of probes are near zero where they read nothing
                check.expect_figures(
                    f"{where}, scored anew", theirs, ours, ROUNDING, means_only=True, absolute=absolute
                )
    check.figures |= scores.figures.keys()


def _came(figure: str) -> str | None:
    """With which of the later figures this one came."""
    return next((later for later in LATER if figure.startswith(later)), None)


def same_samples(
    check: Findings, stored: pa.Table, scored: pa.Table, differing: float, metrics: Collection[str]
) -> None:
    """Compare the samples of some groups row by row; a given share may differ, because processors round differently."""
    predictors = np.unique(np.concatenate([column(table, "predictor") for table in (stored, scored)]).astype(str))
    wrong, later, known = list[str](), 0, 0
    for predictor in predictors.tolist():
        for metric in (one for one in ("prediction", "rollout", GAIN) if GAIN in metrics or one != GAIN):
            one, other = (_part(table, predictor, metric) for table in (stored, scored))
            keys, others = (np.stack([column(table, name) for name in _KEY], axis=1) for table in (one, other))
            if not np.array_equal(keys, others):
                check.wrong.append(f"samples: the stored {metric} of {predictor} are of other frames")
                continue
            check.samples += len(one)
            rows = keys[_apart(one, other)].tolist()
            wrong += [f"{metric} of {predictor}, episode {episode}, step {step}" for episode, step, _ in rows]
            apart, compared = _later_apart(one, other)
            later, known = later + apart, known + compared
    if later > max(differing, LATER_DIFFERING) * known:
        check.wrong.append(f"samples: {later} of {known} of what probes and codes came to differ from the new scoring")
    if wrong:
        told = f"{len(wrong)} of {check.samples} differ from the new scoring"
        if len(wrong) > differing * check.samples:
            check.wrong.append(f"samples: {told}: {'; '.join(wrong[:SHOWN])}")
        else:
            check.remarks.append(f"samples: {told}")


def _part(table: pa.Table, predictor: str, metric: str) -> pa.Table:
    rows = (column(table, "predictor") == predictor) & (column(table, "metric") == metric)
    part = table.filter(pa.array(rows))
    order = np.lexsort(tuple(column(part, name) for name in reversed(_KEY)))
    return part.take(pa.array(order))


def _apart(stored: pa.Table, scored: pa.Table) -> Bool[np.ndarray, " n"]:
    """Which rows differ by more than rounding."""
    wrong: Bool[np.ndarray, " n"] = np.zeros(len(stored), np.bool_)
    for name in (*FIGURE_COLUMNS, *GAIN_COLUMNS, *RANK_COLUMNS, "action", "pushed"):
        left, right = (column(table, name).astype(np.float64) for table in (stored, scored))
        wrong |= _far(left, right)
    for name in ("distance", "found", "found_truth", "motion", "command"):
        wrong |= _lists_apart(stored, scored, name, SAMPLE_ROUNDING)
    return wrong


def _later_apart(stored: pa.Table, scored: pa.Table) -> tuple[int, int]:
    """Of the columns that came later, and that are stored: how many rows differ, and how many were compared.

    What is rounding is told by the size of a column's values, since squared distances may be tiny.
    """
    apart = known = 0
    for name in LATER_LISTS:
        if not len(_flat(stored, name)):
            continue
        values = np.abs(_flat(scored, name))
        size = float(np.nanmean(values)) if np.isfinite(values).any() else 0.0
        apart += int(_lists_apart(stored, scored, name, SAMPLE_ROUNDING * size).sum())
        known += len(stored)
    return apart, known


def _lists_apart(stored: pa.Table, scored: pa.Table, name: str, absolute: float) -> Bool[np.ndarray, " n"]:
    """The rows whose lists differ, in their lengths or by more than rounding."""
    sizes, others = (
        pc.fill_null(pc.list_value_length(table[name]), 0).to_numpy().astype(np.int64) for table in (stored, scored)
    )
    apart: Bool[np.ndarray, " n"] = sizes != others
    if not apart.any():
        left, right = (_flat(table, name) for table in (stored, scored))
        apart[np.repeat(np.arange(len(sizes)), sizes)[_far(left, right, absolute)]] = True
    return apart


def _flat(table: pa.Table, name: str) -> Any:
    values = table[name].combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return values.astype(np.float64)


def _far(left: Any, right: Any, absolute: float = SAMPLE_ROUNDING) -> Bool[np.ndarray, " n"]:
    far: Bool[np.ndarray, " n"] = ~np.isclose(left, right, rtol=SAMPLE_ROUNDING, atol=absolute, equal_nan=True)
    return far


def same_pictures(check: Findings, mine: list[dict[str, Any]]) -> None:
    said = {identity(picture): picture for picture in check.entry.pictures}
    if len(said) < len(check.entry.pictures):
        check.wrong.append("pictures: a step stands there twice")
    if not said:
        if mine:
            check.remarks.append("the entry has no pictures")
        return
    if said.keys() != {identity(picture) for picture in mine}:
        check.wrong.append("pictures: of other steps than the data set's")
        return
    for picture in mine:
        one = said[identity(picture)]
        where = f"pictures, episode {picture['episode']}, step {picture['step']}"
        for name in ("action", "pushed"):
            check.expect(f"{where}, {name}", one[name], picture[name])
        for name, rounding in (("current", 0), ("truth", 0), ("predicted", PICTURE_ROUNDING)):
            left, right = (from_png(taken[name]).astype(np.int16) for taken in (one, picture))
            if left.shape != right.shape or np.abs(left - right).max() > rounding:
                check.wrong.append(f"{where}: the frame {name!r} is another")
