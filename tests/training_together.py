"""A small model in double precision, and its training in several processes that this module starts."""

from __future__ import annotations

import os
import socket
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
import torch.multiprocessing
import torch.nn.functional as F
from torch import Tensor, nn

from dmotion_bench.errors import DmbenchError
from dmotion_bench.learning.action_encoding import ActionEncoding
from dmotion_bench.learning.model import ForwardModel, Losses, ModelInputs, Phase, TripletBatch
from dmotion_bench.specs import Supervision

LOADED = ["dmotion_bench.learning.training.loop", "dmotion_bench.learning.runs.start", "baselines.encoder_decoder"]


@dataclass(frozen=True, kw_only=True)
class NoConfig:
    """There is nothing to choose."""


class Exact(ForwardModel[NoConfig]):
    """Predicts a frame of 8 x 8 pixels by a small network in float64, whose sums hardly depend on their order."""

    supervision: ClassVar[Supervision] = Supervision.ACTIONS
    paper: ClassVar[str] = "nobody, nowhere"
    Config: ClassVar[type] = NoConfig

    def __init__(self, config: NoConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        assert inputs.actions is not None
        self.encode = ActionEncoding(inputs.actions)
        self.hidden = nn.Linear(192 + self.encode.width, 16).double()
        self.out = nn.Linear(16, 192).double()
        self.late = nn.Linear(192, 192).double()
        self.register_buffer("mean", torch.zeros(192, dtype=torch.float64))

    def phases(self) -> tuple[Phase, ...]:
        return (
            Phase(name="early", fraction=0.6, needs_actions=True, together=2),
            Phase(name="late", fraction=0.4, needs_actions=True),
        )

    def enter(self, phase: Phase) -> None:
        self.late.requires_grad_(phase.name == "late")

    def losses(self, batch: TripletBatch) -> Losses:
        assert batch.action is not None
        errors = (self._predicted(batch.current, batch.action) - _small(batch.next)).square().mean(1)
        return Losses(total=errors.mean(), terms={"error": errors.mean().detach()}, per_triplet=errors.detach())

    def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
        small = self._predicted(current, action).float().reshape(-1, 3, 8, 8)
        return F.interpolate(small, current.shape[-2:])

    def _predicted(self, current: Tensor, action: Tensor) -> Tensor:
        given = torch.cat([_small(current), self.encode(action).double()], 1)
        early = self.out(torch.tanh(self.hidden(given)))
        return early if not self.late.weight.requires_grad else early + self.late(early)


class Asking(Exact):
    """Its losses ask the other processes, as LAPO's do for its codes."""

    def losses(self, batch: TripletBatch) -> Losses:
        if self.training and torch.distributed.is_initialized():
            torch.distributed.all_reduce(self.mean)
        return super().losses(batch)


def _small(images: Tensor) -> Tensor:
    return F.adaptive_avg_pool2d(images.double(), 8).flatten(1)


def together(world: int, work: Callable[..., Any], *given: Any) -> None:
    """Call ``work(rank, *given)`` in so many processes that find each other as those of torchrun do.

    They are forked off one that has loaded torch, which takes longer than most of what they do.
    """
    torch.multiprocessing.get_context("forkserver").set_forkserver_preload(LOADED)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    torch.multiprocessing.start_processes(
        _begin, (world, port, sys.path, work, given), nprocs=world, start_method="forkserver"
    )


def _begin(rank: int, world: int, port: int, path: list[str], work: Callable[..., Any], given: tuple[Any, ...]) -> None:
    sys.path[:] = path
    names = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": world, "LOCAL_WORLD_SIZE": world, "MASTER_PORT": port}
    os.environ.update({name: str(value) for name, value in names.items()}, MASTER_ADDR="127.0.0.1")
    os.environ["GLOO_SOCKET_IFNAME"] = "lo" if sys.platform == "linux" else "lo0"
    torch.set_num_threads(1)
    work(rank, *given)
    if torch.distributed.is_initialized():
        torch.distributed.destroy_process_group()  # its threads may abort the end of this process


def train_exact(
    rank: int, data: Path, folder: Path, settings: tuple[str, ...], stop_at: int | None = None, log_rows: int = 200
) -> None:
    """Train ``Exact`` in this process, alone or as one of several; a stop is a Ctrl-C that only this rank 0 gets."""
    import signal
    from unittest import mock

    from dmotion_bench.learning.hardware.devices import launch
    from dmotion_bench.learning.runs.start import TrainingRequest, open_run, training_data
    from dmotion_bench.learning.training.loop import train
    from dmotion_bench.learning.training.state import StepReport
    from dmotion_bench.storage.dataset import Dataset
    from dmotion_bench.workspace import Workspace

    def on_step(report: StepReport) -> None:
        if report.step == stop_at and rank == 0:
            os.kill(os.getpid(), signal.SIGINT)

    with (
        mock.patch("dmotion_bench.learning.runs.manifest.model_class", return_value=Exact),
        mock.patch("dmotion_bench.learning.runs.start.model_class", return_value=Exact),
        mock.patch("dmotion_bench.learning.training.loop.LOG_ROWS", log_rows),
    ):
        dataset = Dataset.open(data)
        asked = TrainingRequest(model="ed-cnn", labels="100%", settings=settings, threads=1)
        fabric = launch("cpu")
        run = open_run(asked, dataset, folder, Workspace(folder.parent))
        try:
            train(run, training_data(run, dataset), fabric, on_step)
        except KeyboardInterrupt:
            (folder / f"interrupted-{rank}").touch()


def train_asking(rank: int, data: Path, folder: Path) -> None:
    """Train ``Asking``, whose precision is measured before its first step."""
    import signal
    from unittest import mock

    signal.alarm(60)  # processes that ask each other different things wait for ever
    with (
        mock.patch(f"{__name__}.Exact", Asking),
        mock.patch("dmotion_bench.learning.training.conditions.settled", return_value=None),
    ):
        train_exact(rank, data, folder, ("batch_size=8", "epochs=1", "validations=2"))


def talk(rank: int, folder: Path) -> None:
    """What processes say to each other; each writes what it understood."""
    from dmotion_bench.learning.hardware.devices import launch
    from dmotion_bench.learning.training.companions import Companions

    companions = Companions(launch("cpu"))
    told = [
        companions.gathered({"rank": rank}),
        companions.any(rank == 1),
        companions.any(False),
        companions.of_first(lambda: f"by {rank}"),
    ]
    numbers = torch.full((2,), float(rank))
    companions.level([numbers])
    told.append(numbers.tolist())
    for answer in ("the same", rank, rank or None):  # one of them sees nothing at all
        try:
            told.append(companions.require_same("answer", answer))
        except DmbenchError as error:
            told.append(str(error))
    try:
        told.append(companions.of_first(lambda: int("none")))
    except (DmbenchError, ValueError) as error:
        told.append(f"{type(error).__name__}: {error}")
    (folder / f"{rank}.txt").write_text("\n".join(map(str, told)))


def lose(rank: int, folder: Path) -> None:
    """The last process ends without a word; the others notice."""
    from dmotion_bench.learning.hardware.devices import launch
    from dmotion_bench.learning.training.companions import Companions

    companions = Companions(launch("cpu"))
    companions.any(False)
    if rank == companions.world - 1:
        os._exit(0)
    try:
        with companions.noticing_losses():
            for _ in range(1000):
                companions.any(False)
                time.sleep(0.01)
    except DmbenchError as error:
        (folder / f"{rank}.txt").write_text(f"{type(error).__name__}: {error}")
