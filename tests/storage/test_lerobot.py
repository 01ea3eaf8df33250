"""LeRobot's format v3: what is exported keeps its pixels and actions, and what is damaged is named.

That LeRobot itself loads such a folder was checked with lerobot 0.4.4 in an environment of its own (see
decision 011); here stand the facts that it relies on.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from av.video.reformatter import Interpolation
from noise_world import noise_spec, write_noise
from storage.foreign import foxglove_file, steady, video
from walking_square import SPEC, record_walks
from walking_square import episode as walk

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import LabelsNotAvailable, RecordingImportError, UsageError
from dmotion_bench.specs import DatasetRecipe, unplaced_labels
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.exports.lerobot import ExportReport, export_lerobot, has_labels
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.video.codecs import AV1
from dmotion_bench.storage.writer import DatasetWriter

CAMERA = "observation.images.camera"
KINDS = {"int64": pa.int64(), "float32": pa.float32()}


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Four episodes of different lengths with actions."""
    folder = tmp_path_factory.mktemp("source")
    times = [t_ns + 10_000_000_000 * (number >= 13) for number, t_ns in enumerate(steady(24))]
    actions = [(t_ns, ("left", "right", "up")[number % 3]) for number, t_ns in enumerate(times)]
    file = foxglove_file(folder / "a.mcap", video(24, 48, 48), times, actions=actions)
    options = ImportOptions(size=48, frames_per_episode=7, actions="/action")
    import_recordings([file], folder / "data", options)
    dataset = Dataset.open(folder / "data")
    assert dataset.lengths.tolist() == [6, 7, 6, 5]
    return dataset


@pytest.fixture(scope="module")
def exported(source: Dataset, tmp_path_factory: pytest.TempPathFactory) -> ExportReport:
    return export_lerobot(source, tmp_path_factory.mktemp("exported") / "lerobot")


def info_of(report: ExportReport) -> dict[str, Any]:
    info: dict[str, Any] = json.loads((report.path / "meta/info.json").read_text())
    return info


def test_the_default_codec_loses_nothing(source: Dataset, exported: ExportReport) -> None:
    assert (exported.mse, exported.largest_error, exported.episodes, exported.frames) == (0.0, 0, 4, 24)
    with av.open(str(exported.path / f"videos/{CAMERA}/chunk-000/file-000.mp4")) as file:
        decoded = np.stack([frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)])
        assert float(file.streams.video[0].average_rate) == 10
    np.testing.assert_array_equal(decoded, np.concatenate([source.video(episode) for episode in range(4)]))


def test_a_lossy_codec_s_loss_is_measured(source: Dataset, tmp_path: Path) -> None:
    report = export_lerobot(source, tmp_path / "lossy", codec=AV1)
    with av.open(str(report.path / f"videos/{CAMERA}/chunk-000/file-000.mp4")) as file:
        flags = (
            Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.FULL_CHR_H_INT | Interpolation.BITEXACT
        )
        decoded = np.stack([one.to_ndarray(format="rgb24", interpolation=flags) for one in file.decode(video=0)])
    frames = np.concatenate([source.video(episode) for episode in range(4)])
    assert report.mse == pytest.approx(np.square(decoded.astype(float) - frames).mean())
    assert report.mse > 1
    assert report.largest_error == np.abs(decoded.astype(int) - frames).max()


@pytest.mark.slow
def test_back_again(source: Dataset, exported: ExportReport, tmp_path: Path) -> None:
    options = ImportOptions(size=48, actions="action")
    report = import_recordings([exported.path], tmp_path / "back", options)
    back = Dataset.open(tmp_path / "back")

    assert report.actions == source.spec.actions == Discrete(("left", "right", "up"))
    assert back.lengths.tolist() == source.lengths.tolist()
    for episode in range(4):
        np.testing.assert_array_equal(back.video(episode), source.video(episode))
        np.testing.assert_array_equal(back.states(episode).actions, source.states(episode).actions)


def test_a_size_that_a_codec_cannot_take_is_said_whole(tmp_path: Path) -> None:
    noise = write_noise(tmp_path / "noise", episodes=1, shard_episodes=1, spec=noise_spec(height=5, width=6))
    with pytest.raises(UsageError, match="av1 needs even sizes, not 6x5; use '--codec h264'"):
        export_lerobot(noise, tmp_path / "lerobot", codec=AV1)


