"""Damaged episodes of a recording that holds several: refused with the way to leave them out, or left out and named."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator, Sequence

from dmotion_bench.errors import RecordingImportError, RecordingNotFetched

Size = tuple[int, int]


class EpisodeFaults:
    """The faults of a recording's episodes.

    Args:
        skip: Leave damaged episodes out.
        several: Whether the recording has more than one episode, so that some may be left.

    Attributes:
        skipped: Each episode that is left out, and why.
    """

    def __init__(self, *, skip: bool, several: bool) -> None:
        self._skip, self._several = skip, several
        self.skipped: list[tuple[str, str]] = []

    @contextlib.contextmanager
    def of(self, episode: str) -> Iterator[None]:
        """Read an episode.

        Raises:
            RecordingImportError: It is damaged, and damaged ones are not to be left out.
        """
        try:
            yield
        except RecordingImportError as error:
            if self._skip:
                self.skipped.append((episode, str(error)))
            elif self._several and not isinstance(error, RecordingNotFetched):
                raise type(error)(f"{error} Leave such episodes out with '--skip-damaged'.") from error
            else:
                raise

    def of_usual_size(self, episodes: Sequence[str], sizes: Sequence[Size]) -> list[int]:
        """The places of the episodes whose pictures have the size that most have; the others are noted.

        Args:
            episodes: Their names; at least one.
            sizes: Height and width of each one's pictures [px].
        """
        (height, width), count = Counter(sizes).most_common(1)[0]
        for episode, size in zip(episodes, sizes, strict=True):
            if size != (height, width):
                odd = f"has pictures of {size[1]}x{size[0]} pixels, and {count} of the episodes have {width}x{height}"
                self.skipped.append((episode, f"{episode} {odd}."))
        return [place for place, size in enumerate(sizes) if size == (height, width)]

    def nothing_left(self) -> RecordingImportError:
        """The error for a recording whose episodes are all damaged."""
        return RecordingImportError(
            f"none of the {len(self.skipped)} episodes can be imported; the first one: {self.skipped[0][1]}"
        )
