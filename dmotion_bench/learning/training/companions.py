"""What the processes of one training say to each other, through Fabric; a single process talks to nobody.

The first process alone writes files. The others read only what it has finished before it said so: every question
here is answered by all of them at the same place of the program, so each answer is a meeting point, too.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Final, TypeVar, cast

import torch
from torch import Tensor

from dmotion_bench.errors import ProcessLost, RunError

if TYPE_CHECKING:
    from lightning_fabric import Fabric

Answer = TypeVar("Answer")
_TOLD_BY: Final = ("gloo", "NCCL", "Connection reset", "Broken pipe", "Connection closed", "TCPStore", "store->get")
"""Words of the errors that torch raises when a process cannot be reached."""


class Companions:
    """The processes that train together.

    Args:
        fabric: Launched.

    Attributes:
        rank: The number of this process.
        world: How many there are.
    """

    def __init__(self, fabric: Fabric) -> None:
        self._fabric = fabric
        self.rank, self.world = fabric.global_rank, fabric.world_size

    @property
    def is_first(self) -> bool:
        """Whether this is the process that writes files."""
        return self.rank == 0

    def gathered(self, mine: Answer) -> list[Answer]:
        """Everybody's answer, in the order of their numbers."""
        if self.world == 1:
            return [mine]
        answers: list[Answer | None] = [None] * self.world
        torch.distributed.all_gather_object(answers, mine)
        return cast("list[Answer]", answers)  # None may be an answer, too

    def summed(self, mine: Mapping[str, float]) -> dict[str, float]:
        """The sums of everybody's figures by name, added in the order of their numbers."""
        sums: dict[str, float] = {}
        for figures in self.gathered(dict(mine)):
            for name, value in figures.items():
                sums[name] = sums[name] + value if name in sums else value
        return sums

    def any(self, mine: bool) -> bool:
        """Whether it is so for one of them."""
        return bool(self.highest(int(mine)))

    def highest(self, mine: int) -> int:
        """The highest of their numbers; cheap enough for every step."""
        if self.world == 1:
            return mine
        told = torch.tensor(mine, device=self._fabric.device)
        torch.distributed.all_reduce(told, torch.distributed.ReduceOp.MAX)
        return int(told)

    def of_first(self, answer: Callable[[], Answer]) -> Answer:
        """The answer of the first process, which alone works it out; what it raises ends the others.

        Raises:
            ProcessLost: In the others, where the first one raises an error.
        """
        if self.world == 1:
            return answer()
        failure: BaseException | None = None
        told: tuple[bool, Answer | None] = (False, None)
        if self.is_first:
            try:
                told = (True, answer())
            except BaseException as error:
                failure = error
        told = self._fabric.broadcast(told)
        if failure is not None:
            raise failure
        if not told[0]:
            raise ProcessLost(0)
        return told[1]  # type: ignore[return-value]

    def level(self, tensors: Iterable[Tensor]) -> None:
        """Give all of them the first one's numbers."""
        if self.world > 1:
            for tensor in tensors:
                torch.distributed.broadcast(tensor, 0)

    def require_same(self, what: str, mine: object) -> None:
        """Check that all of them have read the same.

        Raises:
            RunError: They have not.
        """
        if len({repr(told) for told in self.gathered(mine)}) > 1:
            raise RunError(
                f"the {self.world} processes of this training do not see the same {what}; the run's folder must be one "
                "that all machines share. Name such a folder with '--out DIR'."
            )

    @contextlib.contextmanager
    def noticing_losses(self) -> Iterator[None]:
        """Within the block a process that can no longer be reached is a sentence.

        Raises:
            ProcessLost: Another process has ended.
        """
        try:
            yield
        except RuntimeError as error:
            unreachable = isinstance(error, torch.distributed.DistError) or any(word in str(error) for word in _TOLD_BY)
            if self.world == 1 or not unreachable:
                raise
            with contextlib.suppress(RuntimeError):
                torch.distributed.destroy_process_group()  # its threads would abort the end of this process
            raise ProcessLost(self.rank) from None