def test_a_position_that_nothing_tells_is_no_feature(tmp_path: Path) -> None:
    """As in data sets of Gymnasium's environments: NaN would spoil whatever learns from it."""
    recipe = DatasetRecipe(environment="walk", episodes=2, frames=4, shard_episodes=2)
    with DatasetWriter.create_or_resume(tmp_path / "walks", recipe, SPEC) as writer:
        made = [walk(number, 4) for number in range(2)]
        labels = [unplaced_labels(one.labels.actions, one.frames.shape[:3]) for one in made]
        writer.write_shard(0, [replace(one, labels=its) for one, its in zip(made, labels, strict=True)])
        writer.finish()
    exported = export_lerobot(Dataset.open(tmp_path / "walks"), tmp_path / "lerobot")

    assert "action" in info_of(exported)["features"]
    assert "observation.state" not in info_of(exported)["features"]
    assert "observation.state" not in parquet.read_schema(exported.path / "data/chunk-000/file-000.parquet").names
    assert "NaN" not in (exported.path / "meta/stats.json").read_text()
    placed = export_lerobot(Dataset.open(record_walks(tmp_path / "placed", episodes=2)), tmp_path / "with")
    assert info_of(placed)["features"]["observation.state"]["shape"] == [3]


@pytest.mark.slow
def test_actions_keep_their_numbers_and_order(tmp_path: Path) -> None:
    walks = Dataset.open(record_walks(tmp_path / "walks", episodes=3))
    exported = export_lerobot(walks, tmp_path / "lerobot")
    import_recordings([exported.path], tmp_path / "back", ImportOptions(size=32, actions="action"))
    back = Dataset.open(tmp_path / "back")

    assert back.spec.actions == walks.spec.actions == Discrete(("up", "down", "left", "right"))
    for episode in range(3):
        np.testing.assert_array_equal(back.states(episode).actions, walks.states(episode).actions)


@pytest.mark.parametrize("names", [["up", 0.5, "left"], ["up", "\x1b[31m", "left"], [None, "a", "b"]])
def test_names_of_actions_that_are_none_are_refused(
    exported: ExportReport, tmp_path: Path, names: list[object]
) -> None:
    copy = damaged(exported, tmp_path)
    info = info_of(exported)
    info["features"]["action"]["dmbench_actions"] = names
    (copy / "meta/info.json").write_text(json.dumps(info))
    refused(copy, tmp_path, "no choice out of a few.*dmbench_actions", ImportOptions(size=48, actions="action"))


@pytest.mark.slow
def test_a_camera_is_found_by_the_last_part_of_its_name(exported: ExportReport, tmp_path: Path) -> None:
    import_recordings([exported.path], tmp_path / "found", ImportOptions(size=48, camera="camera"))
    assert Dataset.open(tmp_path / "found").recipe.parameters["camera"] == CAMERA

    copy, info = damaged(exported, tmp_path), info_of(exported)
    info["features"]["second.camera"] = info["features"][CAMERA]
    (copy / "meta/info.json").write_text(json.dumps(info))
    import_recordings([copy], tmp_path / "only", ImportOptions(size=48))  # the other camera's videos are not there
    assert Dataset.open(tmp_path / "only").recipe.parameters["camera"] == CAMERA
    (copy / "videos/second.camera/chunk-000").mkdir(parents=True)
    (copy / "videos/second.camera/chunk-000/file-000.mp4").touch()
    refused(copy, tmp_path, "more than one camera 'camera'", ImportOptions(camera="camera"))
    refused(copy, tmp_path, "has 2 cameras; choose one with '--camera KEY': .*'second.camera'")
    refused(copy, tmp_path, "has no camera 'amera'", ImportOptions(camera="amera"))


def test_the_table_s_columns_are_the_features(source: Dataset, exported: ExportReport) -> None:
    info, table = info_of(exported), parquet.read_table(exported.path / "data/chunk-000/file-000.parquet")
    features = {key: feature for key, feature in info["features"].items() if feature["dtype"] != "video"}
    assert set(table.column_names) == set(features)
    for key, feature in features.items():
        kind = KINDS[feature["dtype"]]
        assert table.schema.field(key).type == (kind if feature["shape"] == [1] else pa.list_(kind, *feature["shape"]))

    assert table["index"].to_pylist() == list(range(24))
    assert table["episode_index"].to_pylist() == [0] * 6 + [1] * 7 + [2] * 6 + [3] * 5
    frame = np.array(table["frame_index"])
    np.testing.assert_allclose(np.array(table["timestamp"]), frame / 10, atol=1e-6)  # LeRobot allows 1e-4
    actions = np.concatenate([np.append(source.states(e).actions, source.states(e).actions[-1]) for e in range(4)])
    np.testing.assert_array_equal(np.array(table["action"]), actions)


