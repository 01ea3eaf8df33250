"""Data sets that somebody forged, with hashes that are right: refused in a sentence before memory is set aside."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from noise_world import noise_spec, write_noise

from dmotion_bench.errors import DatasetCorrupt, DatasetError, InvalidSetting
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.check import check_dataset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.limits import most_frames
from dmotion_bench.storage.mcap_reader import DamagedFile, MessageView
from dmotion_bench.storage.messages import decode_states, encode_states
from dmotion_bench.storage.parquet_pages import list_pages
from dmotion_bench.storage.schema import ACTION, FACTORS, STATES
from dmotion_bench.storage.shard import shard_path
from dmotion_bench.storage.writer import DatasetWriter
from dmotion_bench.workspace import DATASET_MANIFEST

Content = dict[str, Any]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_noise(tmp_path_factory.mktemp("forged") / "d").path


@pytest.fixture
def path(sound: Path, tmp_path: Path) -> Path:
    """A copy to be forged."""
    return Path(shutil.copytree(sound, tmp_path / "d"))


def change_manifest(path: Path, change: Callable[[Content], object]) -> None:
    content = json.loads((path / DATASET_MANIFEST).read_text())
    change(content)
    (path / DATASET_MANIFEST).write_text(json.dumps(content))


def rehash(path: Path, name: str) -> None:
    """Let dataset.json say that a table is as it should be."""
    raw = (path / name).read_bytes()
    facts = {"size": len(raw), "sha256": hashlib.sha256(raw).hexdigest()}
    change_manifest(path, lambda content: content["tables"].update({name: facts}))


def replace_table(path: Path, name: str, table: pa.Table, **options: Any) -> None:
    pq.write_table(table, path / name, compression="zstd", **options)
    rehash(path, name)


def refused(path: Path, said: str) -> None:
    with pytest.raises(DatasetCorrupt, match=said) as caught:
        Dataset.open(path).tasks()
    assert len(str(caught.value)) < 1500
    assert "dmbench" in str(caught.value)


@pytest.mark.slow
def test_a_table_of_more_rows_than_episodes_is_not_read(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three million equal rows take 187 KB in the file and took 3.2 GB in memory."""
    table = pq.read_table(path / "episodes.parquet")
    replace_table(path, "episodes.parquet", table.take(np.zeros(3_000_000, np.int64)))
    assert (path / "episodes.parquet").stat().st_size < 200_000
    monkeypatch.setattr(pq.ParquetFile, "read", lambda *_, **__: pytest.fail("it was read"))
    refused(path, "is not what was written")

    replace_table(path, "episodes.parquet", table.take(np.zeros(1000, np.int64)))
    refused(path, "has 1,000 rows; dataset.json says 7")


