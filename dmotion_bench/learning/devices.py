"""Where training runs: the CPU, one GPU, or every process that ``torchrun`` started."""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import warnings

import torch
from lightning_fabric import Fabric

from dmotion_bench.errors import UsageError

M_MMAP_THRESHOLD, M_TRIM_THRESHOLD = -3, -1  # malloc.h of the GNU C library


def keep_freed_memory() -> None:
    """Let the C library keep what a training step frees for the next one.

    Page faults on fresh memory cost a fifth of a step. Only the GNU C library can do this.
    """
    with contextlib.suppress(AttributeError, OSError):
        library = ctypes.CDLL(None)
        library.mallopt(M_MMAP_THRESHOLD, 1 << 30)
        library.mallopt(M_TRIM_THRESHOLD, (1 << 31) - 1)


def launch(device: str = "auto") -> Fabric:
    """Fabric on the device asked for; under ``torchrun`` one process of several.

    Raises:
        UsageError: A GPU was asked for and none is there.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise UsageError("this machine has no CUDA device; leave out --device to train on the CPU.")
    keep_freed_memory()
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    accelerator = "cpu" if device == "cpu" or not torch.cuda.is_available() else "cuda"
    logging.getLogger("lightning_fabric").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # advice about the number of processes
        fabric = Fabric(
            accelerator=accelerator,
            devices=processes if processes > 1 else 1,
            strategy="ddp_find_unused_parameters_true" if processes > 1 else "auto",
        )
        fabric.launch()
    if accelerator == "cuda":
        torch.set_float32_matmul_precision("high")
    return fabric
