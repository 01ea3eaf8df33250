"""What models that learn without actions may tell of the agent and of what it does, each as a protocol.

A model implements what it has; scoring, viewing and the checks of a model's contract ask for it. Images are as in
``learning/model.py``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

from jaxtyping import Float, Int
from torch import Tensor


@runtime_checkable
class LatentActionModel(Protocol):
    """A model that reads a latent action off frames and predicts by it."""

    def latent_action(
        self,
        previous: Float[Tensor, "b c h w"],
        current: Float[Tensor, "b c h w"],
        following: Float[Tensor, "b c h w"],
    ) -> Float[Tensor, "b d"]:
        """The latent action at ``current`` that leads to ``following``."""

    def predict_with_latent(
        self, previous: Float[Tensor, "b c h w"], current: Float[Tensor, "b c h w"], latent: Float[Tensor, "b d"]
    ) -> Float[Tensor, "b c h w"]:
        """The next frame under a latent action."""


@runtime_checkable
class AgentModel(Protocol):
    """A model that knows where the agent is."""

    def agent_map(self, current: Float[Tensor, "b c h w"]) -> Float[Tensor, "b y x"]:
        """Large where the agent is, near zero elsewhere; at any resolution."""


@runtime_checkable
class AgentsModel(Protocol):
    """A model that tells several agents apart; it counts them as ``EnvSpec.agents`` does."""

    def agent_maps(self, current: Float[Tensor, "b c h w"]) -> Float[Tensor, "b k y x"]:
        """As ``agent_map``, for each agent."""

    def agent_motions(self, latent: Float[Tensor, "b d"]) -> Float[Tensor, "b k e"]:
        """The part of a latent action that is each agent's; ``pixel_shift`` takes such a part."""


@runtime_checkable
class ShiftModel(Protocol):
    """A model whose latent action is a shift."""

    def pixel_shift(self, motion: Float[Tensor, "b d"]) -> Float[Tensor, "b 2"]:
        """How far the motion moves the agent: (right, down) in pixels of the frame."""


@runtime_checkable
class CodebookModel(Protocol):
    """A model whose latent action is made of codes out of codebooks.

    Attributes:
        codebook_sizes: Codes in each codebook.
    """

    codebook_sizes: tuple[int, ...]

    def chosen_codes(
        self,
        previous: Float[Tensor, "b c h w"],
        current: Float[Tensor, "b c h w"],
        following: Float[Tensor, "b c h w"],
    ) -> Int[Tensor, "b k m"]:
        """The numbers of the ``m`` codes that the latent action takes from each codebook."""


def codes_fault(codes: Any, sizes: Sequence[int], count: int) -> str | None:
    """What is wrong with chosen codes, to follow "gave"; None if nothing is.

    Args:
        codes: As ``chosen_codes`` gave them.
        sizes: The model's ``codebook_sizes``.
        count: Of rows that were asked about.
    """
    if not isinstance(codes, Tensor) or codes.is_floating_point():
        return "codes that are no tensor of whole numbers"
    if codes.ndim != 3 or codes.shape[:2] != (count, len(sizes)):
        return f"codes of the shape {tuple(codes.shape)}, not ({count}, {len(sizes)}, codes of each codebook)"
    for number, size in enumerate(sizes):
        own = codes[:, number]
        if own.numel() and not 0 <= int(own.min()) <= int(own.max()) < size:
            return f"the codes {int(own.min())} to {int(own.max())} of codebook {number}, which has {size}"
    return None
