"""What the tests find of wrong shapes, and how often they look."""

from __future__ import annotations

import jaxtyping
import pytest
import shape_check
import torch
from jaxtyping import Float
from torch import Tensor

from dmotion_bench.learning.images import to_model


@shape_check.sparingly(typechecker=shape_check.beartype)
def doubled(one: Float[Tensor, "b c"], other: Float[Tensor, "b"]) -> Float[Tensor, "b c"]:
    return 2 * one


def _is_found() -> bool:
    """Whether a call finds that ``b`` is 2 and 3."""
    try:
        doubled(torch.zeros(2, 4), torch.zeros(3))
    except jaxtyping.TypeCheckError:
        return True
    return False


def test_the_first_calls_of_each_test_are_checked_and_then_ever_fewer() -> None:
    for _ in range(2):
        found = [number for number in range(1, 101) if _is_found()]
        assert found == [1, 2, 4, 8, 16, 32, 64]
        shape_check.begin_test()


def test_functions_that_are_made_again_and_again_are_counted_together() -> None:
    def made() -> None:
        @shape_check.sparingly(typechecker=shape_check.beartype)
        def inner(number: int) -> int:
            return number

        inner("one")

    found = 0
    for _ in range(100):
        try:
            made()
        except jaxtyping.TypeCheckError:
            found += 1
    assert found == 7


def test_what_the_benchmark_is_given_is_checked() -> None:
    with pytest.raises(jaxtyping.TypeCheckError, match="to_model"):
        to_model(torch.zeros(2, 4, 4, 3))  # no pixels from 0 to 255
