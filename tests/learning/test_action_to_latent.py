"""Actions become vectors and latent actions by one shared rule, for both kinds of action."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.errors import InvalidSetting, ModelContractBroken
from dmotion_bench.learning.action_encoding import ActionEncoding, action_embedding
from dmotion_bench.learning.action_to_latent import PENALTIES, ActionToLatent, JointActionToLatent, ridge

STEPS = Continuous(names=("dx", "dy"), low=(-0.04, 0.0), high=(0.04, 0.1), units=("m", "m"))


def drawn(count: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(STEPS.denormalise(np.random.default_rng(seed).uniform(-1, 1, (count, 2)))).float()


def test_encodings_are_one_hot_or_normalised() -> None:
    one_hot = ActionEncoding(Discrete.numbered(3))
    assert one_hot(torch.tensor([2, 0])).tolist() == [[0, 0, 1], [1, 0, 0]]
    normalised = ActionEncoding(STEPS)
    assert (one_hot.width, normalised.width, ActionEncoding(None).width) == (3, 2, 0)
    torch.testing.assert_close(
        normalised(torch.tensor([[-0.04, 0.1], [0.0, 0.05]])), torch.tensor([[-1.0, 1.0], [0.0, 0.0]])
    )
    torch.testing.assert_close(normalised(drawn(9)).double(), torch.from_numpy(STEPS.normalise(drawn(9).numpy())))


def test_an_encoding_leaves_no_trace_in_a_checkpoint() -> None:
    for spec in (Discrete.numbered(3), STEPS, None):
        assert not ActionEncoding(spec).state_dict()


def test_an_embedding_is_a_linear_map_of_the_encoding() -> None:
    for spec, action in ((Discrete.numbered(3), torch.tensor([2, 0, 2])), (STEPS, drawn(3))):
        embedding, encoding = action_embedding(spec, 5), ActionEncoding(spec)
        weight = embedding.weight if isinstance(spec, Discrete) else embedding.weight.T
        bias = 0 if isinstance(spec, Discrete) else embedding.bias
        torch.testing.assert_close(embedding(action), encoding(action) @ weight + bias)


def test_discrete_actions_have_a_table_of_means_and_what_was_not_shown_is_as_before_any_demonstration() -> None:
    table = ActionToLatent(Discrete.numbered(3), 2, unaligned=torch.tensor([0.0, 9.0]))
    table.fit(torch.tensor([[1.0, 2.0], [3.0, 6.0], [7.0, 7.0]]), torch.tensor([0, 0, 2]))
    assert table(torch.tensor([2, 0, 1])).tolist() == [[7, 7], [2, 4], [0, 9]]
    table.fit(torch.tensor([[5.0, 5.0]]), torch.tensor([1]))
    assert table.rows.tolist() == [[0, 9], [5, 5], [0, 9]]  # nothing is left of demonstrations of before


@pytest.mark.parametrize("shape", [(2, 1), (2, 2), (1, 3)])
def test_latent_actions_of_another_width_are_refused_instead_of_repeated(shape: tuple[int, ...]) -> None:
    for spec, action in ((Discrete.numbered(2), torch.tensor([0, 1])), (STEPS, drawn(2))):
        table = ActionToLatent(spec, 3)
        with pytest.raises(ModelContractBroken, match=r"of 2 demonstrations it takes \(2, 3\), as the width"):
            table.fit(torch.ones(shape), action)
        assert not table.rows.any()


CORNERS = torch.tensor([[8.0, 0.0], [-8.0, 0.0], [0.0, 8.0], [0.0, -8.0]])


def shaken(count: int) -> torch.Tensor:
    """Latent actions of four actions, each moved by a shake of up to 4 in both directions; equally many of each."""
    shake = torch.rand(4, count, 2, generator=torch.Generator().manual_seed(0)) * 8 - 4
    shake -= shake.mean(1, keepdim=True)
    return (CORNERS[:, None] + shake).flatten(0, 1)


def test_unlabelled_latent_actions_correct_rows_of_one_demonstration_each() -> None:
    table = ActionToLatent(Discrete.numbered(4), 2)
    table.fit(CORNERS + torch.tensor([[3.0, 2.0], [2.0, -3.0], [-3.0, 1.0], [2.0, 3.0]]), torch.arange(4))
    table.settle(shaken(500))
    torch.testing.assert_close(table.rows, CORNERS, atol=0.2, rtol=0)


def test_what_no_demonstration_shows_pulls_no_row_and_keeps_its_own() -> None:
    """Without the bound of half the way, a third of the missing action's would count to each of the others."""
    table = ActionToLatent(Discrete.numbered(4), 2, unaligned=torch.tensor([1.0, 1.0]))
    table.fit(CORNERS[:3] + 1.0, torch.arange(3))
    table.settle(torch.cat([shaken(500), torch.zeros(300, 2)]))  # and 300 times the agent met an edge
    torch.testing.assert_close(table.rows[:3], CORNERS[:3], atol=0.4, rtol=0)
    assert table.rows[3].tolist() == [1, 1]


