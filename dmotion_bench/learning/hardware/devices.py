"""Where training runs: the CPU, one GPU, or every process that ``torchrun`` started."""

from __future__ import annotations

import atexit
import contextlib
import logging
import warnings
from typing import TYPE_CHECKING

import torch

from dmotion_bench.errors import UsageError
from dmotion_bench.execution.processes import place
from dmotion_bench.learning.hardware.memory import keep_freed_memory

if TYPE_CHECKING:
    from lightning_fabric import Fabric


def _part() -> None:
    """Leave the other processes while Python still runs: threads of gloo that outlive it abort the process."""
    with contextlib.suppress(RuntimeError):
        if torch.distributed.is_initialized():
            torch.distributed.destroy_process_group()


def launch(device: str = "auto") -> Fabric:
    """Fabric on the device asked for; one process of several where ``torchrun`` or ``processes.lead`` started it.

    Raises:
        UsageError: A GPU was asked for and there is none, or there are fewer than processes.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise UsageError("this machine has no CUDA device; leave out --device to train on the CPU.")
    from lightning_fabric import Fabric  # loads torch's compiler, which takes 1.3 s
    from lightning_fabric.plugins.environments.torchelastic import TorchElasticEnvironment

    keep_freed_memory()
    mine = place()
    accelerator = "cpu" if device == "cpu" or not torch.cuda.is_available() else "cuda"
    if accelerator == "cuda" and mine.local_world > torch.cuda.device_count():
        raise UsageError(
            f"{mine.local_world} processes of this machine need as many GPUs, and it has {torch.cuda.device_count()}; "
            "start fewer, or give '--device cpu'."
        )
    logging.getLogger("lightning_fabric").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # advice about the number of processes
        if mine.world == 1:
            fabric = Fabric(accelerator=accelerator, devices=1)
        else:
            fabric = Fabric(
                accelerator=accelerator,
                devices=mine.local_world,
                num_nodes=mine.nodes,
                strategy="ddp_find_unused_parameters_true",
                plugins=[TorchElasticEnvironment()],
            )
        fabric.launch()
    if mine.world > 1:  # of channels-last weights; they cost DDP a copy, and nothing else
        warnings.filterwarnings("ignore", message="Grad strides do not match bucket view strides")
        atexit.register(_part)
    if accelerator == "cuda":
        torch.set_float32_matmul_precision("high")
    return fabric
