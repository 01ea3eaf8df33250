"""A bright square that steps left, right, up or down by four pixels, in front of faint noise."""

from __future__ import annotations

import torch

from dmotion_bench.learning.model import TripletBatch

SIZE, STEP = 32, 4
MOVES = torch.tensor([[0, -STEP], [0, STEP], [-STEP, 0], [STEP, 0]])


def walking_dot(count: int, seed: int) -> TripletBatch:
    """So many triplets in which each of the four actions occurs equally often."""
    generator = torch.Generator().manual_seed(seed)
    action = torch.arange(count) % 4
    before = MOVES[torch.randint(4, (count,), generator=generator)]
    place = torch.randint(10, SIZE - 14, (count, 2), generator=generator)
    frames = []
    for offset in (-before, torch.zeros_like(place), MOVES[action]):
        image = torch.rand(count, 3, SIZE, SIZE, generator=generator) * 0.1 - 1
        for row, (down, right) in enumerate((place + offset).tolist()):
            image[row, :, down : down + 4, right : right + 4] = 1
        frames.append(image)
    return TripletBatch(previous=frames[0], current=frames[1], next=frames[2], action=action)