@pytest.mark.parametrize("shown", [[], [2]])
def test_without_two_demonstrated_actions_a_table_stays(shown: list[int]) -> None:
    table = ActionToLatent(Discrete.numbered(4), 2)
    table.fit(CORNERS[shown] + 1.0, torch.tensor(shown, dtype=torch.long))
    before = table.rows.clone()
    table.settle(shaken(5))
    assert torch.equal(table.rows, before)


def test_rows_stay_where_nothing_is_near_or_two_are_alike() -> None:
    table = ActionToLatent(Discrete.numbered(2), 2)
    for rows in (torch.tensor([[1.0, 0.0], [-1.0, 0.0]]), torch.ones(2, 2)):
        table.fit(rows, torch.arange(2))
        table.settle(CORNERS)
        assert torch.equal(table.rows, rows)


def test_a_linear_relation_is_found_exactly_and_kept_by_a_checkpoint() -> None:
    action = drawn(16)
    matrix, offset = torch.tensor([[30.0, 1.0, 0.0], [-2.0, 0.0, 20.0]]), torch.tensor([0.1, -0.2, 0.3])
    learned, kept = ActionToLatent(STEPS, 3), ActionToLatent(STEPS, 3)
    learned.fit(action @ matrix + offset, action)
    kept.load_state_dict(learned.state_dict())
    fresh = drawn(50, seed=1)
    torch.testing.assert_close(kept(fresh), fresh @ matrix + offset, atol=1e-4, rtol=1e-4)


def test_before_alignment_every_action_is_the_same() -> None:
    still = torch.tensor([1.0, 0.0, 0.5])
    for spec, action in ((STEPS, drawn(2)), (Discrete.numbered(2), torch.tensor([0, 1]))):
        assert ActionToLatent(spec, 3, unaligned=still)(action).tolist() == [still.tolist()] * 2


def test_one_demonstration_gives_its_latent_action_to_every_action() -> None:
    learned = ActionToLatent(STEPS, 2)
    learned.fit(torch.tensor([[3.0, -1.0]]), drawn(1))
    torch.testing.assert_close(learned(drawn(5, seed=2)), torch.tensor([[3.0, -1.0]]).expand(5, 2))


