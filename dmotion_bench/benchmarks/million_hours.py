"""What a million hours of video would take, from figures that are measured here.

``python -m dmotion_bench.benchmarks.million_hours`` measures them in about two minutes of one core and prints what
docs/experiments/scale.md shows. ``amounts`` is the arithmetic alone.

No recording of a real camera is at hand without a network. Noise with a standard deviation of 2 of 255 is laid over
the frames of a rendered world to stand for one: without loss such frames are hardly smaller than the noise is.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import av
import numpy as np
import torch
from jaxtyping import UInt8

from dmotion_bench.benchmarks.scene import scene_dataset
from dmotion_bench.benchmarks.speeds import streaming
from dmotion_bench.benchmarks.training_step import TrainingStep
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import Episode, Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.limits import LARGEST_MANIFEST, MOST_EPISODES
from dmotion_bench.storage.writer import DatasetWriter

HOURS: Final = 1e6
YEAR_S: Final = 365.25 * 24 * 3600
_NOISE: Final = 2.0  # standard deviation, of 255
_SOURCE: Final = (640, 480)  # [px] of the camera's video
_SOURCE_HZ: Final = 30
_SOURCE_SECONDS: Final = 20
_FEW, _MORE = 20, 220  # episodes, whose index files differ in size


@dataclass(frozen=True, kw_only=True)
class Inputs:
    """What is measured.

    Attributes:
        hz: Frames a second in a data set.
        frame_bytes: Of decoded pixels.
        rendered_bytes, camera_bytes: Of a stored frame's video, of a rendered world and with a camera's noise.
        label_bytes: Of a frame's labels.
        episode_frames: In an episode.
        shard_episodes: In a file.
        index_bytes: That an episode adds to the files beside the shards (``dataset.json`` and tables).
        manifest_bytes: Of it, that a shard adds to ``dataset.json``.
        source_bytes: Of a second of the camera's own video (H.264, 640 x 480, 30 pictures a second).
        import_s: CPU seconds to import a second of it.
        stream_s: CPU seconds to read a triplet while training.
        train_s: CPU seconds to train on a triplet, one core.
        shard_requests: Requests for each file of a data set on object storage.
    """

    hz: float
    frame_bytes: float
    rendered_bytes: float
    camera_bytes: float
    label_bytes: float
    episode_frames: float
    shard_episodes: float
    index_bytes: float
    manifest_bytes: float
    source_bytes: float
    import_s: float
    stream_s: float
    train_s: float
    shard_requests: float = 1.0


@dataclass(frozen=True, kw_only=True)
class Amounts:
    """What follows for so many hours.

    Attributes:
        frames, episodes, shards: In all.
        source_tb: The camera's own video [TB].
        rendered_tb, camera_tb: The stored video [TB].
        cache_tb: Decoded frames, as the memory-mapped cache holds them [TB].
        index_gb: The files beside the shards [GB].
        datasets: So many data sets at least: one holds at most a million episodes, and its ``dataset.json`` has a
            largest size.
        import_core_years: Decoding, scaling and compressing once.
        requests: To fetch the video of every shard once, as an epoch does.
        stream_core_years: Reading an epoch's triplets.
        train_core_years: Training one epoch, DMotion's compact network.
        readers_per_trainer: Cores that read for each core that trains.
    """

    frames: float
    episodes: float
    shards: float
    source_tb: float
    rendered_tb: float
    camera_tb: float
    cache_tb: float
    index_gb: float
    datasets: float
    import_core_years: float
    requests: float
    stream_core_years: float
    train_core_years: float
    readers_per_trainer: float


def amounts(inputs: Inputs, hours: float = HOURS) -> Amounts:
    """The arithmetic."""
    seconds = 3600 * hours
    frames = seconds * inputs.hz
    episodes = frames / inputs.episode_frames
    shards = episodes / inputs.shard_episodes
    triplets = frames * (1 - 2 / inputs.episode_frames)
    largest = min(MOST_EPISODES, LARGEST_MANIFEST / inputs.manifest_bytes * inputs.shard_episodes)
    return Amounts(
        frames=frames,
        episodes=episodes,
        shards=shards,
        source_tb=seconds * inputs.source_bytes / 1e12,
        rendered_tb=frames * inputs.rendered_bytes / 1e12,
        camera_tb=frames * inputs.camera_bytes / 1e12,
        cache_tb=frames * inputs.frame_bytes / 1e12,
        index_gb=episodes * inputs.index_bytes / 1e9,
        datasets=episodes / largest,
        import_core_years=seconds * inputs.import_s / YEAR_S,
        requests=shards * inputs.shard_requests,
        stream_core_years=triplets * inputs.stream_s / YEAR_S,
        train_core_years=triplets * inputs.train_s / YEAR_S,
        readers_per_trainer=inputs.stream_s / inputs.train_s,
    )


def measured(world: str) -> Inputs:
    """The inputs, measured on this machine with one thread."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory(prefix="dmbench-") as place:
        folder = Path(place)
        few = Dataset.open(
            record_dataset(folder / "few", recipe_for(world, Preset.SMALL, episodes=_FEW, tasks=0)).dataset
        )
        noisy = Dataset.open(_with_noise(few, folder / "noisy"))
        one, more = (scene_dataset(folder / f"scene-{count}", count, 12).path for count in (_FEW, _MORE))
        index, manifest = (_beside(more, name) - _beside(one, name) for name in (None, "dataset.json"))
        source_bytes, import_s = _imported(few, folder)
        shards = (_MORE - _FEW) / few.recipe.shard_episodes
        step = TrainingStep("dmotion", "compact")
        step()
        began = time.process_time()
        for _ in range(3):
            step()
        train_s = (time.process_time() - began) / (3 * step.config.batch_size)
        options = ImportOptions()
        return Inputs(
            hz=options.hz,
            frame_bytes=float(few.spec.height * few.spec.width * 3),
            rendered_bytes=_bytes(few.path / "video") / int(few.lengths.sum()),
            camera_bytes=_bytes(noisy.path / "video") / int(noisy.lengths.sum()),
            label_bytes=_bytes(few.path / "labels") / int(few.lengths.sum()),
            episode_frames=float(options.frames_per_episode),
            shard_episodes=float(few.recipe.shard_episodes),
            index_bytes=index / (_MORE - _FEW),
            manifest_bytes=manifest / shards,
            source_bytes=source_bytes,
            import_s=import_s,
            stream_s=1 / streaming(2.0, world).value,
            train_s=train_s,
        )


