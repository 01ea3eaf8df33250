"""The file names in a built leaderboard's folder: the page, the schema, the entries and their shared files."""

from __future__ import annotations

from typing import Final

from dmotion_bench.sharing import wanted

PAGE: Final = "index.html"
SCHEMA: Final = wanted.SCHEMA
ENTRIES: Final = wanted.ENTRIES
CHOSEN: Final = "chosen.toml"
"""Which rows a front page shows; written by hand, where there is one."""
REFERENCES: Final = "references"
"""In the entries' folder."""
