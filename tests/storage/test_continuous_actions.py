"""Continuous actions on disk: every number comes back as it was, and one that cannot be is refused."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from noise_world import (
    LEFT_RIGHT,
    MOVES,
    assert_same_episode,
    files_of,
    noise_episode,
    noise_lengths,
    noise_spec,
    write_noise,
)

from dmotion_bench.actions import actions_to_json
from dmotion_bench.errors import DatasetCorrupt, InvalidSetting, UsageError
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.check import check_dataset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.writer import DatasetWriter

SPEC = noise_spec(actions=MOVES)


@pytest.fixture
def written(tmp_path: Path) -> Dataset:
    return write_noise(tmp_path / "noise", spec=SPEC)


def test_episodes_come_back_as_they_were_written(written: Dataset) -> None:
    assert written.spec == SPEC
    for number, frames in enumerate(noise_lengths(len(written))):
        assert_same_episode(written.episode(number), noise_episode(number, frames, SPEC))
        assert written.states(number).actions.dtype == np.float64
    assert not check_dataset(written.path).damages


def test_the_same_recipe_makes_the_same_bytes(written: Dataset, tmp_path: Path) -> None:
    assert files_of(written.path) == files_of(write_noise(tmp_path / "again", spec=SPEC).path)


def test_with_other_bounds_it_is_the_same_data_set(written: Dataset) -> None:
    narrower = dataclasses.replace(
        MOVES, low=tuple(one / 4 for one in MOVES.low), high=tuple(h / 4 for h in MOVES.high)
    )
    read = written.bounded(narrower)
    assert (read.spec.actions, read.manifest.spec.actions) == (narrower, MOVES)
    assert read.fingerprint == written.fingerprint
    for number in range(len(written)):
        np.testing.assert_array_equal(read.states(number).actions, written.states(number).actions)
        np.testing.assert_array_equal(read.labels(number).actions, written.labels(number).actions)
    for others in ({"names": ("x", "y")}, {"units": ("mm", "mm")}):
        with pytest.raises(UsageError, match="name the same ones with other bounds"):
            written.bounded(dataclasses.replace(MOVES, **others))


def test_every_mcap_library_reads_them(written: Dataset) -> None:
    expected = noise_episode(0, noise_lengths(1)[0], SPEC).labels
    with (written.path / "labels" / "shard-00000.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        messages = list(reader.iter_decoded_messages(topics=["/action"]))[: len(expected.actions)]
    assert {one.schema.name for one in messages} == {"dmbench.ContinuousAction"}
    assert [list(one.decoded_message.values) for one in messages] == expected.actions.tolist()
    assert [one.decoded_message.pushed for one in messages] == expected.pushed.tolist()


@pytest.mark.parametrize(
    ("value", "said"), [(np.nan, "'turn' = nan at step 1"), (1.6, "'turn' = 1.6 at step 1; it can")]
)
def test_what_cannot_be_is_refused_before_anything_is_written(tmp_path: Path, value: float, said: str) -> None:
    episode = noise_episode(0, 4, SPEC)
    actions = episode.labels.actions.copy()
    actions[1, 1] = value
    wrong = dataclasses.replace(episode, labels=dataclasses.replace(episode.labels, actions=actions))
    recipe = DatasetRecipe(environment="noise", episodes=1, frames=4)
    with DatasetWriter.create_or_resume(tmp_path / "a", recipe, SPEC) as writer:
        with pytest.raises(InvalidSetting, match=f"an episode of 'noise' holds {said}"):
            writer.write_shard(0, [wrong])
        assert not list((tmp_path / "a").rglob("*.mcap*"))


@pytest.mark.parametrize("said", ["discrete", "continuous"])
def test_labels_of_another_kind_than_the_manifest_says_are_refused(tmp_path: Path, said: str) -> None:
    """Protobuf itself would read a continuous action as the discrete action 0."""
    true, told = (LEFT_RIGHT, MOVES) if said == "continuous" else (MOVES, LEFT_RIGHT)
    path = write_noise(tmp_path / "noise", spec=noise_spec(actions=true)).path
    manifest = json.loads((path / "dataset.json").read_text())
    manifest["environment"]["actions"] = actions_to_json(told)
    (path / "dataset.json").write_text(json.dumps(manifest))
    forged = Dataset.open(path)
    for read in (forged.states, forged.labels, forged.episode):
        with pytest.raises(DatasetCorrupt, match=rf"that is no .*Action, the type of {said} actions, and data"):
            read(0)
    assert any("shard-00000.mcap" in str(damage) for damage in check_dataset(path).damages)


def _narrow(environment: dict[str, Any]) -> None:
    environment["actions"]["high"][1] = 0.01


def _longer(environment: dict[str, Any]) -> None:
    for name, value in (("names", "z"), ("low", -1.0), ("high", 1.0), ("units", "m")):
        environment["actions"][name].append(value)


@pytest.mark.parametrize(
    ("forge", "said"),
    [
        (_narrow, r"it holds 'turn' = \S+ at step \d; it can be 0 to 0.01 rad"),
        (_longer, r"it holds action \[.*\] at step 0"),
    ],
)
def test_labels_that_contradict_the_data_set_are_damaged(written: Dataset, forge: Any, said: str) -> None:
    file = written.path / "dataset.json"
    content = json.loads(file.read_text())
    forge(content["environment"])
    file.write_text(json.dumps(content))
    forged = Dataset.open(written.path)
    with pytest.raises(DatasetCorrupt, match=said):
        _ = [forged.states(number) for number in range(len(forged))]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"low": [0.0]}, "give as many of each"),
        ({"low": [1.0, 0.0]}, "must be below the upper"),
        ({"names": ["a", "a"]}, "same name"),
        ({"high": [1e999, 1.0]}, "dataset.json"),
    ],
)
def test_a_specification_that_cannot_be_is_refused(written: Dataset, change: dict[str, Any], said: str) -> None:
    file = written.path / "dataset.json"
    content = json.loads(file.read_text())
    content["environment"]["actions"].update(change)
    file.write_text(json.dumps(content))
    with pytest.raises(DatasetCorrupt, match=said):
        Dataset.open(written.path)
