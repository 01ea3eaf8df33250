"""What is written is read back, and every other MCAP reader sees the same."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from foxglove_schemas_protobuf import Point2_pb2, Pose_pb2, Quaternion_pb2, RawImage_pb2, Vector3_pb2
from google.protobuf.descriptor_pb2 import FileDescriptorProto, FileDescriptorSet
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap_protobuf.decoder import DecoderFactory
from noise_world import assert_same_episode, noise_episode, noise_lengths, noise_spec, write_noise

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.specs import DatasetRecipe, ObjectSpec
from dmotion_bench.storage import mcap_writer, messages
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.mcap_writer import LIBRARY
from dmotion_bench.storage.schema import RAW_IMAGE, STATES
from dmotion_bench.storage.shard import Footage, read_states, scan_shard, shard_path, write_shard
from dmotion_bench.storage.writer import DatasetWriter


@pytest.mark.slow
@settings(deadline=None, derandomize=True, max_examples=25)
@given(
    lengths=st.lists(st.integers(1, 6), min_size=1, max_size=5),
    shape=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    objects=st.integers(0, 3),
    shard_episodes=st.integers(1, 3),
    seed=st.integers(0, 2**32),
)
def test_what_is_written_is_read_back(
    lengths: list[int], shape: tuple[int, int], objects: int, shard_episodes: int, seed: int
) -> None:
    spec = noise_spec(*shape, objects)
    episodes = [noise_episode(seed + number, length, spec) for number, length in enumerate(lengths)]
    recipe = DatasetRecipe(
        environment="noise", episodes=len(episodes), frames=max(lengths), shard_episodes=shard_episodes
    )
    with TemporaryDirectory() as folder, DatasetWriter.create_or_resume(Path(folder) / "d", recipe, spec) as writer:
        for index in writer.missing:
            writer.write_shard(index, (episodes[number] for number in writer.episodes_of(index)))
        writer.finish()
        dataset = Dataset.open(Path(folder) / "d")
        assert dataset.lengths.tolist() == lengths
        for number, episode in enumerate(episodes):
            assert_same_episode(dataset.episode(number), episode)


def test_a_shard_says_of_itself_what_its_writer_said(tmp_path: Path) -> None:
    spec = noise_spec()
    recipe = DatasetRecipe(environment="noise", episodes=5, frames=9, shard_episodes=3)
    for index in range(2):
        members = range(3 * index, min(3 * index + 3, 5))
        written = write_shard(tmp_path, recipe, spec, index, (noise_episode(one, 9, spec) for one in members))
        assert scan_shard(tmp_path, spec, index) == written


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"factors": {"light": float("nan")}}, "factors of which no reader takes any: it holds the number 'NaN'"),
        ({"factors": {"count": 2**70}}, "factors of which no reader takes any: .* does not fit in 64 bits"),
        ({"factors": {"text": "x" * 2**20}}, "factors of which no reader takes any: it is larger than"),
        ({"actions": np.array([0, 2])}, "action 2 at step 1; there are 2, numbered from 0"),
        ({"actions": np.array([-1, 0])}, "action -1 at step 0; there are 2, numbered from 0"),
    ],
)
def test_what_could_not_be_read_again_is_not_written(changed: dict[str, object], said: str, tmp_path: Path) -> None:
    spec, recipe = noise_spec(), DatasetRecipe(environment="noise", episodes=1, frames=3)
    episode = noise_episode(0, 3, spec)
    labels = dataclasses.replace(episode.labels, **changed)
    with pytest.raises(InvalidSetting, match=f"an episode of 'noise' holds {said}"):
        write_shard(tmp_path, recipe, spec, 0, [dataclasses.replace(episode, labels=labels)])
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_a_chunk_with_the_longest_names_can_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = noise_spec(height=1, width=1)
    spec = dataclasses.replace(
        spec, objects=tuple(ObjectSpec(name=f"{n:03}" + "ü" * 253, shape="box", color=(0, 0, 0)) for n in range(20))
    )
    for module in (mcap_writer, messages):
        monkeypatch.setattr(module, "CHUNK_LIMIT", 10)
    recipe = DatasetRecipe(environment="noise", episodes=1, frames=3)
    row = write_shard(tmp_path, recipe, spec, 0, [noise_episode(0, 3, spec)]).rows[0]
    assert len(read_states(shard_path(tmp_path, "labels", 0), row.states, spec, 3).actions) == 2


def test_the_official_reader_sees_the_same(tmp_path: Path) -> None:
    dataset = write_noise(tmp_path / "d")
    with shard_path(dataset.path, "video", 0).open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        header, summary = reader.get_header(), reader.get_summary()
        messages = list(reader.iter_decoded_messages())
        metadata = [record.metadata for record in reader.iter_metadata()]
    assert (header.profile, header.library) == ("", LIBRARY)
    assert summary is not None
    assert [channel.topic for channel in summary.channels.values()] == ["/camera"]
    assert [schema.name for schema in summary.schemas.values()] == ["foxglove.RawImage"]
    assert len(summary.chunk_indexes) == 3
    assert summary.statistics is not None
    frames = np.concatenate([dataset.video(one) for one in range(3)])
    assert summary.statistics.message_count == len(messages) == len(frames)
    assert [facts["episode"] for facts in metadata] == ["0", "1", "2"]
    assert [int(facts["frames"]) for facts in metadata] == dataset.lengths[:3].tolist()
    stamps = [
        row.start_ns + number * dataset.spec.step_ns for row in dataset.rows.of_shard(0) for number in range(row.frames)
    ]
    for (_, channel, message, image), frame, stamp in zip(messages, frames, stamps, strict=True):
        assert (channel.topic, channel.message_encoding, message.log_time) == ("/camera", "protobuf", stamp)
        assert (image.width, image.height, image.encoding, image.step) == (5, 6, "rgb8", 15)
        assert image.timestamp.seconds * 10**9 + image.timestamp.nanos == stamp
        np.testing.assert_array_equal(np.frombuffer(image.data, np.uint8).reshape(frame.shape), frame)


def test_the_official_reader_sees_the_labels(tmp_path: Path) -> None:
    dataset = write_noise(tmp_path / "d")
    with shard_path(dataset.path, "labels", 0).open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        by_topic: dict[str, list[object]] = {}
        for _, channel, _, message in reader.iter_decoded_messages():
            by_topic.setdefault(channel.topic, []).append(message)
    assert set(by_topic) == {"/action", "/agent", "/objects", "/masks", "/factors"}
    labels = dataset.labels(0)
    first = by_topic["/objects"][0]
    assert [state.name for state in first.states] == ["thing 0", "thing 1"]  # type: ignore[attr-defined]
    for place, state in enumerate(first.states):  # type: ignore[attr-defined]
        position, pixel = state.pose.position, state.pixel
        np.testing.assert_array_equal((position.x, position.y, position.z), labels.objects.position[0, place])
        np.testing.assert_array_equal((pixel.x, pixel.y), labels.objects.pixel[0, place])
    actions = by_topic["/action"][: len(labels.actions)]
    assert [(one.action, one.name) for one in actions] == [  # type: ignore[attr-defined]
        (action, dataset.spec.actions.names[action]) for action in labels.actions
    ]


def test_the_video_holds_nothing_but_the_camera(tmp_path: Path) -> None:
    dataset = write_noise(tmp_path / "d")
    for index in range(3):
        with shard_path(dataset.path, "video", index).open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        assert [channel.topic for channel in summary.channels.values()] == ["/camera"]


def test_an_episode_is_one_seek_and_long_ones_have_several_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap_writer, "CHUNK_LIMIT", 100)
    dataset = write_noise(tmp_path / "d", episodes=2)
    with shard_path(dataset.path, "video", 0).open("rb") as file:
        chunks = [record for record in StreamReader(file, emit_chunks=True).records if isinstance(record, Chunk)]
    assert len(chunks) > 4
    for number in range(2):
        episode = noise_episode(number, noise_lengths(2)[number], dataset.spec)
        assert_same_episode(dataset.episode(number), episode)


def test_the_descriptors_are_foxgloves() -> None:
    """Field by field; Foxglove's own carry options and JSON names that say nothing about the bytes."""

    def fields(file: FileDescriptorProto) -> dict[str, set[tuple[str, int, int, int, str]]]:
        return {
            message.name: {(one.name, one.number, one.type, one.label, one.type_name) for one in message.field}
            for message in file.message_type
        }

    ours = {}
    for kind in (RAW_IMAGE, STATES):
        ours |= {file.name: file for file in FileDescriptorSet.FromString(kind.descriptors).file}
    for module in (RawImage_pb2, Pose_pb2, Vector3_pb2, Quaternion_pb2, Point2_pb2):
        theirs = FileDescriptorProto()
        module.DESCRIPTOR.CopyToProto(theirs)
        assert fields(ours[theirs.name]) == fields(theirs)
        assert ours[theirs.name].package == theirs.package


