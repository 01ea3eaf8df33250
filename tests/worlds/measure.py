"""Record a world by its documented command, measure it, and keep a strip of pictures.

Three recordings: the command with ``--preset tiny``, as short as it gets; 20 episodes of the preset ``small``, whose
figures are kept; and 80 short episodes, by one process and by four, whose files are compared byte for byte.

Time is the processor's, of the recording process with all its threads, so that a busy machine changes little. It is
counted from the first episode to the last, without the start of Python and without recording a sample again.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import resource
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np
from PIL import Image

ROOT: Final = Path(__file__).resolve().parents[2]
OWN: Final = ("grid_world", "planar_push", "robot_push", "push_t")
MOMENTS, SIDE, GAP = 6, 128, 4  # of a strip: pictures, and pixels of each and between them

_IN_CPU_SECONDS: Final = (
    "import sys, time, types; import dmotion_bench.recording.session as session; "
    "session.time = types.SimpleNamespace(perf_counter=time.process_time); "
    "from dmotion_bench.cli import main; sys.argv[0] = 'dmbench'; main()"
)
"""The command, whose frames a second are those of a CPU second."""


def documented(environment: str) -> list[str]:
    """The words of the command by which an environment is recorded, as the documentation has them."""
    if environment in OWN:
        return ["dmbench", "record", environment]
    page = (ROOT / "docs" / "gymnasium.md").read_text()
    commands = [
        shlex.split(one) for one in re.findall(r"^\|[^|]+\| `(dmbench record gym:[^`]+)` \|", page, re.MULTILINE)
    ]
    return next(words for words in commands if words[2] == environment)


def hashes(folder: Path) -> dict[str, str]:
    """The SHA-256 of each file of a data set."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def recorded(words: list[str], out: Path, *more: str) -> dict[str, Any]:
    """What the command says in JSON about a recording, with the CPU seconds of the whole command."""
    call = [sys.executable, "-c", _IN_CPU_SECONDS, *words[1:], "--out", str(out), "--json", *more]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(call, check=False, capture_output=True, text=True, cwd=out.parent)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode:
        sys.exit(f"{shlex.join(words)}: {done.stderr.strip()}")
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return json.loads(done.stdout) | {"cpu_s": round(spent, 1), "said": done.stderr.strip()}


def strip(video: np.ndarray) -> Image.Image:
    """Moments spread over an episode, the first and the last among them, side by side."""
    picture = Image.new("RGB", (MOMENTS * (SIDE + GAP) - GAP, SIDE), "white")
    for place, frame in enumerate(np.linspace(0, len(video) - 1, MOMENTS).round().astype(int)):
        picture.paste(Image.fromarray(video[frame]).resize((SIDE, SIDE)), (place * (SIDE + GAP), 0))
    return picture


def measured(environment: str, keep: Path, pictures: Path) -> dict[str, Any]:
    """The figures of a world; its strip is written, and its data set of the preset ``small`` is kept."""
    import dmotion_bench
    from dmotion_bench.environment import tier_of
    from dmotion_bench.registry import environment_class
    from dmotion_bench.storage.dataset import Dataset

    assert not Path(dmotion_bench.__file__).is_relative_to(ROOT) or environment in OWN, "install dmbench as a reader"
    words, name = documented(environment), re.sub(r"[^\w.-]+", "-", environment.removeprefix("gym:"))
    keep.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        tiny = recorded(words, folder / "tiny", "--preset", "tiny", "--workers", "1")
        small = recorded(words, keep / name, "--episodes", "20", "--tasks", "4", "--workers", "1")
        short = ("--preset", "tiny", "--episodes", "80", "--frames", "6", "--tasks", "0")
        recorded(words, folder / "one", *short, "--workers", "1")
        recorded(words, folder / "four", *short, "--workers", "4")
        same = hashes(folder / "one") == hashes(folder / "four")
    dataset = Dataset.open(keep / name)
    video = dataset.video(int(dataset.lengths.argmax()))
    strip(video).save(pictures / f"{name}.webp", quality=80, method=6)
    return {
        "name": name,
        "command": shlex.join(words),
        "tier": tier_of(environment_class(environment)).value,
        "actions": str(dataset.spec.actions),
        "policy": dataset.recipe.policy,
        "frames": small["frames"],
        "frames_per_cpu_s": small["frames_per_s"],
        "bytes_per_frame": small["bytes_per_frame"],
        "tasks": small["tasks"],
        "repeats": small.get("repeats"),
        "same_for_1_and_4_workers": same,
        "tiny": {key: tiny[key] for key in ("frames", "cpu_s", "bytes_per_frame")},
        "versions": dict(dataset.manifest.versions),
    }


def main() -> None:
    """Measure worlds, one after the other."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("environment", nargs="+", help="as in 'dmbench record ENVIRONMENT'")
    parser.add_argument("--into", type=Path, required=True, help="the JSON file of figures")
    parser.add_argument("--pictures", type=Path, required=True, help="the folder of strips")
    parser.add_argument("--keep", type=Path, required=True, help="a folder outside of the repository for the data sets")
    given = parser.parse_args()
    given.pictures.mkdir(parents=True, exist_ok=True)
    for environment in given.environment:
        found = measured(environment, given.keep.resolve(), given.pictures)
        figures = json.loads(given.into.read_text()) if given.into.is_file() else {}
        given.into.write_text(json.dumps(dict(sorted({**figures, environment: found}.items())), indent=1) + "\n")
        sys.stdout.write(f"{environment}: {json.dumps(found)}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
