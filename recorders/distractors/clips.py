"""The user's own clips as a background.

A folder of videos is read once, when a recording is asked for: by the bounded readers of ``dmbench data import``, at
10 pictures a second, cropped to a square, in muted colours. The result lies in the workspace, in ``clips/``, under the
SHA-256 of its bytes. This hash, never a path, stands in a recipe: so a recipe decides the bytes of its data set, and a
recipe from elsewhere cannot make anybody read a folder.
"""

from __future__ import annotations

import hashlib
import re
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import safetensors.numpy
from jaxtyping import Int64, UInt8
from safetensors import SafetensorError

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.storage.atomic import write_atomically
from dmotion_bench.wording import shown
from dmotion_bench.workspace import Workspace
from recorders.distractors.background import Blend, muted

EDGE: Final = 6  # [px] kept around a picture for the camera to shake
SIZE: Final = 128 + 2 * EDGE
MOST_PICTURES: Final = 2000  # of all clips together; each may give as many as the others
FEWEST_PICTURES: Final = 2  # of one clip
STEP_NS: Final = 100_000_000
_LARGEST: Final = MOST_PICTURES * (SIZE * SIZE * 3 + 8) + 2**16  # bytes of a file
_HASH: Final = re.compile(r"[0-9a-f]{64}")


class Pictures(NamedTuple):
    """Prepared clips, one after the other.

    Attributes:
        frames: RGB, 0-255, muted.
        lengths: How many of them belong to each clip.
    """

    frames: UInt8[np.ndarray, "n h w 3"]
    lengths: Int64[np.ndarray, " c"]


def prepared_clips(given: str) -> str:
    """The hash of clips: of a folder or file of videos, which are read and kept in the workspace.

    Args:
        given: A path; a hash is taken as it is.

    Raises:
        RecordingImportError: There is nothing, or nothing that can be read.
        InvalidSetting: No clip has two pictures.
    """
    if _HASH.fullmatch(given):
        return given
    content = safetensors.numpy.save(_read(Path(given).expanduser())._asdict())
    digest = hashlib.sha256(content).hexdigest()
    file = _file(digest)
    if not file.is_file():
        write_atomically(file, content)
    return digest


def load_clips(digest: str) -> Pictures:
    """Prepared clips out of the workspace.

    Raises:
        InvalidSetting: They are not there, or are not those of the hash.
    """
    if not _HASH.fullmatch(digest):
        raise InvalidSetting(
            f"clips={shown(digest)} is no SHA-256 of prepared clips; 'dmbench record' with '--set clips=FOLDER' "
            "prepares those of a folder."
        )
    return _loaded(_file(digest), digest)


@lru_cache(maxsize=2)
def _loaded(file: Path, digest: str) -> Pictures:
    again = "give 'dmbench record' the folder of the videos with '--set clips=FOLDER' to prepare them again"
    try:
        with file.open("rb") as opened:
            content = opened.read(_LARGEST + 1)
    except OSError:
        raise InvalidSetting(f"the clips of the recipe are not here: there is no {str(file)!r}; {again}.") from None
    if hashlib.sha256(content).hexdigest() != digest:
        raise InvalidSetting(f"{str(file)!r} does not hold the clips of the recipe, its hash is another one; {again}.")
    try:
        found = safetensors.numpy.load(content)
        pictures = Pictures(found["frames"], found["lengths"])
    except (SafetensorError, KeyError, ValueError) as error:
        raise InvalidSetting(f"{str(file)!r} holds no clips: {str(error)[:100]}; {again}.") from None
    frames, lengths = pictures
    shaped = frames.dtype == np.uint8 and frames.shape[1:] == (SIZE, SIZE, 3)
    counted = lengths.dtype == np.int64 and lengths.ndim == 1 and len(lengths) > 0
    if not (shaped and counted and lengths.min() >= FEWEST_PICTURES and lengths.sum() == len(frames)):
        raise InvalidSetting(f"{str(file)!r} holds no clips of {SIZE} x {SIZE} pixels; {again}.")
    return pictures


def _file(digest: str) -> Path:
    return Workspace.current().root.absolute() / "clips" / f"{digest}.safetensors"


def _read(folder: Path) -> Pictures:
    from dmotion_bench.storage.imports.confinement import Confinement  # what only this needs loads here
    from dmotion_bench.storage.imports.fitting import Fit, fitted
    from dmotion_bench.storage.imports.limits import ImportLimits
    from dmotion_bench.storage.imports.options import ImportOptions
    from dmotion_bench.storage.imports.search import sources_in
    from dmotion_bench.storage.imports.sources import open_recording

    options = ImportOptions(size=SIZE, limits=ImportLimits(frames=1_000_000))
    clips = []
    with Confinement(options) as confinement:
        sources = sources_in([folder], None)
        most = max(FEWEST_PICTURES, MOST_PICTURES // len(sources))
        for source in sources:
            recording = open_recording(source, options, confinement)
            for number, segment in enumerate(recording.survey().segments):
                times = segment.times_ns - segment.times_ns[0]
                moments = np.arange(0, int(times[-1]) + 1, STEP_NS)[:most]
                wanted = np.unique(np.searchsorted(times, moments, side="right") - 1)
                frames = [muted(fitted(picture, SIZE, Fit.CROP)) for picture in recording.pictures(number, wanted)]
                if len(frames) >= FEWEST_PICTURES:
                    clips.append(np.stack(frames))
    if not clips:
        raise InvalidSetting(
            f"no video in {str(folder)!r} lasts two pictures at {1e9 / STEP_NS:g} a second; a background needs motion."
        )
    lengths = np.cumsum([len(clip) for clip in clips])
    kept = int(np.searchsorted(lengths, MOST_PICTURES, side="right"))  # a recording may have several segments
    chosen = clips[: max(1, kept)]
    together = np.ascontiguousarray(np.concatenate(chosen))  # safetensors writes memory as it lies
    return Pictures(together, np.array([len(clip) for clip in chosen], np.int64))


class Clip:
    """One clip, played forward, then backward, then forward again.

    Args:
        generator: Of random numbers; they choose the clip, where it begins, and whether it is mirrored.
        pictures: To choose from.
        share: How much of the background it makes up.
    """

    def __init__(self, generator: np.random.Generator, pictures: Pictures, *, share: float) -> None:
        number = int(generator.integers(len(pictures.lengths)))
        stop = int(pictures.lengths[: number + 1].sum())
        self._frames = pictures.frames[stop - int(pictures.lengths[number]) : stop]
        if generator.random() < 0.5:
            self._frames = self._frames[:, :, ::-1]
        self._start, self._blend = int(generator.integers(len(self._frames))), Blend(share)

    def lay(
        self, behind: UInt8[np.ndarray, "h w 3"], moment: int, shift: tuple[int, int]
    ) -> UInt8[np.ndarray, "h w 3"]:
        """The clip as it stands at the moment, over ``behind``."""
        last = len(self._frames) - 1
        number = last - abs((self._start + moment) % (2 * last) - last)
        height, width = behind.shape[:2]
        top, left = EDGE - shift[1], EDGE - shift[0]
        part = self._frames[number, top : top + height, left : left + width]
        return self._blend.mixed(behind, self._blend.faded(part))
