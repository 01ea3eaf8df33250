"""HDF5 that is damaged, declares what is not there, or leads to another file."""

from __future__ import annotations

import random
from pathlib import Path

import h5py
import numpy as np
import pytest
from storage.foreign import video
from storage.hdf5_files import OPTIONS, aloha, filled_up, packed, refused, robomimic

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.importing import import_recordings


@pytest.mark.slow
def test_damaged_packed_pictures(tmp_path: Path) -> None:
    files = packed(video(5), "PNG")
    several = [*files[:3], *packed(video(2, 24, 32), "PNG")]
    refused(aloha(tmp_path / "a.hdf5", several), "mixes picture sizes: 32x32 pixels at first, 32x24 in '/observations")
    cut = aloha(tmp_path / "b.hdf5", [*files[:3], files[3][:60], files[4]])
    refused(cut, "b.hdf5' is damaged: picture 3 of '/observations/images/cam_high' is a damaged PNG file")
    lost = aloha(tmp_path / "c.hdf5", filled_up([*files[:2], np.zeros(9, np.uint8), files[4]]))
    refused(lost, "c.hdf5' is damaged: picture 2 of '/observations/images/cam_high' .* are no JPEG, PNG or WebP file")
    bytes_alone = aloha(tmp_path / "d.hdf5", np.ones((5, 40), np.uint8))
    refused(bytes_alone, "has no pictures .*are:\n  action 5 x 14 float64\n.*\n  observations/images/cam_high 5 x 40")


@pytest.mark.slow
def test_a_file_cannot_lead_to_another(tmp_path: Path) -> None:
    frames = video(4)
    robomimic(tmp_path / "secret.h5", {"demo_0": frames})
    (tmp_path / "secret.raw").write_bytes(frames.tobytes())
    with h5py.File(tmp_path / "linked.h5", "w") as file:
        file["data/demo_0/obs/image"] = h5py.ExternalLink("secret.h5", "/data/demo_0/obs/agentview_image")
    refused(tmp_path / "linked.h5", "has no pictures .*; in '/data/demo_0' are: no data sets")
    with h5py.File(tmp_path / "outside.h5", "w") as file:
        external = [(str(tmp_path / "secret.raw"), 0, h5py.h5f.UNLIMITED)]
        file.create_dataset("data/demo_0/obs/image", (4, 32, 32, 3), np.uint8, external=external)
    refused(tmp_path / "outside.h5", "keeps '/data/demo_0/obs/image' in another file")
    with h5py.File(tmp_path / "virtual.h5", "w") as file:
        layout = h5py.VirtualLayout((4, 32, 32, 3), np.uint8)
        layout[:] = h5py.VirtualSource(str(tmp_path / "secret.h5"), "data/demo_0/obs/agentview_image", (4, 32, 32, 3))
        file.create_virtual_dataset("data/demo_0/obs/image", layout)
    refused(tmp_path / "virtual.h5", "keeps '/data/demo_0/obs/image' in another file")


def test_the_rate_of_another_file_does_not_count(tmp_path: Path) -> None:
    robomimic(tmp_path / "secret.h5", {"demo_0": video(4)}, control_freq=40)
    with h5py.File(tmp_path / "linked.h5", "w") as file:
        file["data"] = h5py.ExternalLink("secret.h5", "/data")
        file["observations/images/cam_high"] = video(4)
    report = import_recordings([tmp_path / "linked.h5"], tmp_path / "out", OPTIONS)
    assert (report.frames, report.source_hz) == (4, OPTIONS.hz)
    assert any("was assumed" in one for one in report.advice)


def test_a_file_that_leads_in_circles(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        inner = file.create_group("data/demo_0/obs")
        inner["again"] = file["data"]
        inner["root"] = file["/"]
    refused(tmp_path / "a.h5", "has no pictures")


@pytest.mark.slow
def test_what_a_file_declares_is_not_believed(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        shape = (10**9, 32, 32, 3)
        file.create_dataset("data/demo_0/obs/image", shape, np.uint8, chunks=(1, 32, 32, 3), compression="gzip")
    refused(tmp_path / "a.h5", "declares more than the 20,000,000 pictures")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file.create_dataset("data/demo_0/obs/image", (3, 20_000, 20_000, 3), np.uint8, chunks=(1, 10, 10, 3))
    refused(tmp_path / "b.h5", "declares pictures of 20000x20000 pixels")
    with h5py.File(tmp_path / "c.h5", "w") as file:
        file.create_dataset("data/demo_0/obs/image", (90_000, 64, 64, 3), np.uint8, chunks=(90_000, 64, 64, 3))
    refused(tmp_path / "c.h5", "has chunks of 1,055 MiB")
    for name, chunks in (("d", None), ("e", (10, 32, 32, 3))):
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            file.create_dataset("data/demo_0/obs/image", (10_000, 32, 32, 3), np.uint8, chunks=chunks)
        refused(tmp_path / f"{name}.h5", "declares 10,000 pictures in .*image' and holds fewer")


@pytest.mark.slow
def test_mixed_sizes_and_missing_pictures(tmp_path: Path) -> None:
    file = robomimic(tmp_path / "a.hdf5", {"demo_0": video(3), "demo_1": video(3, 24, 32)})
    refused(file, "mixes picture sizes: 32x32 pixels at first, 32x24 in '/data/demo_1/obs/agentview_image'")
    with h5py.File(file, "a") as opened:
        del opened["data/demo_1/obs"]
    refused(file, "lacks 'obs/agentview_image' in '/data/demo_1'")


def test_a_cut_file(tmp_path: Path) -> None:
    file = robomimic(tmp_path / "a.hdf5", {"demo_0": video(30)})
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    refused(file, "a.hdf5' (cannot be read|is damaged)")


@pytest.mark.slow
@pytest.mark.parametrize("rows", ["pixels", "varying"])
def test_a_changed_byte_never_surprises(tmp_path: Path, rows: str) -> None:
    if rows == "pixels":
        file = robomimic(tmp_path / "a.hdf5", {"demo_0": video(4), "demo_1": video(4)}, compression="gzip")
    else:
        file = aloha(tmp_path / "a.hdf5", packed(video(6, 8, 8), "PNG"))
    whole = file.read_bytes()
    for seed in range(15):
        chance, content = random.Random(seed), bytearray(whole)
        for _ in range(4):
            content[chance.randrange(len(content))] = chance.randrange(256)
        file.write_bytes(content)
        try:
            import_recordings([file], tmp_path / f"out{seed}", OPTIONS)
        except RecordingImportError:
            assert not (tmp_path / f"out{seed}").exists()