def test_a_manifest_that_agrees_with_such_a_table_is_refused_too(path: Path) -> None:
    def claim(episodes: int) -> Callable[[Content], None]:
        def change(content: Content) -> None:
            content["recipe"] |= {"episodes": episodes, "shard_episodes": 10_000}
            content["shards"] = [
                content["shards"][0] | {"episodes": 10_000, "frames": 10_000} for _ in range(episodes // 10_000)
            ]

        return change

    change_manifest(path, claim(3_000_000))
    refused(path, "recipe.episodes is 3,000,000; it can be 1 to 1,000,000")
    change_manifest(path, claim(1_000_000))
    refused(path, "shard 0 has 10,000 frames in a file of")


def test_a_word_that_is_a_megabyte_is_not_multiplied(path: Path) -> None:
    table = pq.read_table(path / "episodes.parquet")
    long = table.set_column(5, table.schema.field("split"), pa.array(["x" * 2**20] * len(table)))
    replace_table(path, "episodes.parquet", long)
    refused(path, "bytes for the column split of 7 rows")


def _varint(value: int) -> bytes:
    """As Thrift writes a positive number."""
    value, written = value << 1, b""
    while value > 127:
        written, value = written + bytes([value & 127 | 128]), value >> 7
    return written + bytes([value])


def test_a_page_that_is_larger_than_the_footer_says_is_not_unpacked(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """32 KB took 4 GB: a dictionary of one word that nobody uses, and a footer that claims 100 bytes."""
    table = pq.read_table(path / "episodes.parquet")
    words = pa.array(["train", "x" * (16 * 2**20)])
    column = pa.DictionaryArray.from_arrays(pa.array([0] * len(table), pa.int32()), words)
    bomb = pa.table({**{name: table[name] for name in table.schema.names}, "split": column})
    bomb = bomb.cast(pa.schema([field.with_nullable(False) for field in bomb.schema]))
    pq.write_table(bomb, path / "episodes.parquet", compression="zstd", dictionary_pagesize_limit=2**30)
    size = pq.read_metadata(path / "episodes.parquet").row_group(0).column(5).total_uncompressed_size
    assert size > 16 * 2**20 > 100 * (path / "episodes.parquet").stat().st_size
    true, raw = _varint(size), (path / "episodes.parquet").read_bytes()
    lie = bytes([100 << 1 & 127 | 128, 1 | 128]) + b"\x80" * (len(true) - 3) + b"\x00"  # of the same length
    (path / "episodes.parquet").write_bytes(raw.replace(true, lie))
    rehash(path, "episodes.parquet")
    assert pq.read_metadata(path / "episodes.parquet").row_group(0).column(5).total_uncompressed_size == 100
    monkeypatch.setattr(pq.ParquetFile, "read", lambda *_, **__: pytest.fail("it was read"))
    refused(path, "claims 16,777,[0-9]+ bytes for the column split of 7 rows")


def test_an_encoding_that_repeats_what_came_before_is_refused(path: Path) -> None:
    """Each word may take over all of the one before, so that rows cost their square."""
    table = pq.read_table(path / "episodes.parquet")
    replace_table(path, "episodes.parquet", table, use_dictionary=False, column_encoding={"split": "DELTA_BYTE_ARRAY"})
    refused(path, "column split in an encoding that is not ours")


@pytest.mark.parametrize("version", ["1.0", "2.0"])
@pytest.mark.parametrize("rows", [0, 1, 7, 50_000])
def test_the_pages_of_a_sound_table_are_found(tmp_path: Path, version: str, rows: int) -> None:
    numbers = np.random.default_rng(0).integers(0, 2**62, rows)
    table = pa.table({"a": numbers, "b": numbers % 3, "c": pa.array((numbers % 5).astype(str))})
    file = tmp_path / "t.parquet"
    pq.write_table(table, file, compression="zstd", data_page_version=version, row_group_size=20_000)
    about = pq.read_metadata(file)
    with file.open("rb") as opened:
        for group in range(about.num_row_groups):
            for index in range(3):
                column = about.row_group(group).column(index)
                start = column.dictionary_page_offset if column.has_dictionary_page else column.data_page_offset
                pages = list(list_pages(opened, start, column.total_compressed_size))
                assert sum(page.values for page in pages if not page.is_dictionary) == column.num_values
                with pytest.raises(ValueError, match="page"):
                    list(list_pages(opened, start, column.total_compressed_size - 1))
                with pytest.raises(ValueError, match="page"):
                    list(list_pages(opened, start + 1, column.total_compressed_size - 1))


@pytest.mark.parametrize("name", ["episodes.parquet", "tasks.parquet"])
@pytest.mark.parametrize(
    "change",
    [
        lambda table: table.drop_columns("episode"),
        lambda table: table.append_column("more", pa.array([1] * len(table))),
        lambda table: table.select([1, 0, *range(2, table.num_columns)]),
        lambda table: table.cast(pa.schema([field.with_nullable(True) for field in table.schema])),
        lambda table: pa.table(
            [pa.nulls(len(table), field.type) for field in table.schema],
            pa.schema([field.with_nullable(True) for field in table.schema]),
        ),
        lambda table: table.set_column(0, "episode", pa.array([0.0] * len(table))),
        lambda table: table.set_column(0, "episode", pa.array([[]] * len(table), pa.list_(pa.int64()))),
    ],
    ids=["missing", "more", "order", "nullable", "nulls", "real", "lists"],
)
def test_a_table_of_other_columns_is_refused(path: Path, name: str, change: Callable[[pa.Table], pa.Table]) -> None:
    table = pq.read_table(path / name)
    replace_table(path, name, change(table))
    refused(path, "has other columns")


def test_a_column_that_holds_columns_is_refused(path: Path) -> None:
    table = pq.read_table(path / "episodes.parquet")
    nested = pa.array([[{"word": word}] for word in table["ended"].to_pylist()])
    place = table.column_names.index("ended")
    replace_table(path, "episodes.parquet", table.set_column(place, "ended", nested))
    refused(path, "has other columns")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["episodes.parquet", "tasks.parquet"])
@settings(deadline=None, derandomize=True, max_examples=150)
@given(data=st.data())
def test_any_bytes_in_a_table_are_read_or_refused(sound: Path, name: str, data: st.DataObject) -> None:
    whole = (sound / name).read_bytes()
    manifest = (sound / DATASET_MANIFEST).read_bytes()
    spoiled = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 4))):
        spoiled[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    (sound / name).write_bytes(spoiled[: data.draw(st.integers(0, len(whole)) | st.just(len(whole)))])
    rehash(sound, name)
    try:
        opened = Dataset.open(sound)
        assert (len(opened.lengths), len(opened.tasks())) == (7, 0)
    except DatasetError as error:
        assert len(str(error)) < 1500  # noqa: PT017 (either outcome is right)
    finally:
        (sound / name).write_bytes(whole)
        (sound / DATASET_MANIFEST).write_bytes(manifest)


@pytest.mark.parametrize(
    ("column", "row", "value"),
    [
        *(("episode", 3, 4), ("shard", 1, 1), ("shard", 6, -1), ("shard", 0, 2**62)),
        *(("frames", 2, 0), ("frames", 2, 7), ("frames", 2, -(2**63)), ("frames", 2, 2**62)),
        *(("start_ns", 5, -1), ("start_ns", 5, 2**63 - 1), ("seed", 5, -1)),
        *(("split", 0, "all"), ("split", 0, ""), ("ended", 0, "exploded")),
        *(("interactions", 0, -1), ("interactions", 0, 2**40)),
        *(("video_offset", 1, -1), ("video_offset", 2, 0), ("video_offset", 0, 2**63 - 1), ("video_offset", 4, 9)),
        *(("video_bytes", 1, 0), ("video_bytes", 1, -(2**63)), ("video_bytes", 1, 2**63 - 1), ("video_bytes", 0, 5000)),
        *(("states_offset", 1, 0), ("states_bytes", 1, 2**62), ("masks_offset", 1, 10), ("masks_bytes", 6, 0)),
    ],
)
def test_a_row_that_cannot_be_is_refused(path: Path, column: str, row: int, value: object) -> None:
    table = pq.read_table(path / "episodes.parquet")
    place = table.schema.get_field_index(column)
    values = table.column(place).to_pylist()
    values[row] = value
    kind = table.schema.field(place)
    replace_table(path, "episodes.parquet", table.set_column(place, kind, pa.array(values, kind.type)))
    refused(path, "episodes.parquet' is damaged")


def test_a_time_that_exceeds_64_bits_is_refused(tmp_path: Path) -> None:
    """Four frames that are 2**62 ns apart last 2**64 ns, which 64 bits take for none."""
    path = write_noise(tmp_path / "d", episodes=1, lengths=[4]).path
    change_manifest(path, lambda content: content["recipe"].update(environment="imported"))
    change_manifest(path, lambda content: content["environment"].update(step_ns=2**62))
    refused(path, "starts at no time that a time stamp can say")


def test_spans_of_labels_that_do_not_exist_are_refused(path: Path) -> None:
    def unlabelled(content: Content) -> None:
        for shard in content["shards"]:
            shard["labels"] = None

    change_manifest(path, unlabelled)
    refused(path, "has states in a file that is not there")


@pytest.mark.parametrize(
    ("task", "said"), [((0, 0, 2**62), "outside"), ((7, 0, 1), "outside"), ((-1, 0, 1), "outside"), ((0, 1, 1), "out")]
)
def test_a_task_outside_its_episode_is_refused(path: Path, task: tuple[int, ...], said: str) -> None:
    change_manifest(path, lambda content: content["recipe"].update(tasks=1))
    schema = pq.read_schema(path / "tasks.parquet")
    columns = [pa.array([value]) for value in task]
    replace_table(path, "tasks.parquet", pa.table(columns, schema))
    refused(path, said)


def test_more_tasks_than_were_asked_for_are_refused(path: Path) -> None:
    schema = pq.read_schema(path / "tasks.parquet")
    replace_table(path, "tasks.parquet", pa.table([pa.array([0]), pa.array([0]), pa.array([1])], schema))
    refused(path, "has 1 rows; dataset.json says 0")


def _thing(number: int) -> Content:
    return {"name": f"thing {number}", "shape": "box", "color": [0, 0, 0]}


MANIFESTS: dict[str, tuple[Callable[[Content], object], str]] = {
    "threshold": (lambda c: c["environment"].update(push_threshold=10**400), "64 bits"),
    "negative threshold": (lambda c: c["environment"].update(push_threshold=-1), "push_threshold"),
    "true threshold": (lambda c: c["environment"].update(push_threshold=True), "push_threshold"),
    "surrogate": (lambda c: c["environment"].update(actions=["left", "\ud800"]), "half a character"),
    "same actions": (lambda c: c["environment"].update(actions=["left", "left"]), "same name"),
    "same objects": (lambda c: c["environment"].update(objects=[_thing(1), _thing(1)]), "same name"),
    "many actions": (lambda c: c["environment"].update(actions=[str(n) for n in range(5000)]), "5,000"),
    "long action": (lambda c: c["environment"].update(actions=["x" * 600_000]), "longer than 256"),
    "many objects": (lambda c: c["environment"].update(objects=[_thing(n) for n in range(254)]), "254"),
    "large": (lambda c: c["environment"].update(height=100_000), "height"),
    "no size": (lambda c: c["environment"].update(width=0), "width"),
    "slow": (lambda c: c["environment"].update(step_ns=2**63 - 1), "longer than the 292 years"),
    "colour": (lambda c: c["environment"]["agent"].update(color=[0, 0, True]), "color"),
    "bright": (lambda c: c["environment"]["agent"].update(color=[0, 0, 256]), "colour"),
    "deep": (lambda c: c["recipe"].update(parameters={"a": _nested(40)}), "nested deeper"),
    "parameter": (lambda c: c["recipe"].update(parameters={"a": [1]}), "parameters"),
    "frames": (lambda c: c["recipe"].update(frames=10**13), "recipe.frames"),
    "million frames": (lambda c: _claim_frames(c, 1_000_000), "1,000,000 frames in a file of"),
    "tasks": (lambda c: c["recipe"].update(tasks=10**6), "recipe.tasks"),
    "shard episodes": (lambda c: c["recipe"].update(shard_episodes=2), "lists 3 shards; its recipe makes 4"),
    "too few shards": (lambda c: c["shards"].pop(), "lists 2 shards; its recipe makes 3"),
    "episodes of a shard": (lambda c: c["shards"][0].update(episodes=2), "shard 0 has 2 episodes"),
    "frames of a shard": (lambda c: c["shards"][0].update(frames=1), "frames of shard 0"),
    "size": (lambda c: c["shards"][0]["video"].update(size=-1), "size of the video of shard 0"),
    "hash": (lambda c: c["shards"][0]["video"].update(sha256="../../x"), "hash of the video of shard 0"),
    "some labels": (lambda c: c["shards"][0].update(labels=None), "some have none"),
    "no tables": (lambda c: c.update(tables={}), "lists the tables"),
    "more tables": (lambda c: c["tables"].update({"../x": c["tables"]["tasks.parquet"]}), "lists the tables"),
    "versions": (lambda c: c["versions"].update({"v" * 300: "1"}), "longer than 256"),
}


def _nested(levels: int) -> list[Any]:
    return [_nested(levels - 1)] if levels else []


def _claim_frames(content: Content, frames: int) -> None:
    content["recipe"] |= {"frames": frames}
    content["shards"][0] |= {"frames": frames}


@pytest.mark.parametrize("name", MANIFESTS)
def test_a_manifest_that_cannot_be_true_is_refused(path: Path, name: str) -> None:
    change, said = MANIFESTS[name]
    change_manifest(path, change)
    refused(path, said)


def test_a_recording_that_could_not_be_read_is_not_begun(tmp_path: Path) -> None:
    spec = noise_spec(128, 128)
    for recipe in (
        {"episodes": 2_000_000_000, "frames": 10},
        {"episodes": 1, "frames": 10**13},
        {"episodes": 1, "frames": most_frames(spec) + 1},
        {"episodes": 1, "frames": 10, "environment": "\udcff"},
    ):
        with pytest.raises(InvalidSetting, match="there can be no such data set"):
            DatasetWriter.create_or_resume(tmp_path / "d", DatasetRecipe(**{"environment": "noise", **recipe}), spec)
        assert not (tmp_path / "d" / DATASET_MANIFEST).exists()


def test_a_data_set_that_lists_more_shards_than_are_read_is_not_begun(tmp_path: Path) -> None:
    many = DatasetRecipe(environment="noise", episodes=100_000, frames=3, shard_episodes=1)
    with pytest.raises(InvalidSetting, match=r"its dataset.json would be larger than .* with 100,000 shards"):
        DatasetWriter.create_or_resume(tmp_path / "d", many, noise_spec())


def test_an_episode_of_the_largest_size_takes_half_a_gigabyte() -> None:
    spec = noise_spec(128, 128, objects=4)
    assert most_frames(spec) * (128 * 128 * 4 + 5 * 80) <= 512 * 2**20 < (most_frames(spec) + 1) * (128 * 128 * 4 + 400)


def test_a_message_that_would_take_much_memory_is_not_parsed() -> None:
    """Two bytes make a state of a hundred bytes."""
    spec = noise_spec()
    states = b"\x12\x00" * 2**22
    with pytest.raises(DamagedFile, match=r"holds a message of 8,388,608 bytes; at most 4,\d+ can be right"):
        decode_states([MessageView(2, 0, memoryview(states))], spec, 3)
    factors = [MessageView(4, 0, memoryview(b"\x12\x80\x80\x80\x02" + b"[" * 2**22))]
    with pytest.raises(DamagedFile, match="holds a message of"):
        decode_states(factors, spec, 3)


def test_an_action_that_does_not_exist_is_damage(sound: Path) -> None:
    dataset = Dataset.open(sound)
    labels = dataset.labels(0)
    for action in (2, -1):
        first = next(place for place, one in enumerate(encode_states(labels, dataset.spec, 0, 1)) if one.channel == 1)
        views = [
            MessageView(one.channel, one.t_ns, memoryview(b"".join(one.pieces)))
            for one in encode_states(labels, dataset.spec, 0, 1)
        ]
        views[first] = views[first]._replace(data=memoryview(ACTION.new(action=action).SerializeToString()))
        with pytest.raises(DamagedFile, match=f"holds action {action}"):
            decode_states(views, dataset.spec, len(labels.masks))


def test_more_messages_than_frames_are_damage() -> None:
    spec = noise_spec(objects=0)
    act = MessageView(1, 0, memoryview(ACTION.new(action=1).SerializeToString()))
    state = MessageView(3, 0, memoryview(STATES.new().SerializeToString()))
    told = MessageView(4, 0, memoryview(FACTORS.new(json="{}").SerializeToString()))
    for views, said in (([act] * 3, "action 1"), ([state] * 4, "more than the 3"), ([told] * 2, "the factors twice")):
        with pytest.raises(DamagedFile, match=f"holds {said}"):
            decode_states(views, spec, 3)


def test_a_shard_of_endless_sections_is_damage(path: Path) -> None:
    """A metadata record of 17 bytes takes 600 bytes in memory."""
    file = shard_path(path, "video", 0)
    empty = b"\x0c" + (8).to_bytes(8, "little") + bytes(8)
    raw = file.read_bytes()
    file.write_bytes(raw[:8] + empty * 20_000)
    raw = file.read_bytes()
    facts = {"size": len(raw), "sha256": hashlib.sha256(raw).hexdigest()}
    change_manifest(path, lambda content: content["shards"][0].update(video=facts))
    (damage, *_) = [one for one in check_dataset(path).damages if one.shard == 0]
    assert damage.what == "holds more than 10,000 sections"