def test_footage_needs_no_labels(tmp_path: Path) -> None:
    spec = noise_spec()
    recipe = DatasetRecipe(environment="imported", episodes=2, frames=4, shard_episodes=2)
    footage = [Footage(frames=noise_episode(one, 4, spec).frames, start_ns=one * 10**12) for one in range(2)]
    receipt = write_shard(tmp_path, recipe, spec, 0, footage)
    assert receipt.labels is None
    assert not shard_path(tmp_path, "labels", 0).exists()
    assert [row.start_ns for row in receipt.rows] == [0, 10**12]
    assert scan_shard(tmp_path, spec, 0) == receipt


def test_labels_for_some_episodes_only_are_refused_and_nothing_is_left(tmp_path: Path) -> None:
    spec = noise_spec()
    recipe = DatasetRecipe(environment="imported", episodes=2, frames=4, shard_episodes=2)
    episode = noise_episode(0, 4, spec)
    with pytest.raises(ValueError, match="either all episodes"):
        write_shard(tmp_path, recipe, spec, 0, [episode, Footage(frames=episode.frames)])
    assert not [file for file in tmp_path.rglob("*") if file.is_file()]


def test_the_format_has_not_changed(tmp_path: Path) -> None:
    """The messages of a fixed shard, uncompressed: if these change, the format needs another number."""
    write_noise(tmp_path / "d")
    digest = hashlib.sha256()
    for kind in ("video", "labels"):
        with shard_path(tmp_path / "d", kind, 0).open("rb") as file:
            for record in StreamReader(file, emit_chunks=True).records:
                for inner in breakup_chunk(record) if isinstance(record, Chunk) else []:
                    digest.update(inner.log_time.to_bytes(8, "little") + inner.data)  # type: ignore[attr-defined]
    assert digest.hexdigest() == "baea3b9af88e3da232144eb87abba2633e65fa858065c2638cbcbf5a701df0bb"
