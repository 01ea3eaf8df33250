"""What a built leaderboard's folder holds: the page, the entries' schema, and the entries."""

from __future__ import annotations

from typing import Final

PAGE: Final = "index.html"
SCHEMA: Final = "schema.json"
ENTRIES: Final = "entries"