def test_the_episodes_table_says_where_each_stands(exported: ExportReport) -> None:
    rows = parquet.read_table(exported.path / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    start = 0
    for number, row in enumerate(rows):
        assert row["episode_index"] == number
        assert (row["dataset_from_index"], row["dataset_to_index"]) == (start, start + row["length"])
        assert row[f"videos/{CAMERA}/from_timestamp"] == pytest.approx(start / 10)
        assert row[f"videos/{CAMERA}/to_timestamp"] == pytest.approx((start + row["length"]) / 10)
        assert row[f"stats/{CAMERA}/count"] == [row["length"]]
        assert {row[key] for key in row if key.endswith(("chunk_index", "file_index"))} == {0}
        start += row["length"]
    assert start == info_of(exported)["total_frames"]
    assert info_of(exported)["splits"] == {"train": "0:4"}


def test_statistics_are_those_of_the_data(source: Dataset, exported: ExportReport) -> None:
    stats = json.loads((exported.path / "meta/stats.json").read_text())
    assert set(stats) == set(info_of(exported)["features"])
    pixels = np.concatenate([source.video(episode) for episode in range(4)]).reshape(-1, 3) / 255
    expected = {"min": pixels.min(0), "max": pixels.max(0), "mean": pixels.mean(0), "std": pixels.std(0)}
    for name, values in expected.items():
        assert np.array(stats[CAMERA][name]).shape == (3, 1, 1)
        np.testing.assert_allclose(np.array(stats[CAMERA][name]).reshape(3), values, rtol=1e-9)
    for name, share in (("q01", 1), ("q50", 50), ("q99", 99)):
        found = np.percentile(pixels, share, axis=0)
        np.testing.assert_allclose(np.array(stats[CAMERA][name]).reshape(3), found, atol=1 / 255)
    index = np.arange(24)
    np.testing.assert_allclose(stats["index"]["mean"] + stats["index"]["std"], [index.mean(), index.std()])


def test_tasks_are_indexed_as_pandas_does_it(exported: ExportReport) -> None:
    table = parquet.read_table(exported.path / "meta/tasks.parquet")
    assert json.loads(table.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]
    assert table.to_pylist() == [{"task_index": 0, "__index_level_0__": "imported: recorded"}]


def test_video_alone(source: Dataset, tmp_path: Path) -> None:
    report = export_lerobot(source, tmp_path / "video", labels=False)
    assert "action" not in info_of(report)["features"]
    assert not report.labels


def test_missing_labels_are_said(tmp_path: Path) -> None:
    import_recordings(
        [foxglove_file(tmp_path / "a.mcap", video(4), steady(4))], tmp_path / "data", ImportOptions(size=32)
    )
    dataset = Dataset.open(tmp_path / "data")
    assert not has_labels(dataset)
    with pytest.raises(LabelsNotAvailable):
        export_lerobot(dataset, tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "data"]


def test_a_data_set_is_no_place_for_its_export(source: Dataset) -> None:
    with pytest.raises(UsageError, match="lies in the data set itself"):
        export_lerobot(source, source.path / "out")
    assert not (source.path / "out.exporting").exists()


@pytest.mark.parametrize("step_ns", [1_000, 3_000_000_000_000])
def test_a_rate_that_no_video_has_is_refused(tmp_path: Path, step_ns: int) -> None:
    dataset = write_noise(tmp_path / "d", episodes=1, spec=replace(noise_spec(8, 8), step_ns=step_ns))
    with pytest.raises(UsageError, match=r"a video cannot hold a frame every .* s; it can be one every 0.0001 s to "):
        export_lerobot(dataset, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("step_ns", [100_000, 1_000_000_000_000])
def test_the_extreme_rates_of_videos_lose_nothing(tmp_path: Path, step_ns: int) -> None:
    dataset = write_noise(tmp_path / "d", episodes=2, spec=replace(noise_spec(8, 8), step_ns=step_ns))
    assert export_lerobot(dataset, tmp_path / "out", labels=False).mse == 0


def test_a_folder_that_is_there_is_not_touched(source: Dataset, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="is there already; name another folder"):
        export_lerobot(source, tmp_path)


def damaged(exported: ExportReport, tmp_path: Path) -> Path:
    """A copy to damage."""
    copy = tmp_path / "copy"
    for file in exported.path.rglob("*"):
        if file.is_file():
            target = copy / file.relative_to(exported.path)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read_bytes())
    return copy


def refused(path: Path, folder: Path, match: str, options: ImportOptions | None = None) -> None:
    with pytest.raises(RecordingImportError, match=match):
        import_recordings([path], folder / "out", options or ImportOptions(size=48))
    assert [one.name for one in folder.iterdir() if one.name.startswith("out")] == []


@pytest.mark.slow
def test_a_missing_feature_lists_those_there_are(exported: ExportReport, tmp_path: Path) -> None:
    refused(exported.path, tmp_path, f"its cameras are: '{CAMERA}'", ImportOptions(camera="front"))
    near = r"did you mean 'action'\? Its features are: action, episode_index"
    refused(exported.path, tmp_path, near, ImportOptions(actions="actoin"))


def test_an_older_format_is_named(exported: ExportReport, tmp_path: Path) -> None:
    copy = damaged(exported, tmp_path)
    (copy / "meta/info.json").write_text(json.dumps(info_of(exported) | {"codebase_version": "v1.6"}))
    refused(copy, tmp_path, "'v1.6'; v2 and v3 can be read")


@pytest.mark.slow
def test_paths_in_info_are_not_followed(exported: ExportReport, tmp_path: Path) -> None:
    copy = damaged(exported, tmp_path)
    (copy / "meta/info.json").write_text(json.dumps(info_of(exported) | {"video_path": "/etc/{video_key}"}))
    import_recordings([copy], tmp_path / "fine", ImportOptions(size=48))
    info = info_of(exported)
    info["features"] = {"../../escaped": info["features"][CAMERA]}
    (copy / "meta/info.json").write_text(json.dumps(info))
    refused(copy, tmp_path, r"has no camera: a feature .* its features are: '../../escaped' \('video'\)\.")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "match"),
    [
        ("meta/info.json", "damaged info.json"),
        ("meta/episodes/chunk-000/file-000.parquet", "damaged table 'file-000.parquet'"),
        (
            f"videos/{CAMERA}/chunk-000/file-000.mp4",
            "is cut off: it is shorter than it says\\. Leave such episodes out",
        ),
    ],
)
def test_a_cut_file_is_named(exported: ExportReport, tmp_path: Path, file: str, match: str) -> None:
    copy = damaged(exported, tmp_path)
    (copy / file).write_bytes((copy / file).read_bytes()[:-1000])
    refused(copy, tmp_path, match)


