"""What models have in common that draw the next frame from the last two and an action, or a latent one.

They carry the two frames packed, as their networks take them, and unpack a frame only for whoever asks to see it. Of
several actions at one state they compute once what does not depend on the action. Both change no bit of a prediction.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from baselines.patches import from_patches, in_autocast, pack, unpack
from dmotion_bench.learning.action_encoding import Actions
from dmotion_bench.learning.images import to_pixels
from dmotion_bench.learning.model import ForwardModel

ConfigT = TypeVar("ConfigT")
Packed = tuple[Float[Tensor, "m p hp wp"], Float[Tensor, "m p hp wp"]]
"""x_{t-1} and x_t of some states."""

_FRAMES_AT_ONCE = 4  # so that what becomes pixels stays in a processor's cache


class TwoFrameModel(ForwardModel[ConfigT]):
    """Subclasses say how the next packed frame comes about (``_drawn``), and which latent action an action is."""

    pack, unpack = staticmethod(pack), staticmethod(unpack)
    table: Any

    @abstractmethod
    def _drawn(self, previous: Tensor, current: Tensor, parent: Tensor | None, latent: Tensor) -> Packed:
        """x_t and the predicted x_{t+1} of each row of ``latent``, packed.

        Args:
            previous, current: The last two frames of some states, packed.
            parent: The state that each row starts from; None if there is one row a state.
            latent: The latent actions.
        """

    def begin(self, previous: Float[Tensor, "b c h w"], current: Float[Tensor, "b c h w"]) -> Packed:
        """The last two frames, packed."""
        return self.pack(previous), self.pack(current)

    def advance(self, state: Packed, action: Actions) -> Packed:
        """The state one action later."""
        return self.branch(state, None, action)

    def branch(self, state: Packed, parent: Int[Tensor, " b"] | None, action: Actions) -> tuple[Tensor, Tensor]:
        """The states that actions lead to; what the actions at one state have in common is computed once.

        Args:
            state: Some states.
            parent: The state at which each action is taken; None if there is one action a state.
            action: The actions.
        """
        return self.branch_with_latent(state, parent, self._latent_of(action))

    def branch_with_latent(
        self, state: Packed, parent: Int[Tensor, " b"] | None, latent: Float[Tensor, "b d"]
    ) -> tuple[Tensor, Tensor]:
        """As ``branch``, of latent actions."""
        previous, current = (in_autocast(frames) for frames in state)
        return self._drawn(previous, current, parent, latent)

    def frame(self, state: Packed) -> Float[Tensor, "m c h w"]:
        """x_t, unpacked."""
        return self.unpack(state[1]).float()

    def features(self, state: Packed) -> Float[Tensor, "m d"]:
        """Both frames, pixel by pixel in the order of a frame."""
        return torch.cat([self.unpack(frames).float().flatten(1) for frames in state], dim=1)

    def pixels(self, state: Packed) -> UInt8[Tensor, "m h w 3"]:
        """x_t as whole pixel values, one colour after the other in memory; those of ``to_pixels(frame(state))``."""
        if self.pack is not pack:
            return to_pixels(self.frame(state))
        parts = torch.split(state[1].permute(0, 2, 3, 1), _FRAMES_AT_ONCE)
        wide = (part.to(torch.float32, copy=True) for part in parts)
        whole = [part.add_(1).mul_(255 / 2).round_().clamp_(0, 255).to(torch.uint8) for part in wide]
        return from_patches(torch.cat(whole).permute(0, 3, 1, 2), 4).movedim(1, -1)

    def predict_with_latent(
        self,
        previous: Float[Tensor, "b c h w"],
        current: Float[Tensor, "b c h w"],
        latent: Float[Tensor, "b d"],
    ) -> Float[Tensor, "b c h w"]:
        """The next frame under a latent action."""
        return self.frame(self.branch_with_latent(self.begin(previous, current), None, latent))

    def _latent_of(self, action: Actions) -> Float[Tensor, "b d"]:
        latent: Tensor = self.table(action)
        return latent
