"""The two position errors and the two rates, by hand."""

from __future__ import annotations

import math

import torch

from dmotion_bench.positions import Positions
from dmotion_bench.scoring.position_errors import distances, first_things, position_errors


def positions(*frames: list[tuple[float, float] | None]) -> Positions:
    nothing = (math.nan, math.nan)
    centre = torch.tensor(
        [[nothing if place is None else place for place in frame] for frame in frames], dtype=torch.float64
    )
    found = torch.isfinite(centre[..., 0])
    return Positions(centre=centre, found=found, pixels=found.int() * 50)


def test_every_case_of_an_object() -> None:
    truth = positions([(10, 10), (2, 3), (50, 50), None, None])
    predicted = positions([(13, 14), None, (50, 50), (7, 7), None])

    errors = position_errors(predicted, truth)

    # 5 px off, one missing at a distance of 5 from (-1, -1), one exact; one of two absent ones is shown
    assert errors.position_error_paper.item() == (5 + 5 + 0) / 3
    assert errors.position_error.item() == (5 + 0) / 2
    assert errors.miss_rate.item() == torch.tensor(1 / 3).item()
    assert errors.false_positive_rate.item() == 1 / 2
    assert torch.isfinite(distances(predicted, truth)).tolist() == [[True, False, True, False, False]]


def test_frames_with_nothing_to_say_have_no_value() -> None:
    truth = positions([None, None], [(1, 1), (2, 2)])
    predicted = positions([(3, 3), None], [None, None])

    errors = position_errors(predicted, truth)

    assert torch.isnan(errors.position_error_paper).tolist() == [True, False]
    assert torch.isnan(errors.position_error).tolist() == [True, True]
    assert torch.isnan(errors.miss_rate).tolist() == [True, False]
    assert errors.false_positive_rate[0].item() == 0.5
    assert torch.isnan(errors.false_positive_rate[1])


def test_without_the_agent() -> None:
    truth = positions([(10, 10), (40, 40)])
    predicted = positions([(10, 10), (70, 80)])

    without = position_errors(first_things(predicted, 1), first_things(truth, 1))

    assert position_errors(predicted, truth).position_error.item() == 25
    assert without.position_error.item() == 0
