"""How commands scale with workers, and a training with processes: ``python -m dmotion_bench.benchmarks.scaling``.

It types the commands as a user does, each with 1 and with 2 workers on the same work in a folder of its own, and prints
a table of seconds by the clock, start of the command included. Run it on a machine with nothing else to do; on 2 cores
it takes some eight minutes. ``--parts`` chooses some of it.

The last part trains with one process and with two that share each batch, and compares weights, figures and time.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import av
import numpy as np
from safetensors.numpy import load_file

from dmotion_bench.benchmarks.machine import processor
from dmotion_bench.benchmarks.scene import scene_frames
from dmotion_bench.workspace import CACHE_VARIABLE

PARTS: Final = ("record", "import", "train", "score", "control", "check", "processes")
WORLD: Final = "planar_push"
SLOW_WORLD: Final = "robot_push"
_PLANNER: Final = ("samples=4", "horizon=2", "iterations=1", "elites=2")
_MAIN: Final = "from dmotion_bench.cli import main; main()"


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """How much work each part is.

    Attributes:
        recorded: Episodes that ``record`` makes, 20 a job.
        clips, clip_frames: Videos that ``import`` reads.
        episodes, frames: Of the data set that is trained on.
        tasks: Of control, for each run.
        controlled: Runs whose control is scored.
        shared_epochs: Of the training by one process and by two.
    """

    recorded: int = 80
    clips: int = 96
    clip_frames: int = 250
    episodes: int = 40
    frames: int = 14
    tasks: int = 8
    controlled: int = 4
    shared_epochs: int = 2


TINY: Final = Sizes(
    recorded=21, clips=2, clip_frames=30, episodes=20, frames=14, tasks=2, controlled=2, shared_epochs=1
)
"""To try every part out; its seconds mean nothing."""


@dataclass(frozen=True, kw_only=True)
class Scaled:
    """A command with one worker and with two.

    Attributes:
        command: What was typed, without the options of the workers.
        one, two: Seconds with 1 and 2 workers.
        speedup: One over the other.
    """

    command: str
    one: float
    two: float

    @property
    def speedup(self) -> float:
        """How many times as fast two workers are."""
        return self.one / self.two


@dataclass(frozen=True, kw_only=True)
class Shared:
    """A training by one process and by two that share each batch.

    Attributes:
        command: What was typed.
        one, two: Seconds of the training steps.
        weights: The largest difference between two weights, as a share of the largest weight of their tensor.
        validation: The best validation losses.
        mse: The MSE of single steps on the test episodes.
    """

    command: str
    one: float
    two: float
    weights: float
    validation: tuple[float, float]
    mse: tuple[float, float]


def scaling(folder: Path, parts: Sequence[str], sizes: Sizes) -> Iterator[Scaled | Shared]:
    """Measure some parts in folders that must not be there yet."""
    if "record" in parts:
        words = ["record", SLOW_WORLD, "--episodes", str(sizes.recorded), "--preset", "small"]
        yield _scaled(folder, "record", words, lambda _: None, alone=["--workers", "1"])
    if "import" in parts:
        clips = folder / "clips"
        for number in range(sizes.clips):
            _write_clip(clips / f"clip-{number:02d}.mp4", sizes.clip_frames, number)
        yield _scaled(folder, "import", ["data", "import", str(clips), "--out", "imported"], lambda _: None)
    later = {"train", "score", "control", "check"} & {*parts}
    if later:
        data = folder / "recorded"
        words = ["record", WORLD, "--preset", "tiny", "--episodes", str(sizes.episodes)]
        _typed(data, [*words, "--frames", str(sizes.frames), "--tasks", str(sizes.tasks)])

        def with_data(place: Path) -> None:
            shutil.copytree(data, place)

        yield _scaled(folder, "train", ["train", "--all"], with_data, alone=["--workers", "1"], json_rows=True)
        yield from _scored(folder, parts, sizes)
    if "processes" in parts:
        yield _shared(folder / "processes", sizes.shared_epochs)


def _scored(folder: Path, parts: Sequence[str], sizes: Sizes) -> Iterator[Scaled]:
    """Scoring of the runs that were trained, and the check of their entries."""
    trained = folder / "train-1"

    def all_runs(place: Path) -> None:
        shutil.copytree(trained, place)

    def some_runs(place: Path) -> None:
        all_runs(place)
        for path in sorted((place / "runs").iterdir())[sizes.controlled :]:
            shutil.rmtree(path)

    words = ["score", "--all", "--metrics", "prediction"]
    if {"score", "check"} & {*parts}:
        yield _scaled(folder, "score", words, all_runs, alone=["--workers", "1"])
    if "control" in parts:
        words = ["score", "--all", "--metrics", "control", "--tasks", str(sizes.tasks), "--objective", "centres"]
        words += [word for setting in _PLANNER for word in ("--planner-set", setting)]
        yield _scaled(folder, "control", words, some_runs, alone=["--workers", "1"])
    if "check" in parts:

        def entries(place: Path) -> None:
            shutil.copytree(folder / "score-1", place)

        _typed(folder / "score-1", ["leaderboard", "build"])
        words = ["leaderboard", "check", "--differing", "1"]
        yield _scaled(folder, "check", words, entries, alone=["--workers", "1", "--executor", "local"])


def _scaled(
    folder: Path,
    name: str,
    words: list[str],
    prepare: Callable[[Path], object],
    *,
    alone: Sequence[str] = (),
    json_rows: bool = False,
) -> Scaled:
    """A command with one worker and with two, each in a workspace of its own."""
    seconds = []
    for workers in (1, 2):
        place = folder / f"{name}-{workers}"
        prepare(place)
        more = alone if workers == 1 else ["--workers", str(workers), "--executor", "local"]
        began = time.perf_counter()
        _typed(place, [*words, *more], may_fail=json_rows or name == "check")
        seconds.append(time.perf_counter() - began)
    return Scaled(
        command=" ".join(["dmbench", *(word for word in words if "/" not in word)]), one=seconds[0], two=seconds[1]
    )


def _shared(folder: Path, epochs: int) -> Shared:
    """Trains with one process and with two."""
    _typed(folder, ["record", WORLD, "--preset", "tiny", "--episodes", "60", "--frames", "30", "--tasks", "0"])
    words = ["train", "ed-cnn", "--labels", "100%", "--set", f"epochs={epochs}", "--set", "precision=float32"]
    words += ["--threads", "1", "--device", "cpu", "--json"]
    results, weights, mse = [], [], []
    for count in (1, 2):
        out = folder / "runs" / f"by-{count}"
        _typed(folder, [*words, "--out", str(out), "--devices", str(count)])
        results.append(json.loads((out / "run.json").read_bytes())["result"])
        weights.append(load_file(out / "best.safetensors"))
        told = json.loads(_typed(folder, ["score", str(out), "--metrics", "prediction", "--json"]))
        mse.append(float(told["reports"][0]["figures"]["mse"]["mean"]))
    return Shared(
        command=" ".join(["dmbench", *words[:-1]]),
        one=results[0]["seconds"],
        two=results[1]["seconds"],
        weights=max(_difference(weights[0][name], weights[1][name]) for name in weights[0]),
        validation=(results[0]["validation_loss"], results[1]["validation_loss"]),
        mse=(mse[0], mse[1]),
    )


def _difference(one: np.ndarray[Any, Any], other: np.ndarray[Any, Any]) -> float:
    if not one.size or one.dtype.kind != "f":
        return 0.0
    return float(np.abs(one - other).max() / max(float(np.abs(one).max()), 1e-12))


def _typed(workspace: Path, words: Sequence[str], *, may_fail: bool = False) -> str:
    """What a command prints; one thread a process, so that workers are what scales, and a cache of its own."""
    workspace.mkdir(parents=True, exist_ok=True)
    environment = os.environ | {"DMBENCH_WORKSPACE": str(workspace), "OMP_NUM_THREADS": "1", "DMBENCH_QUIET": "1"}
    environment.pop(CACHE_VARIABLE, None)
    done = subprocess.run(
        [sys.executable, "-c", _MAIN, *words],
        env=environment,
        cwd=workspace,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode and not may_fail:
        raise SystemExit(f"dmbench {' '.join(words)} failed:\n{done.stderr}")
    return done.stdout


def _write_clip(path: Path, frames: int, seed: int) -> None:
    """A short video of the made-up scene."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=10, options={"crf": "20", "preset": "veryfast"})
        stream.width = stream.height = 128
        stream.pix_fmt, stream.time_base = "yuv420p", Fraction(1, 10)
        for picture in scene_frames(frames, seed):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())


