"""What this machine can do at most: copy memory, compress frames, multiply matrices."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import zstandard

from dmotion_bench.learning.optimization import has_bf16
from dmotion_bench.wording import sentence


def processor() -> str:
    """What this machine's processor calls itself."""
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:  # not Linux
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return sentence(names[0] if names else platform.processor() or platform.machine() or "an unknown processor")


def rate(work: Callable[[], object], amount: float, seconds: float = 1.0, repeats: int = 3) -> float:
    """How much of ``amount`` a second: the best of some repeats, each at least ``seconds / repeats`` long."""
    work()
    best = 0.0
    for _ in range(repeats):
        began, done = time.perf_counter(), 0
        while time.perf_counter() - began < seconds / repeats:
            work()
            done += 1
        best = max(best, done * amount / (time.perf_counter() - began))
    return best


def memory_copy() -> float:
    """Bytes a second that one core copies from memory to memory."""
    source = np.random.default_rng(0).integers(0, 256, 256 * 2**20, dtype=np.uint8)
    target = np.empty_like(source)
    return rate(lambda: np.copyto(target, source), source.nbytes)


def compression(frame_bytes: int) -> float:
    """Frames a second that zstd compresses on one core, if frames were as plain as a rendered scene's."""
    frame = np.zeros(frame_bytes, np.uint8)
    frame[frame_bytes // 3 : frame_bytes // 2] = 200
    episode = np.tile(frame, 32).tobytes()
    packer = zstandard.ZstdCompressor()
    return rate(lambda: packer.compress(episode), 32)


def matrix_products(precision: str) -> float:
    """Floating-point operations a second in a large matrix product, ``"bf16"`` or ``"float32"``, on all cores."""
    size = 1536
    bf16 = precision == "bf16" and has_bf16(torch.device("cpu"))
    left = torch.randn(size, size, dtype=torch.bfloat16 if bf16 else torch.float32)
    return rate(lambda: left @ left, 2.0 * size**3)
