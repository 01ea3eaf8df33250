"""``dmbench data export``: a data set in the format of another tool."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dmotion_bench.cli.options import AsJson
from dmotion_bench.cli.stdout import print_json
from dmotion_bench.errors import Interrupted, UnknownName

if TYPE_CHECKING:
    from dmotion_bench.storage.dataset import Dataset
    from dmotion_bench.storage.exports.lerobot import ExportReport
    from dmotion_bench.storage.video.codecs import Codec

FORMATS = ("lerobot",)


def register(data: typer.Typer) -> None:
    """Add the command to the group ``data``."""
    data.command("export")(data_export)


def data_export(
    dataset: Annotated[
        Path | None, typer.Argument(help="The data set, by path or name. Default: the only one of the workspace.")
    ] = None,
    format_: Annotated[
        str,
        typer.Option(
            "--format", metavar="[lerobot]", help="Format to write. lerobot is LeRobot's format v3: parquet and video."
        ),
    ] = "lerobot",
    codec: Annotated[
        str,
        typer.Option(
            metavar="[h264|av1]",
            help="Video codec. h264 keeps every pixel. av1 is LeRobot's default: smaller, but lossy.",
        ),
    ] = "h264",
    video_only: Annotated[
        bool, typer.Option("--video-only", help="Export the video without actions and positions.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder to write. Default: exports/NAME-lerobot.")] = None,
    as_json: AsJson = False,
) -> None:
    """Write a data set in the format of another tool, such as LeRobot.

    The command also decodes the video that it wrote and prints how much the codec lost.
    """
    from dmotion_bench.storage.dataset import Dataset
    from dmotion_bench.storage.video.codecs import CODECS
    from dmotion_bench.workspace import Workspace

    for option, given, allowed in (("format", format_, FORMATS), ("codec", codec, tuple(CODECS))):
        if given not in allowed:
            raise UnknownName(option, given, allowed)
    workspace = Workspace.current()
    source = Dataset.open(workspace.dataset(dataset))
    folder = out or workspace.root / "exports" / f"{source.name}-lerobot"
    report = _export_with_progress(source, folder, CODECS[codec], labels=not video_only)
    if as_json:
        print_json(dataclasses.asdict(report) | {"path": str(report.path), "lossless": not report.mse})
    else:
        typer.echo(_summary(report))


def _export_with_progress(dataset: Dataset, folder: Path, codec: Codec, *, labels: bool) -> ExportReport:
    from dmotion_bench.cli.progress import note, progress_bar
    from dmotion_bench.storage.exports.lerobot import export_lerobot, has_labels

    os.environ.setdefault("SVT_LOG", "1")  # the AV1 encoder talks on stderr, past every log
    if labels and not has_labels(dataset):
        note("the data set has no labels, so only its video is exported.")
        labels = False
    with progress_bar() as bar:
        task = bar.add_task("writing", total=None, status="")

        def progress(what: str, done: int, total: int) -> None:
            bar.update(task, description=what, completed=done, total=total)

        try:
            return export_lerobot(dataset, folder, codec=codec, labels=labels, progress=progress)
        except KeyboardInterrupt:
            raise Interrupted(
                "interrupted; the unfinished export was removed. Run the same command again to start over."
            ) from None


def _summary(report: ExportReport) -> str:
    if report.mse:
        loss = f"loses an MSE of {report.mse:.3f} (PSNR {report.psnr:.1f} dB, at worst {report.largest_error} of 255)"
    else:
        loss = "is lossless (MSE 0, every frame decoded and compared)"
    return "\n".join(
        [
            f"{report.path}",
            f"  {report.episodes} episodes, {report.frames} frames{', with actions' if report.labels else ''}",
            f"  the video ({report.codec}, {report.video_bytes / max(report.frames, 1):.0f} bytes a frame) {loss}",
        ]
    )