@pytest.mark.slow
def test_a_video_shorter_than_its_table(source: Dataset, exported: ExportReport, tmp_path: Path) -> None:
    copy = damaged(exported, tmp_path)
    table = parquet.read_table(copy / "meta/episodes/chunk-000/file-000.parquet")
    for column, values, match in (
        (f"videos/{CAMERA}/from_timestamp", [0, 0.6, 1.3, 2.0], "lacks a picture at 2.400 s, which its data set lists"),
        (f"videos/{CAMERA}/from_timestamp", [0, 0.6, 1.3, 20], "lacks a picture at 20.000 s, which its data set lists"),
        ("length", [6, 7, 6, 50], "lacks rows of episode 3"),
    ):
        changed = table.set_column(table.column_names.index(column), column, pa.array(values))
        parquet.write_table(changed, copy / "meta/episodes/chunk-000/file-000.parquet")
        refused(copy, tmp_path, match)


@pytest.mark.slow
def test_an_episode_that_is_listed_twice_is_refused(exported: ExportReport, tmp_path: Path) -> None:
    copy = damaged(exported, tmp_path)
    file = copy / "meta/episodes/chunk-000/file-000.parquet"
    table = parquet.read_table(file)
    parquet.write_table(pa.concat_tables([table, table.slice(2, 1)]), file)
    refused(copy, tmp_path, "describes the episode 2 more than once")


@pytest.mark.slow
def test_continuous_actions_are_refused(exported: ExportReport, tmp_path: Path) -> None:
    copy = damaged(exported, tmp_path)
    table = parquet.read_table(copy / "data/chunk-000/file-000.parquet")
    place = table.column_names.index("action")
    for values in (pa.array(np.linspace(0, 1, 24)), pa.array([[0.5, 0.5]] * 24)):
        parquet.write_table(table.set_column(place, "action", values), copy / "data/chunk-000/file-000.parquet")
        refused(copy, tmp_path, "no choice out of a few", ImportOptions(size=48, actions="action"))