def main(words: Sequence[str] | None = None) -> None:
    """Measure, and print a table or lines of JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--json", action="store_true", help="a line of JSON for each measurement")
    parser.add_argument("--tiny", action="store_true", help="try every part out with little work")
    asked = parser.parse_args(words)
    sizes = TINY if asked.tiny else Sizes()
    say = sys.stdout.write
    if not asked.json:
        say(f"{processor()}, {len(os.sched_getaffinity(0))} cores\n\n")
        say("| command | 1 worker [s] | 2 workers [s] | times as fast |\n|---|---|---|---|\n")
    with tempfile.TemporaryDirectory(prefix="dmbench-") as folder:
        for found in scaling(Path(folder), asked.parts, sizes):
            if asked.json:
                say(json.dumps(asdict(found)) + "\n")
            elif isinstance(found, Scaled):
                say(f"| `{found.command}` | {found.one:.1f} | {found.two:.1f} | {found.speedup:.2f} |\n")
            else:
                say(f"| `{found.command}` | {found.one:.1f} | {found.two:.1f} | {found.one / found.two:.2f} |\n\n")
                say(f"One process and two: weights differ by {found.weights:.2g} of the largest of their tensor, ")
                say(f"validation loss {found.validation[0]:.6g} and {found.validation[1]:.6g}, ")
                say(f"MSE {found.mse[0]:.4g} and {found.mse[1]:.4g}.\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
