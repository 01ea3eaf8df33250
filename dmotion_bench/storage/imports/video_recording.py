"""A video file as a recording: MP4, QuickTime, MKV, WebM or AVI, one segment.

It is decoded twice: once for the time of every picture that is whole, once for those that are wanted. The number of
packets says too little (hidden pictures, edit lists, dropped ones), and decoding takes a fifth of what making a frame
out of a picture does.
"""

from __future__ import annotations

import hashlib
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Int64, UInt8

from dmotion_bench.errors import RecordingImportError, RecordingTruncated
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.recording import Segment, Survey, steady_times, told_of_harm
from dmotion_bench.storage.video.file import VideoFile
from dmotion_bench.wording import counted


class VideoRecording:
    """One video file.

    Args:
        path: The file.
        camera: Number of the video stream; None for the only one.
        source_hz: Pictures a second, in place of the times in the file.
        limits: What the file may make us do.
        salvage: Take what stands before a cut, and leave damaged pictures out.
    """

    def __init__(
        self, path: Path, *, camera: str | None, source_hz: float | None, limits: ImportLimits, salvage: bool = False
    ) -> None:
        self.path, self._camera, self._source_hz, self._limits, self._salvage = path, camera, source_hz, limits, salvage
        self.unreadable = 0

    def sha256(self) -> str:
        """Of the whole file."""
        with self.path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def survey(self, progress: Callable[[int], None] = lambda pictures: None) -> Survey:
        """Decode the file once.

        Raises:
            RecordingImportError: As the file deserves it.
        """
        times = array("q")
        with self._opened() as video:
            complete, interlaced = True, 0
            for t_ns, frame in video.frames():
                video.check_size(frame)
                interlaced += frame.interlaced_frame
                complete = complete and t_ns is not None
                times.append(t_ns or 0)
                if len(times) > self._limits.frames:
                    raise RecordingImportError(
                        f"the video {str(self.path)!r} has more than the {self._limits.frames:,} pictures that can be "
                        "imported at once; cut it into several files."
                    )
                progress(len(times))
            self.unreadable = video.damaged
            segment = Segment(times_ns=self._times(video, times, complete))
            return Survey(
                camera=self._camera or "video",
                height=video.height,
                width=video.width,
                segments=[segment],
                told=[
                    *([told_of_harm(self.path, segment.times_ns)] if video.is_harmed else []),
                    *self._told_of_shape(video),
                    *self._told_of_fields(interlaced, len(times)),
                ],
            )

    def pictures(self, segment: int, wanted: Int64[np.ndarray, " m"]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Decode the file up to the last wanted picture."""
        numbers = iter(wanted.tolist())
        number = next(numbers, None)
        if number is None:
            return
        with self._opened() as video:
            for count, (_, frame) in enumerate(video.frames()):
                if count == number:
                    yield video.rgb(frame)
                    number = next(numbers, None)
                    if number is None:
                        return
        raise RecordingImportError(f"{str(self.path)!r} changed while it was imported; import it again.")

    def _told_of_shape(self, video: VideoFile) -> list[str]:
        """What is told of pictures that players show wider or narrower than they are stored."""
        if video.pixel_aspect == 1:
            return []
        return [
            f"the pixels of {str(self.path)!r} are not square ({video.pixel_aspect.numerator}:"
            f"{video.pixel_aspect.denominator}), and its pictures are imported as they are stored, out of proportion; "
            "'ffmpeg -i IN -vf scale=iw*sar:ih,setsar=1 OUT.mkv' makes a video that is not."
        ]

    def _told_of_fields(self, interlaced: int, count: int) -> list[str]:
        """What is told of pictures whose odd and even rows may have been taken one after the other."""
        if not interlaced:
            return []
        return [
            f"{interlaced:,} of {counted(count, 'picture')} in {str(self.path)!r} are marked as interlaced: if their "
            "odd and even rows were taken one after the other, the edges of what moves look like combs. "
            "'ffmpeg -i IN -vf bwdif -crf 1 OUT.mkv' makes a video without, with twice as many pictures a second."
        ]

    def _opened(self) -> VideoFile:
        """The file; one that is cut off is only said to be salvageable if it is.

        Raises:
            RecordingImportError: As the file deserves it.
        """
        try:
            return self._open(self._salvage)
        except RecordingTruncated as cut:
            try:
                self._open(salvage=True).close()
            except RecordingImportError:  # an MP4 file whose index stood behind the cut
                raise RecordingTruncated(
                    f"the video {str(self.path)!r} is cut off: it is shorter than it says, and nothing in it can be "
                    "read without what is missing, such as the index at the end of an MP4 file. Copy it again."
                ) from cut
            raise

    def _open(self, salvage: bool) -> VideoFile:
        return VideoFile(self.path, camera=self._camera, pixels=self._limits.pixels, salvage=salvage)

    def _times(self, video: VideoFile, found: array[int], complete: bool) -> Int64[np.ndarray, " n"]:
        """When each picture was taken, from the first one on [ns]."""
        if self._source_hz is not None:
            return steady_times(len(found), self._source_hz, self.path)
        times = np.array(found, np.int64)
        if not complete:
            if video.rate is None:
                raise RecordingImportError(
                    f"the video {str(self.path)!r} says neither when its pictures were taken nor how many a second; "
                    "say it with '--source-hz'."
                )
            return steady_times(len(found), video.rate, self.path)
        if not video.has_times:  # the times are of packets, which AVI keeps in another order than that of the pictures
            times.sort()
        back = np.flatnonzero(np.diff(times) < 0)
        if len(back):
            raise RecordingImportError(
                f"the video {str(self.path)!r} goes back in time by "
                f"{(times[back[0]] - times[back[0] + 1]) / 1e9:.3f} s at picture {back[0] + 1}; say how many pictures "
                "a second it has with '--source-hz', which takes them in their order."
            )
        since_first: Int64[np.ndarray, " n"] = times - times[0]
        return since_first
