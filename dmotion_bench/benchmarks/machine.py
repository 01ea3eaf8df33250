"""What this machine can do at most: copy memory, compress frames, multiply matrices."""

from __future__ import annotations

import platform
from pathlib import Path

import numpy as np
import torch
import zstandard

from dmotion_bench.benchmarks.rounds import Yardstick
from dmotion_bench.learning.hardware.precision import has_bf16
from dmotion_bench.wording import sentence


def processor() -> str:
    """What this machine's processor calls itself."""
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:  # not Linux
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return sentence(names[0] if names else platform.processor() or platform.machine() or "an unknown processor")


def graphics(device: torch.device | None) -> str:
    """What a GPU calls itself; empty for none."""
    return sentence(torch.cuda.get_device_name(device)) if device is not None and device.type == "cuda" else ""


def memory_copy(frame_bytes: int) -> Yardstick:
    """Frames a second that one core copies from memory to memory."""
    source = np.random.default_rng(0).integers(0, 256, 64 * 2**20, dtype=np.uint8)
    target = np.empty_like(source)
    return Yardstick(
        name="memory copy, one core",
        amount=source.nbytes / frame_bytes,
        work=lambda: np.copyto(target, source),
    )


def compression(frame_bytes: int) -> Yardstick:
    """Frames a second that zstd compresses on one core, if frames were as plain as a rendered scene's."""
    frame = np.zeros(frame_bytes, np.uint8)
    frame[frame_bytes // 3 : frame_bytes // 2] = 200
    episode = np.tile(frame, 32).tobytes()
    packer = zstandard.ZstdCompressor()
    return Yardstick(name="zstd alone, one core", amount=32, work=lambda: packer.compress(episode))


def matrix_products(precision: str, operations: float) -> Yardstick:
    """How often a second so many floating-point operations are done in a large matrix product, on all cores.

    Args:
        precision: ``"bf16"``, where the hardware has it, or ``"float32"``.
        operations: Those of one frame, triplet or control step.
    """
    size = 1536
    bf16 = precision == "bf16" and has_bf16(torch.device("cpu"))
    left = torch.randn(size, size, dtype=torch.bfloat16 if bf16 else torch.float32)
    return Yardstick(
        name="matrix products alone, all cores", amount=2.0 * size**3 / operations, work=lambda: left @ left
    )
