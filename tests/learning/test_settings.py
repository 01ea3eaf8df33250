"""--set KEY=VALUE: typed, checked, with the close match of a misspelt key."""

from __future__ import annotations

import dataclasses
import enum
import json
from typing import Any, Literal

import pytest

from baselines.dmotion import DMotionConfig
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.model import TrainingConfig
from dmotion_bench.learning.settings import from_json, to_json, with_settings
from dmotion_bench.registry import model_class


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


@pytest.mark.parametrize(
    ("model", "idle", "needed"),
    [
        ("dmotion", "own_steps=2", "own_frames above 0"),
        ("dmotion", "guided=0.2", "guide above 0 and agents=1"),
        ("ed-cnn", "own_steps=2", "own_frames above 0"),
        ("wm-ae", "beta=0.5", "the variational code of wm-vae"),
        ("wm-vae", "adaptation_steps=10", "adaptation=finetuned"),
    ],
)
def test_a_setting_that_does_nothing_is_refused_and_an_old_config_with_it_is_read(
    model: str, idle: str, needed: str
) -> None:
    kind = model_class(model)
    configs = kind.Config(), TrainingConfig(epochs=1)
    with pytest.raises(
        InvalidSetting, match=f"--set {idle} does nothing without {needed}; leave it out, or ask for that"
    ):
        with_settings([idle], *configs)
    name, _, value = idle.partition("=")
    own = next(config for config in configs if hasattr(config, name))
    assert with_settings([f"{name}={getattr(own, name)}"], *configs) == configs
    assert getattr(from_json(type(own), {**to_json(own), name: json.loads(value)}), name) == json.loads(value)


@pytest.mark.parametrize(
    "settings",
    [
        ("own_frames=0.5", "own_steps=2"),
        ("guide=1", "guided=0.2"),
        ("guide=0", "agents=2"),
        ("adaptation_steps=10", "adaptation=finetuned"),
    ],
)
def test_a_setting_comes_with_what_it_needs(settings: tuple[str, ...]) -> None:
    with_settings(settings, DMotionConfig(guide=1.0), TrainingConfig(epochs=1))
    with_settings(["beta=0.5"], model_class("wm-vae").Config())


def test_configs_survive_json() -> None:
    config = DMotionConfig(maps=3, transform="cross_convolution")
    assert from_json(DMotionConfig, to_json(config)) == config


def test_what_json_has_no_type_for_is_refused() -> None:
    config = dataclasses.make_dataclass("Own", [("act", Any, dataclasses.field(default=max))], frozen=True)()
    with pytest.raises(
        InvalidSetting, match=r"the settings of Own cannot be kept in JSON: .*not JSON serializable. A field can be"
    ):
        to_json(config)


@pytest.mark.parametrize("value", [float("inf"), float("nan"), 10**30, (1.0, float("-inf"))])
def test_what_no_run_could_be_read_with_is_refused_before_it_begins(value: Any) -> None:
    config = dataclasses.make_dataclass("Own", [("limit", Any, dataclasses.field(default=value))], frozen=True)()
    with pytest.raises(InvalidSetting, match=r"cannot be kept in JSON: it holds the (whole )?number .*finite number"):
        to_json(config)


def test_a_field_of_another_version_is_refused() -> None:
    with pytest.raises(InvalidSetting, match="another version"):
        from_json(DMotionConfig, {**to_json(DMotionConfig()), "rotations": 4})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Strict:
    """Refuses values as plain Python does."""

    maps: int = 1
    depth: int = 1

    def __post_init__(self) -> None:
        assert self.depth > 0, "no depth"
        if self.maps < 1:
            raise ValueError("there must be a map.")


@pytest.mark.parametrize(("stored", "said"), [({"maps": 0}, "there must be a map"), ({"depth": 0}, "no depth")])
def test_a_stored_value_that_a_config_refuses_is_a_sentence(stored: dict[str, int], said: str) -> None:
    """A run beside the one that is trained may be of an earlier state of its model, which allowed more."""
    with pytest.raises(InvalidSetting, match=rf"^a stored Strict cannot be read: {said}"):
        from_json(Strict, stored)


def test_a_setting_that_a_config_refuses_is_a_sentence() -> None:
    with pytest.raises(InvalidSetting, match=r"^--set maps=0 cannot be: there must be a map\.$"):
        with_settings(["maps=0"], Strict())
    with pytest.raises(InvalidSetting, match=r"^--set depth=0 cannot be: no depth"):
        with_settings(["depth=0"], Strict())


@dataclasses.dataclass(frozen=True, kw_only=True)
class Listed:
    widths: list[int] = dataclasses.field(default_factory=lambda: [8, 8])


def test_a_field_that_no_text_says_is_named_with_its_type() -> None:
    said = r"^widths cannot be set, since its type is list\[int\]; .* such as tuple\[int, ...\]\.$"
    with pytest.raises(InvalidSetting, match=said):
        with_settings(["widths=1,2"], Listed())


class Kind(enum.StrEnum):
    SMALL = "small"
    LARGE = "large"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inner:
    sizes: tuple[int, ...] = (3,)


VALUES: dict[str, tuple[Any, Any]] = {
    "optional tuple": (tuple[int, ...] | None, (1, 2)),
    "none": (tuple[int, ...] | None, None),
    "tuple of tuples": (tuple[tuple[int, ...], ...], ((1, 2), (3,), ())),
    "pair": (tuple[int, str], (1, "a")),
    "pairs": (tuple[tuple[str, float], ...], (("a", 0.5), ("b", 1))),
    "bare tuple": (tuple, (1, "a")),
    "member": (Kind, Kind.LARGE),
    "members": (tuple[Kind, ...], (Kind.LARGE, Kind.SMALL)),
    "choice": (Literal[1, "two"] | None, "two"),
    "config": (Inner | None, Inner(sizes=(1, 2))),
    "anything": (Any, 1),
    "mapping": (dict[str, int], {"a": 1}),
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sized:
    kind: Kind = Kind.SMALL


def test_a_member_of_an_enumeration_is_set_by_its_value() -> None:
    (config,) = with_settings(["kind=large"], Sized())
    assert config.kind is Kind.LARGE
    with pytest.raises(InvalidSetting, match="kind is 'huge'; it can be small, large"):
        with_settings(["kind=huge"], Sized())


def _config(hint: Any) -> type:
    return dataclasses.make_dataclass("Config", [("x", hint)], frozen=True, kw_only=True)


@pytest.mark.parametrize("name", VALUES)
def test_values_of_every_type_survive_json(name: str) -> None:
    hint, value = VALUES[name]
    kind = _config(hint)
    read = from_json(kind, json.loads(json.dumps(to_json(kind(x=value)))))
    assert read == kind(x=value)
    assert type(read.x) is type(value)


@pytest.mark.parametrize(
    ("hint", "stored"),
    [
        (tuple[int, ...] | None, ["a"]),
        (tuple[int, str], [1]),
        (tuple[int, str], [1, "a", 2]),
        (tuple[tuple[int, ...], ...], [1]),
        (tuple[int, ...], [True]),
        (Kind, "huge"),
        (Literal[1, 2], True),
        (Inner, {"sizes": ["a"]}),
        (Inner | None, {"sises": []}),
        (float, True),
        (int, 1.5),
        (str, 1),
        (bool, 1),
    ],
)
def test_values_of_another_type_are_refused(hint: Any, stored: Any) -> None:
    with pytest.raises(InvalidSetting, match="cannot be read"):
        from_json(_config(hint), {"x": stored})
