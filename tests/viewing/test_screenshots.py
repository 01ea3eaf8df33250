"""Every scene in Rerun itself, without a window: what should be drawn is drawn, and no view complains."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from made_up_report import write_made_up
from PIL import Image
from rrd_contents import layout_of

from dmotion_bench.errors import ViewerError
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing.comparison import comparison_scene
from dmotion_bench.viewing.dataset import dataset_scene
from dmotion_bench.viewing.imagination import imagine
from dmotion_bench.viewing.run import run_scene
from dmotion_bench.viewing.scene import Scene, write_scene
from dmotion_bench.viewing.screenshot import BAR, Camera, camera, has_vulkan

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not has_vulkan(), reason="no Vulkan driver: 'apt-get install mesa-vulkan-drivers'"),
]

EPISODE, FRAME, SIZE = 3, 4, 64
WIDTH, HEIGHT = 1280, 800


@pytest.fixture
def reports(run: Run, other_run: Run) -> Iterator[None]:
    folders = [write_made_up(one, {EPISODE: [10.0, 30.0], 5: [1.0, 3.0]}) for one in (run, other_run)]
    yield
    for folder in folders:
        shutil.rmtree(folder)


def shot(scene: Scene, folder: Path) -> Iterator[tuple[Camera, set[str]]]:
    """A camera on a scene, and what each of its views is of."""
    file = folder / "scene.rrd"
    write_scene(scene, file)
    origins = {
        parts["ViewBlueprint:space_origin"][0]
        for parts in layout_of(file).values()
        if "ViewBlueprint:space_origin" in parts
    }
    with camera(file, WIDTH, HEIGHT, settle=0) as viewer:
        yield viewer, origins


def picture_of(viewer: Camera, origin: str, folder: Path, frame: int = FRAME) -> np.ndarray:
    """What a view shows, as float."""
    file = folder / "view.png"
    viewer.take_view(file, origin, frame=frame)
    with Image.open(file) as opened:
        return np.asarray(opened.convert("RGB"), float)


def unlikeness(shown: np.ndarray, frame: np.ndarray) -> float:
    """Mean difference of a view's picture from a frame, which stands in its middle and may be cut off a little."""
    drawn = np.abs(shown - shown[0, 0]).max(-1) > 0  # the frame is black where there is nothing, the view is grey
    down, across = (np.flatnonzero(share > share.max() / 2) for share in (drawn.mean(1), drawn.mean(0)))
    inside = shown[down[0] : down[-1] + 1, across[0] : across[-1] + 1]
    side = max(inside.shape[:2])
    top, left = ((side - size) // 2 for size in inside.shape[:2])
    whole = np.asarray(Image.fromarray(frame).resize((side, side), Image.Resampling.NEAREST), float)
    expected = whole[top : top + inside.shape[0], left : left + inside.shape[1]]
    return float(np.abs(inside - expected).mean())


def test_a_data_set(dataset: Dataset, tmp_path: Path) -> None:
    root = f"/episode_{EPISODE}"
    for viewer, origins in shot(dataset_scene(dataset, [EPISODE, 5]), tmp_path):
        video = dataset.video(EPISODE)
        for frame in (1, 6):
            shown = picture_of(viewer, f"{root}/camera", tmp_path, frame)
            of_each = [unlikeness(shown, one) for one in video]
            assert int(np.argmin(of_each)) == frame  # rings and trails hide a little of it
            assert min(of_each) < 12
        masks = picture_of(viewer, f"{root}/masks", tmp_path)
        for color in ((0, 200, 0), (230, 30, 30), (40, 80, 255)):
            assert (np.abs(masks - color).max(-1) < 3).sum() > 50
        world = picture_of(viewer, f"{root}/world", tmp_path)
        assert (world[..., 0] > 150).any()  # the red square's dot
        lanes = picture_of(viewer, root, tmp_path)
        assert len(np.unique(lanes.reshape(-1, 3), axis=0)) > 20
        assert {origin: told for origin, told in viewer.views().items() if told} == {}
        assert set(viewer.views()) == origins
        with pytest.raises(ViewerError, match="no view is of '/nothing'"):
            viewer.take_view(tmp_path / "no.png", "/nothing", frame=0)
        with pytest.raises(ViewerError, match="no timeline 'epoch'; there are: frame"):
            viewer.take(tmp_path / "no.png", frame=0, timeline="epoch")


def test_a_run(run: Run, dataset: Dataset, reports: None, tmp_path: Path) -> None:
    root = f"/episode_{EPISODE}"
    seen = imagine(run.model, dataset.video(EPISODE), dataset.labels(EPISODE), dataset.spec)
    for viewer, origins in shot(run_scene(run, dataset, [EPISODE], {EPISODE: "worst"}), tmp_path):
        assert unlikeness(picture_of(viewer, f"{root}/camera", tmp_path), seen.frames[FRAME]) < 12
        for kind in ("one_step", "imagined"):
            frame = getattr(seen, kind).frames[FRAME - 2]
            assert unlikeness(picture_of(viewer, f"{root}/{kind}/frame", tmp_path), frame) < 12
        plot = picture_of(viewer, f"{root}/mse", tmp_path)
        for color in ((86, 180, 233), (230, 159, 0), (140, 140, 140)):
            assert (np.abs(plot - color).max(-1) < 12).sum() > 20, color
        for tab, origin in (("Training", "/training/chart"), ("Report", "/report/rollout_mse")):
            viewer.tab(tab)
            drawn = picture_of(viewer, origin, tmp_path)
            assert (np.ptp(drawn, axis=-1) > 60).sum() > 100  # coloured lines on grey
        assert {origin: told for origin, told in viewer.views().items() if told} == {}
        assert set(viewer.views()) == origins


def test_several_runs(run: Run, other_run: Run, dataset: Dataset, reports: None, tmp_path: Path) -> None:
    root = f"/episode_{EPISODE}"
    scene = comparison_scene([run, other_run], dataset, [EPISODE], {EPISODE: "worst"})
    models = (run.model, other_run.model)
    seen = [imagine(model, dataset.video(EPISODE), dataset.labels(EPISODE), dataset.spec) for model in models]
    for viewer, origins in shot(scene, tmp_path):
        for number in (0, 1):
            for kind in ("one_step", "imagined"):
                shown = picture_of(viewer, f"{root}/model_{number}/{kind}/frame", tmp_path)
                own, others = (
                    unlikeness(shown, getattr(seen[n], kind).frames[FRAME - 2]) for n in (number, 1 - number)
                )
                assert own < others / 2  # a model of random weights paints noise, of which each paints its own
                assert own < 25
        plot = picture_of(viewer, f"{root}/mse_one_step", tmp_path)
        for color in ((86, 180, 233), (230, 159, 0), (255, 70, 70)):
            assert (np.abs(plot - color).max(-1) < 12).sum() > 20, color
        whole = tmp_path / "whole.png"
        viewer.take(whole, frame=FRAME)
        with Image.open(whole) as opened:
            assert opened.size == (WIDTH, HEIGHT - BAR)
        viewer.tab("Figures")
        assert (np.ptp(picture_of(viewer, "/comparison/rollout", tmp_path), axis=-1) > 60).sum() > 100
        assert {origin: told for origin, told in viewer.views().items() if told} == {}
        assert set(viewer.views()) == origins
