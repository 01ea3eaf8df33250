"""What a built leaderboard's folder holds: the page, the entries' schema, the entries and what they share."""

from __future__ import annotations

from typing import Final

PAGE: Final = "index.html"
SCHEMA: Final = "schema.json"
ENTRIES: Final = "entries"
CHOSEN: Final = "chosen.toml"
"""Which rows a front page shows; written by hand, where there is one."""
REFERENCES: Final = "references"
"""In the entries' folder."""
