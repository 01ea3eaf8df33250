"""``rerun video/shard-00000.mcap`` shows pictures: asked of Rerun's own command line, without a window."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from noise_world import write_noise

RERUN = Path(sys.executable).with_name("rerun")


def rerun(*words: object) -> str:
    done = subprocess.run([RERUN, *map(str, words)], capture_output=True, text=True, check=False)
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert "WARN" not in said
    return said


@pytest.mark.skipif(not RERUN.exists(), reason="the rerun command is not beside this Python")
def test_rerun_draws_the_video_and_finds_no_fault(tmp_path: Path) -> None:
    dataset = write_noise(tmp_path / "d")
    for kind in ("video", "labels"):
        assert "ok" in rerun("mcap", "check", "--full", dataset.path / kind / "shard-00000.mcap")
    shard, converted = dataset.path / "video" / "shard-00000.mcap", tmp_path / "video.rrd"
    rerun("mcap", "convert", shard, "--application-id", "noise", "--output", converted)
    shown = rerun("rrd", "print", "-vv", converted)
    assert "/camera" in shown
    assert "Image:buffer" in shown
