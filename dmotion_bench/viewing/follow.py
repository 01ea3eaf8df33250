"""Live views of a training or a recording: they show whatever is new in its folder.

Only the folder is read, so it makes no difference whether this process or another one does the work, and a follower
cannot slow it down or change what it does. A training runs over the timeline ``step``; of a recording one episode of
each new shard is shown, one after the other on the timeline ``frame``.
"""

from __future__ import annotations

import io
import logging
import math
from pathlib import Path
from typing import Protocol

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from dmotion_bench.errors import DatasetError, DatasetMissing
from dmotion_bench.learning.training.metrics_log import LARGEST, parse_row
from dmotion_bench.learning.training.samples import read_sample, samples_of
from dmotion_bench.specs import EnvSpec
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.json_file import JsonUnreadable, read_json
from dmotion_bench.storage.manifest import Manifest
from dmotion_bench.storage.mcap_reader import DamagedFile
from dmotion_bench.storage.shard import LABELS, VIDEO, scan_shard, shard_count, shard_path
from dmotion_bench.storage.tables import EpisodeTable
from dmotion_bench.viewing.curves import NO_LOSSES, ROOT, STEP, VALIDATION
from dmotion_bench.viewing.labels import ACTION_COLORS, log_legend, plain
from dmotion_bench.viewing.scene import FRAME, picture_view
from dmotion_bench.viewing.tracks import Color, log_images, log_rings
from dmotion_bench.wording import shown
from dmotion_bench.workspace import RUN_MANIFEST

MOST_SHARDS = 4
"""New shards that are shown at a time; of more the last ones."""

_log = logging.getLogger(__name__)


class Follower(Protocol):
    """Shows what is new in a folder."""

    @property
    def title(self) -> str: ...

    @property
    def done(self) -> bool: ...

    def blueprint(self) -> rrb.Blueprint: ...

    def start(self, recording: rr.RecordingStream) -> None:
        """Log what does not change."""

    def poll(self, recording: rr.RecordingStream) -> bool:
        """Log what is new since the last call; returns whether there was anything new."""


class TrainingFollower:
    """Shows a run's losses and the pictures of its predictions as they come.

    Args:
        run: Its folder; may be empty as yet.
    """

    def __init__(self, run: Path) -> None:
        self.run, self.title = run, run.name
        self._read, self._last, self._colors = 0, -1, dict[str, Color]()

    def blueprint(self) -> rrb.Blueprint:
        """Losses and predictions side by side, speed and rate below."""
        plots = rrb.Horizontal(
            rrb.TimeSeriesView(origin=f"{ROOT}/learning_rate", name="Learning rate"),
            rrb.TimeSeriesView(origin=f"{ROOT}/triplets_per_s", name="Triplets/s"),
        )
        losses = rrb.TimeSeriesView(origin=f"{ROOT}/losses", name="Losses", plot_legend=rrb.Corner2D.RightTop)
        samples = rrb.Spatial2DView(
            origin=f"{ROOT}/samples", name="Frame before, true next frame, prediction at the last validation"
        )
        return _blueprint(rrb.Vertical(rrb.Horizontal(losses, samples), plots, row_shares=[2.5, 1]), STEP, None)

    def start(self, recording: rr.RecordingStream) -> None:
        """Log nothing: there is nothing before the first step."""

    def poll(self, recording: rr.RecordingStream) -> bool:
        """Log new rows of ``metrics.jsonl`` and new pictures."""
        new = False
        for step, row in self._rows():
            recording.set_time(STEP, sequence=step)
            for name, value in row.items():
                path = f"{ROOT}/{name}" if name in NO_LOSSES else f"{ROOT}/losses/{name}"
                if name not in self._colors:
                    recording.log(path, self._line(name), static=True)
                recording.log(path, rr.Scalars([value]))
            new = True
        for step, picture in samples_of(self.run).items():
            if step > self._last:
                recording.set_time(STEP, sequence=step)
                recording.log(f"{ROOT}/samples", rr.Image(read_sample(picture)))
                self._last, new = step, True
        return new

    @property
    def done(self) -> bool:
        """Whether the training has ended."""
        try:
            return read_json(self.run / RUN_MANIFEST).get("result") is not None
        except (OSError, JsonUnreadable):
            return False

    def _rows(self) -> list[tuple[int, dict[str, float]]]:
        """The new complete rows; all rows if the file has become shorter, as after resuming a run."""
        metrics = self.run / "metrics.jsonl"
        if not metrics.is_file():
            return []
        if metrics.stat().st_size < self._read:
            self._read = 0
        with metrics.open("rb") as file:
            file.seek(self._read)
            whole, _, _ = file.read(LARGEST).rpartition(b"\n")
        self._read += len(whole) + bool(whole)
        rows = [row for line in io.BytesIO(whole) if (row := parse_row(line)) is not None]
        return [(step, {name: one for name, one in row.items() if math.isfinite(one)}) for step, row in rows]

    def _line(self, name: str) -> rr.SeriesLines:
        """The look of a curve: a loss has one colour, in validation with a wider line."""
        base = name.removeprefix(VALIDATION)
        known = [one for one in self._colors if not one.startswith(VALIDATION)]
        number = known.index(base) if base in known else len(known)
        self._colors[name] = ACTION_COLORS[number % len(ACTION_COLORS)]
        words = plain(base) + (", validation" if base != name else "")
        return rr.SeriesLines(names=[words], colors=[self._colors[name]], widths=[3.0 if base != name else 1.5])


