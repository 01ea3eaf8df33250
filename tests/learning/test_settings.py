"""--set KEY=VALUE: typed, checked, with the close match of a misspelt key."""

from __future__ import annotations

import pytest

from baselines.dmotion import DMotionConfig
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.model import TrainingConfig
from dmotion_bench.learning.settings import from_json, to_json, with_settings


def test_each_key_goes_to_the_config_that_has_it() -> None:
    config, training = with_settings(
        ["maps=4", "learning_rate=0.01", "second_frame=false", "transform=affine", "agent_entries=1"],
        DMotionConfig(),
        TrainingConfig(epochs=1),
    )
    assert (config.maps, config.second_frame, config.transform) == (4, False, "affine")
    assert config.agent_entries == 1  # the number, not its text
    assert training.learning_rate == 0.01


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("learning_rat=1", "did you mean 'learning_rate'"),
        ("xyz=1", "known: "),
        ("maps", "maps=VALUE"),
        ("maps=many", "whole number"),
        ("learning_rate=fast", "must be a number"),
        ("second_frame=1", "true or false"),
        ("transform=rotation", "translation, affine"),
        ("agent_entries=2", "1, 3"),
        ("learning_rate=-1", "above zero"),
        ("schedule=steps", "one-cycle"),
    ],
)
def test_a_wrong_setting_is_named(setting: str, sentence: str) -> None:
    with pytest.raises(InvalidSetting, match=sentence):
        with_settings([setting], DMotionConfig(), TrainingConfig(epochs=1))


def test_configs_survive_json() -> None:
    config = DMotionConfig(maps=3, transform="cross_convolution")
    assert from_json(DMotionConfig, to_json(config)) == config


def test_a_field_of_another_version_is_refused() -> None:
    with pytest.raises(InvalidSetting, match="another version"):
        from_json(DMotionConfig, {**to_json(DMotionConfig()), "rotations": 4})
