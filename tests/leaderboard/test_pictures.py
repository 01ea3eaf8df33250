"""Pictures: the same steps for every model, and nothing of a foreign file but its pixels."""

from __future__ import annotations

import base64
import dataclasses
import io
import struct
import zlib
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image, PngImagePlugin

from dmotion_bench.errors import EntryInvalid
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace
from leaderboard.entry import Entry
from leaderboard.pictures import choose_steps, from_png, shown, take_pictures, to_png


def test_every_model_is_shown_at_the_same_steps(scored_workspace: Workspace) -> None:
    chosen = [choose_steps(pq.read_table(run / "report/samples.parquet")) for run in scored_workspace.all_runs()]

    assert chosen[0] == chosen[1] == chosen[2]
    assert {step.pushed for step in chosen[0]} == {True, False}
    assert len({(step.episode, step.step) for step in chosen[0]}) == len(chosen[0]) <= 5


def test_they_show_what_they_say(scored_workspace: Workspace, sound: Entry) -> None:
    dataset = Dataset.open(scored_workspace.data / "grid_world-tiny")

    assert sound.pictures
    for picture in sound.pictures:
        frames, step = dataset.video(picture["episode"]), picture["step"]
        np.testing.assert_array_equal(from_png(picture["current"]), frames[step])
        np.testing.assert_array_equal(from_png(picture["truth"]), frames[step + 1])
        np.testing.assert_array_equal(from_png(picture["predicted"]), frames[step])  # its model changes nothing
        action = dataset.states(picture["episode"]).actions[step]
        assert picture["action"] == dataset.spec.actions.names[action]
        assert picture["pushed"] == dataset.states(picture["episode"]).pushed[step]


def test_png_loses_nothing() -> None:
    frame = np.random.default_rng(0).integers(0, 256, (17, 23, 3)).astype(np.uint8)

    np.testing.assert_array_equal(from_png(to_png(frame)), frame)


def test_what_travels_with_a_picture_is_left_behind() -> None:
    told = PngImagePlugin.PngInfo()
    told.add_text("Comment", "<script>")
    file = io.BytesIO()
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(file, "PNG", pnginfo=told)
    file.write(b"and what follows the end")
    given = base64.b64encode(file.getvalue()).decode()

    clean = base64.b64decode(shown(given).removeprefix("data:image/webp;base64,"), validate=True)

    assert b"script" not in clean
    assert b"follows" not in clean


def test_a_page_shows_a_picture_as_it_is(sound: Entry) -> None:
    given = sound.pictures[0]["predicted"]

    source = shown(given)

    webp = base64.b64decode(source.removeprefix("data:image/webp;base64,"), validate=True)
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(webp))), from_png(given))


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _png(width: int, height: int, body: bytes = b"") -> bytes:
    head = _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + _chunk(b"IDAT", zlib.compress(body)) + _chunk(b"IEND", b"")


@pytest.mark.parametrize(
    "raw",
    [
        b"",
        b"GIF89a" + bytes(60),
        b"<svg xmlns='http://www.w3.org/2000/svg' onload='alert(1)'/>" + bytes(20),
        _png(100_000, 100_000),
        _png(0, 4),
        _png(64, 64, b"too short"),
        b"\x89PNG\r\n\x1a\n" + b"\0\0\0\rIHDR",
    ],
)
def test_what_is_no_picture_is_refused(raw: bytes) -> None:
    with pytest.raises(EntryInvalid, match="picture"):
        from_png(base64.b64encode(raw).decode())


def test_what_is_no_base64_is_refused() -> None:
    for text in ("'\"><script>", "====", "a"):
        with pytest.raises(EntryInvalid):
            from_png(text)


def test_a_model_of_no_pixels_has_no_pictures(
    scored_workspace: Workspace, monkeypatch: pytest.MonkeyPatch, sound: Any
) -> None:
    run = Run.open(scored_workspace.runs / sound.name)
    monkeypatch.setattr(type(run.model), "needs_pixels", False)
    samples = pq.read_table(run.path / "report/samples.parquet")

    assert take_pictures(run, Dataset.open(run.dataset_path), samples) == []


def test_a_model_has_its_pictures_once_whatever_its_budgets(scored_workspace: Workspace, sound: Entry) -> None:
    run = Run.open(scored_workspace.runs / sound.name)
    samples, dataset = pq.read_table(run.path / "report/samples.parquet"), Dataset.open(run.dataset_path)

    for labels, any_shown in (("one-shot", True), ("5-shot", False), ("100%", True), ("10%", False)):
        run.spec = dataclasses.replace(run.spec, labels=labels)
        assert bool(take_pictures(run, dataset, samples)) is any_shown


def test_where_actions_are_not_known_no_step_is_shown(scored_workspace: Workspace) -> None:
    samples = pq.read_table(scored_workspace.all_runs()[0] / "report/samples.parquet")
    unknown = pa.nulls(len(samples), samples.schema.field("action").type)

    assert choose_steps(samples)
    assert choose_steps(samples.set_column(samples.schema.get_field_index("action"), "action", unknown)) == []
