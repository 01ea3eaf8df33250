"""``docs/foxglove.json``, the layout for Foxglove: its panels are Foxglove's, its paths lead to what is recorded."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import foxglove.layouts
import pytest
from google.protobuf.descriptor import FieldDescriptor
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import DatasetRecipe

LAYOUT = json.loads((Path(__file__).parents[2] / "docs" / "foxglove.json").read_text())
PANELS: dict[str, dict[str, Any]] = LAYOUT["configById"]
TITLE = "foxglovePanelTitle"


@pytest.fixture(scope="module")
def messages(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """A decoded message of each topic: of a recording with discrete actions and factors, and of one with continuous."""
    discrete = DatasetRecipe(environment="grid_world", policy="random", episodes=10, frames=6, tasks=0, vary=("noise",))
    continuous = DatasetRecipe(
        environment="planar_push", parameters={"actions": "continuous"}, policy="random", episodes=10, frames=6, tasks=0
    )
    recorded = []
    for name, recipe in (("discrete", discrete), ("continuous", continuous)):
        folder = tmp_path_factory.mktemp("foxglove") / name
        record_dataset(folder, recipe)
        found: dict[str, Any] = {}
        for kind in ("video", "labels"):
            with (folder / kind / "shard-00000.mcap").open("rb") as file:
                reader = make_reader(file, decoder_factories=[DecoderFactory()])
                for _, channel, _, message in reader.iter_decoded_messages():
                    found.setdefault(channel.topic, message)
        recorded.append(found)
    return recorded


def _paths() -> Iterator[str]:
    for config in PANELS.values():
        yield from (one["value"] for one in config.get("paths", ()))
        yield from (config[key] for key in ("topicPath",) if key in config)
        if "imageMode" in config:
            yield config["imageMode"]["imageTopic"]


def _panels(node: Any) -> Iterator[str]:
    """The panels of a part of the window."""
    if isinstance(node, str):
        yield node
        return
    assert node["direction"] in ("row", "column")
    assert 0 < node["splitPercentage"] < 100
    yield from _panels(node["first"])
    yield from _panels(node["second"])


def test_every_panel_stands_in_the_window_once() -> None:
    assert sorted(_panels(LAYOUT["layout"])) == sorted(PANELS)


@pytest.mark.parametrize("panel", PANELS)
def test_a_panel_and_its_settings_are_foxgloves(panel: str) -> None:
    kind = panel.partition("!")[0]
    assert hasattr(foxglove.layouts, f"{kind}Panel")
    settings = {name: value for name, value in PANELS[panel].items() if name != TITLE}
    assert settings.keys() <= getattr(foxglove.layouts, f"{kind}Config")()._to_dict().keys()
    for series in settings.get("paths", ()):
        assert series.keys() <= getattr(foxglove.layouts, f"{kind}Series")()._to_dict().keys()
    assert settings.get("imageMode", {}).keys() <= foxglove.layouts.ImageModeConfig()._to_dict().keys()


@pytest.mark.parametrize("path", sorted(set(_paths())))
def test_a_path_leads_to_what_is_recorded(path: str, messages: list[dict[str, Any]]) -> None:
    topic, *fields = path.split(".")
    kinds = [found[topic].DESCRIPTOR for found in messages if topic in found]
    assert kinds, f"nothing is recorded in {topic}"
    assert any(_leads(kind, fields) for kind in kinds), path


def _leads(kind: Any, fields: list[str]) -> bool:
    """Whether a message of this kind has the fields, one inside the other; a slice stands behind a list alone."""
    for position, part in enumerate(fields):
        found = re.fullmatch(r"(\w+)(\[:\])?", part)
        assert found, part
        field = kind.fields_by_name.get(found[1])
        if field is None:
            return False
        last = position == len(fields) - 1
        if bool(found[2]) != field.is_repeated and not (last and field.is_repeated):
            return False
        kind = field.message_type
        if kind is None:
            return last and field.type != FieldDescriptor.TYPE_MESSAGE
    return True


def test_every_topic_has_a_panel(messages: list[dict[str, Any]]) -> None:
    assert {path.partition(".")[0] for path in _paths()} == set().union(*messages)