@pytest.mark.parametrize("noise", [0.01, 1.0, 30.0])
def test_the_regularisation_is_the_one_that_leaves_least_error_when_each_row_is_left_out(noise: float) -> None:
    generator = torch.Generator().manual_seed(3)
    known = torch.rand(12, 2, generator=generator, dtype=torch.float64) * 2 - 1
    wanted = known @ torch.tensor([[2.0], [-1.0]], dtype=torch.float64)
    wanted = wanted + noise * torch.randn(12, 1, generator=generator, dtype=torch.float64)

    def fitted(rows: torch.Tensor, penalty: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Slopes and intercept by the normal equations; the intercept is not penalised."""
        x, y = known[rows], wanted[rows]
        x0, y0 = x.mean(0), y.mean(0)
        slopes = torch.linalg.solve((x - x0).T @ (x - x0) + penalty * torch.eye(2), (x - x0).T @ (y - y0))
        return slopes, y0 - x0 @ slopes

    def left_out(penalty: float) -> float:
        total = 0.0
        for row in range(12):
            slopes, offset = fitted(torch.arange(12) != row, penalty)
            total += float((wanted[row] - known[row] @ slopes - offset).square().sum())
        return total

    best = min((float(one) * 12 for one in PENALTIES), key=left_out)
    slopes, offset = fitted(torch.ones(12, dtype=torch.bool), best)
    torch.testing.assert_close(ridge(known, wanted), torch.cat([offset[None], slopes]))


@pytest.mark.parametrize(("rows", "numbers"), [(1, 2), (2, 2), (3, 8), (40, 60), (60, 40), (400, 3)])
def test_it_is_the_regression_by_singular_values(rows: int, numbers: int) -> None:
    """With columns that repeat each other, one that does not vary, and scales that differ a thousandfold."""
    generator = torch.Generator().manual_seed(0)
    known = torch.randn(rows, numbers, generator=generator, dtype=torch.float64)
    known[:, 0] *= 1e-3
    known[:, -1] = known[:, 0]
    known[:, numbers // 2] = 3
    slopes = torch.randn(numbers, 2, generator=generator, dtype=torch.float64)
    wanted = known @ slopes + 0.1 * torch.randn(rows, 2, generator=generator, dtype=torch.float64)
    x, y = known - known.mean(0), wanted - wanted.mean(0)
    left, values, right = torch.linalg.svd(x, full_matrices=False)

    def left_out(penalty: float) -> float:
        shrunk = values.square() / (values.square() + penalty)
        leverage = 1 / rows + left.square() @ shrunk
        residual = y - left @ (shrunk[:, None] * (left.T @ y))
        return float((residual / (1 - leverage).clamp(min=1e-9)[:, None]).square().sum())

    errors = {float(one): left_out(float(one)) for one in PENALTIES * rows}
    best = max(one for one, error in errors.items() if error <= min(errors.values()) * (1 + 1e-9))
    slopes = right.T @ ((values / (values.square() + best))[:, None] * (left.T @ y))
    found = ridge(known, wanted)
    torch.testing.assert_close(found[1:], slopes, rtol=0, atol=1e-9 * max(1.0, float(slopes.abs().max())))
    torch.testing.assert_close(found[0], wanted.mean(0) - known.mean(0) @ slopes, rtol=0, atol=1e-8)


def test_noise_alone_is_answered_by_the_mean() -> None:
    generator = torch.Generator().manual_seed(0)
    wanted = torch.randn(40, 2, generator=generator)
    found = ridge(ActionEncoding(STEPS)(drawn(40)), wanted)
    assert found[1:].abs().max() < 0.5 * math.sqrt(2)
    torch.testing.assert_close(found[0], wanted.mean(0), atol=0.2, rtol=0)


JOINT = Discrete.joint(("up", "down", "left"), ("near", "far"))
OF_FIRST = torch.tensor([[0.0, -1.0], [0.0, 1.0], [-1.0, 0.0]])
OF_SECOND = torch.tensor([[0.1, 0.0], [0.3, 0.0]])


def seen(action: torch.Tensor, order: tuple[int, int], noise: float = 0.01) -> torch.Tensor:
    """What a model reads off joint actions whose map of agent k is number ``order[k]``, a bit inexactly."""
    parts = torch.from_numpy(JOINT.divided(action.numpy()))
    motions = torch.stack([OF_FIRST[parts[:, 0]], OF_SECOND[parts[:, 1]]], 1)
    motions = motions + noise * torch.randn(motions.shape, generator=torch.Generator().manual_seed(1))
    return motions[:, torch.tensor(order).argsort()]


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_demonstrations_say_whose_latent_actions_are_whose(order: tuple[int, int]) -> None:
    action = torch.arange(6)
    table = JointActionToLatent(JOINT, 2, 2)
    table.fit(seen(action, order), action)
    assert table.order.tolist() == list(order)
    parts = torch.from_numpy(JOINT.divided(action.numpy()))
    found = table(action)
    torch.testing.assert_close(found[:, 0], OF_FIRST[parts[:, 0]], atol=0.03, rtol=0)
    torch.testing.assert_close(found[:, 1], OF_SECOND[parts[:, 1]], atol=0.03, rtol=0)
    kept = JointActionToLatent(JOINT, 2, 2)
    kept.load_state_dict(table.state_dict())
    torch.testing.assert_close(kept(action), found, atol=0, rtol=0)
    assert kept.order.tolist() == list(order)


def test_a_scale_of_a_latent_action_decides_nothing() -> None:
    action = torch.arange(6)
    latent = seen(action, (1, 0))
    for place in (0, 1):
        table = JointActionToLatent(JOINT, 2, 2)
        scaled = latent.clone()
        scaled[:, place] *= 1000
        table.fit(scaled, action)
        assert table.order.tolist() == [1, 0]


def test_joint_actions_that_were_not_shown_are_put_together_from_their_parts() -> None:
    shown = torch.tensor([0, 1, 2, 5])  # up/near, up/far, down/near, left/far
    table = JointActionToLatent(JOINT, 2, 2)
    table.fit(seen(shown, (0, 1), noise=0), shown)
    assert table(torch.tensor([3])).tolist() == [[[0, 1], pytest.approx([0.3, 0])]]  # down/far
    table = JointActionToLatent(JOINT, 2, 2, unaligned=torch.tensor([7.0, 7.0]))
    table.fit(seen(shown[:2], (0, 1), noise=0), shown[:2])
    assert table(torch.tensor([4]))[0, 0].tolist() == [7, 7]  # nobody has shown what "left" is


def test_where_nothing_decides_the_models_own_order_stands() -> None:
    table = JointActionToLatent(JOINT, 2, 2)
    table.fit(torch.ones(3, 2, 2), torch.tensor([0, 3, 4]))
    assert table.order.tolist() == [0, 1]


@pytest.mark.parametrize("spec", [Discrete.numbered(16), STEPS, Discrete.joint(("a", "b"), ("a", "b"), ("a", "b"))])
def test_actions_of_another_number_of_agents_are_refused(spec: Discrete | Continuous) -> None:
    with pytest.raises(
        InvalidSetting,
        match=r"actions of its data set are (continuous|of 1 agent|of 3 agents)\.",
    ):
        JointActionToLatent(spec, 2, 2)