class RecordingFollower:
    """Shows one episode of each shard of a data set as it is written.

    Args:
        dataset: Its folder; may be empty as yet.
        spec: Of what is recorded.
    """

    def __init__(self, dataset: Path, spec: EnvSpec) -> None:
        self.dataset, self.spec, self.title = dataset, spec, dataset.name
        self._seen, self._frame = set[int](), 0

    def blueprint(self) -> rrb.Blueprint:
        """The camera, and how much there is."""
        camera = picture_view("/recording/camera", "An episode of each new shard", self.spec.width, self.spec.height)
        progress = rrb.Vertical(
            rrb.TimeSeriesView(origin="/recording/shards", name="Shards written"),
            rrb.TimeSeriesView(origin="/recording/pushes", name="Steps of the episode that push an object"),
            rrb.TextDocumentView(origin="/recording/about", name="Last episode"),
        )
        return _blueprint(rrb.Horizontal(camera, progress, column_shares=[1.6, 1]), FRAME, 1e9 / self.spec.step_ns)

    def start(self, recording: rr.RecordingStream) -> None:
        """Name and colour the things."""
        log_legend(recording, self.spec)
        for name in ("shards", "pushes"):
            look = rr.SeriesPoints(names=[name], colors=[ACTION_COLORS[0]], markers=["circle"], marker_sizes=[4.0])
            recording.log(f"/recording/{name}", look, static=True)

    def poll(self, recording: rr.RecordingStream) -> bool:
        """Log an episode of each new shard, of many new ones of the last few."""
        try:
            manifest = Manifest.read(self.dataset)
        except DatasetMissing:  # it is being made
            return False
        there = [
            number
            for number in range(shard_count(manifest.recipe))
            if all(shard_path(self.dataset, kind, number).is_file() for kind in (VIDEO, LABELS))
        ]
        new = [number for number in there if number not in self._seen]
        self._seen.update(new)
        for number in new[-MOST_SHARDS:]:
            try:
                self._show(recording, manifest, number, shards=len(self._seen))
            except (DamagedFile, DatasetError, OSError) as error:  # it is gone again, or damaged: others can be shown
                _log.warning("shard %s of %s is not shown: %s", number, shown(str(self.dataset)), error)
        return bool(new)

    @property
    def done(self) -> bool:
        """Whether the recording has ended."""
        try:
            return Manifest.read(self.dataset).complete
        except DatasetMissing:
            return False

    def _show(self, recording: rr.RecordingStream, manifest: Manifest, number: int, shards: int) -> None:
        receipt = scan_shard(self.dataset, manifest.spec, number)
        part = Dataset(self.dataset, manifest, EpisodeTable.of(receipt.rows[:1]))
        frames, states = part.video(0), part.states(0)
        log_images(recording, "/recording/camera", frames, first=self._frame)
        pixel = np.concatenate([states.objects.pixel, states.agent.pixel], axis=1)
        log_rings(recording, "/recording/camera/places", pixel, first=self._frame)
        recording.set_time(FRAME, sequence=self._frame)
        recording.log("/recording/shards", rr.Scalars([float(shards)]))
        recording.log("/recording/pushes", rr.Scalars([float(states.pushed.sum())]))
        text = (
            f"**{self.title}**: shard {number}, episode {receipt.rows[0].episode}, {len(frames)} frames, "
            f"{int(states.pushed.sum())} of {len(states.pushed)} steps push an object. "
            f"{shards} of {shard_count(manifest.recipe)} shards are written."
        )
        recording.log("/recording/about", rr.TextDocument(text, media_type="text/markdown"))
        self._frame += len(frames)


def _blueprint(layout: rrb.Container, timeline: str, fps: float | None) -> rrb.Blueprint:
    return rrb.Blueprint(
        layout,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(
            state="collapsed", timeline=timeline, fps=fps, play_state="following" if fps is None else "playing"
        ),
        auto_layout=False,
        auto_views=False,
    )
