"""``dmbench data export``: a data set in the format of another tool."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dmotion_bench.api.settings import require_one_of
from dmotion_bench.cli.options import AsJson
from dmotion_bench.cli.stdout import print_json, say
from dmotion_bench.errors import Interrupted
from dmotion_bench.wording import counted

if TYPE_CHECKING:
    from dmotion_bench.storage.exports.lerobot import ExportReport


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
    from dmotion_bench.api.importing import export_dataset
    from dmotion_bench.cli.progress import note, progress_bar

    require_one_of("format", format_, FORMATS)
    with progress_bar() as bar:
        try:
            report = export_dataset(
                dataset,
                codec=codec,
                labels=False if video_only else None,
                out=out,
                progress=bar.tell,
            )
        except KeyboardInterrupt:
            raise Interrupted(
                "interrupted; the unfinished export was removed. Run the same command again to start over."
            ) from None
    if not (report.labels or video_only):
        note("the data set has no labels, so only its video was exported.")
    if as_json:
        print_json(dataclasses.asdict(report) | {"path": str(report.path), "lossless": not report.mse})
    else:
        say(_summary(report))


def _summary(report: ExportReport) -> str:
    if report.mse:
        loss = f"loses an MSE of {report.mse:.3f} (PSNR {report.psnr:.1f} dB, at worst {report.largest_error} of 255)"
    else:
        loss = "is lossless (MSE 0, every frame decoded and compared)"
    held = f"{counted(report.episodes, 'episode')}, {counted(report.frames, 'frame')}"
    return "\n".join(
        [
            f"{report.path}",
            f"  {held}{', with actions' if report.labels else ''}",
            f"  the video ({report.codec}, {report.video_bytes / max(report.frames, 1):.0f} bytes a frame) {loss}",
        ]
    )