def _bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _beside(dataset: Path, name: str | None) -> int:
    """Bytes of the files beside the shards, or of one of them."""
    files = [path for path in dataset.iterdir() if path.is_file()]
    return sum(path.stat().st_size for path in files if name in (None, path.name))


def _noise(frames: UInt8[np.ndarray, "t h w 3"], seed: int) -> UInt8[np.ndarray, "t h w 3"]:
    drawn = np.random.default_rng(seed).normal(0.0, _NOISE, frames.shape)
    return np.clip(np.rint(frames + drawn), 0, 255).astype(np.uint8)


def _with_noise(dataset: Dataset, path: Path) -> Path:
    """The same data set with a camera's noise in its frames."""

    def episodes(numbers: Sequence[int]) -> Iterator[Episode]:
        for number in numbers:
            row = dataset.rows[number]
            frames = _noise(dataset.video(number), number)
            yield Episode(frames=frames, labels=dataset.labels(number), seed=row.seed, ended="truncated")

    with DatasetWriter.create_or_resume(path, dataset.recipe, dataset.spec) as writer:
        for shard in writer.missing:
            writer.write_shard(shard, episodes(list(writer.episodes_of(shard))))
        writer.finish()
    return path


def _imported(dataset: Dataset, folder: Path) -> tuple[float, float]:
    """Bytes and CPU seconds of the import, for each second of a camera's video."""
    clip, (width, height) = folder / "clip.mp4", _SOURCE
    frames = np.concatenate([dataset.video(number) for number in range(len(dataset))])
    with av.open(str(clip), "w") as container:
        stream: Any = container.add_stream("libx264", rate=_SOURCE_HZ, options={"crf": "23", "preset": "veryfast"})
        stream.width, stream.height = width, height
        stream.pix_fmt, stream.time_base = "yuv420p", Fraction(1, _SOURCE_HZ)
        for number in range(_SOURCE_HZ * _SOURCE_SECONDS):
            small = av.VideoFrame.from_ndarray(frames[number * 10 // _SOURCE_HZ % len(frames)], format="rgb24")
            large = small.reformat(width=width, height=height).to_ndarray(format="rgb24")
            noisy = _noise(large[None], number)[0]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(noisy, format="rgb24")))
        container.mux(stream.encode())
    began = _cpu()
    import_recordings([clip], folder / "imported", ImportOptions())
    return clip.stat().st_size / _SOURCE_SECONDS, (_cpu() - began) / _SOURCE_SECONDS


def _cpu() -> float:
    """CPU seconds of this process and of those that it waited for."""
    import resource  # Windows has none, and imports every module all the same

    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)


def main(words: Sequence[str] | None = None) -> None:
    """Measure, compute and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--world", default="robot_push", help="the rendered world")
    parser.add_argument("--inputs", type=Path, help="a file of inputs that were measured before")
    asked = parser.parse_args(words)
    inputs = measured(asked.world) if asked.inputs is None else Inputs(**json.loads(asked.inputs.read_bytes()))
    for found in (inputs, amounts(inputs)):
        sys.stdout.write(json.dumps(asdict(found), indent=2) + "\n")


if __name__ == "__main__":
    main()
