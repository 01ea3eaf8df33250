"""HDF5 files as the scripts of robomimic and ALOHA write them."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from PIL import Image

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions

OPTIONS = ImportOptions(size=32)
CAM_HIGH = "observations/images/cam_high"


def robomimic(
    path: Path,
    demonstrations: Mapping[str, np.ndarray],
    *,
    actions: Mapping[str, Sequence[Any]] | None = None,
    control_freq: float | None = None,
    picture: str = "obs/agentview_image",
    **packing: Any,
) -> Path:
    """A file as robomimic's scripts write it."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = sum(map(len, demonstrations.values()))
        if control_freq is not None:
            data.attrs["env_args"] = json.dumps({"env_name": "Lift", "env_kwargs": {"control_freq": control_freq}})
        for name, frames in demonstrations.items():
            group = data.create_group(name)
            group.attrs["num_samples"] = len(frames)
            group.create_dataset(picture, data=frames, **packing)
            group.create_dataset("obs/robot0_eef_pos", data=np.zeros((len(frames), 3)))
            given = actions[name] if actions is not None else np.zeros((len(frames), 7))
            group.create_dataset("actions", data=given)
    return path


def imported(file: Path, options: ImportOptions = OPTIONS) -> Dataset:
    return Dataset.open(import_recordings([file], file.parent / "out", options).path)


def refused(file: Path, match: str, options: ImportOptions = OPTIONS) -> None:
    with pytest.raises(RecordingImportError, match=match):
        import_recordings([file], file.parent / "out", options)
    assert not (file.parent / "out").exists()


def packed(frames: np.ndarray, form: str, **options: Any) -> list[np.ndarray]:
    """Each picture as the bytes of a file."""
    files = []
    for frame in frames:
        Image.fromarray(frame).save(file := io.BytesIO(), form, **options)
        files.append(np.frombuffer(file.getvalue(), np.uint8))
    return files


def filled_up(files: Sequence[np.ndarray]) -> np.ndarray:
    """Rows of one length, as ALOHA's scripts write them: with zeros behind each file."""
    longest = max(map(len, files))
    return np.stack([np.pad(file, (0, longest - len(file))) for file in files])


def aloha(path: Path, rows: Any, **packing: Any) -> Path:
    """An episode as ALOHA's scripts write it; rows that are a list are of variable length."""
    with h5py.File(path, "w") as file:
        if isinstance(rows, list):
            kept = file.create_dataset(CAM_HIGH, (len(rows),), h5py.vlen_dtype(np.uint8), **packing)
            for number, row in enumerate(rows):
                kept[number] = row
        else:
            file.create_dataset(CAM_HIGH, data=rows, **packing)
        file.create_dataset("action", data=np.zeros((len(rows), 14)))
        file.create_dataset("compress_len", data=np.zeros((1, len(rows))))
    return path
