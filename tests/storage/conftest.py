"""Recordings to import."""

from __future__ import annotations

from pathlib import Path

import pytest
from foxglove.mcap import MCAPWriteOptions
from storage.foreign import foxglove_file, steady, video


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sound recording of another implementation; read only."""
    return foxglove_file(
        tmp_path_factory.mktemp("good") / "a.mcap", video(12), steady(12), options=MCAPWriteOptions(chunk_size=10_000)
    )
