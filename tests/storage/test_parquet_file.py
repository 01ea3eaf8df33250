"""What stands in the place of a table and is none."""

from __future__ import annotations

import os
from pathlib import Path

import pyarrow as pa
import pytest

from dmotion_bench.storage.mcap_reader import DamagedFile
from dmotion_bench.storage.parquet_file import read_parquet


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "table.parquet")
    with pytest.raises(DamagedFile, match="is no ordinary file"):
        read_parquet(tmp_path / "table.parquet", pa.schema([("a", pa.int64())]), range(9), said_by="nobody")
