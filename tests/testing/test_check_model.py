"""check_model: a sound model passes, and each breach of the contract is said in its own words."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from older_network import OlderNetwork
from sound_models import Sound, SoundConfig, SoundVideo, breaks
from torch import nn

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import InvalidSetting, ModelContractBroken
from dmotion_bench.learning.model import ForwardModel, Losses, ModelInputs, Phase, TrainingConfig, TripletBatch
from dmotion_bench.specs import Supervision
from dmotion_bench.testing import check_before_training, check_model


@pytest.mark.parametrize("kind", [Sound, SoundVideo])
def test_a_sound_model_passes(kind: type) -> None:
    check_model(kind, size=16)


class StartsAtIdentity(SoundVideo):
    """A spatial transformer's usual start: whatever it is shown, the motion is the identity until it is trained."""

    def __init__(self, config, inputs) -> None:
        super().__init__(config, inputs)
        self.motion = nn.Linear(3, 3)
        nn.init.zeros_(self.motion.weight)
        nn.init.ones_(self.motion.bias)

    def _code(self, current, following):
        return self.motion(super()._code(current, following))


class Large(Sound):
    """Takes frames of 128 pixels and more."""

    def __init__(self, config, inputs) -> None:
        if inputs.height < 128:
            raise InvalidSetting(f"frames are {inputs.height} x {inputs.width}; Large takes ones of 128 pixels.")
        super().__init__(config, inputs)


@pytest.mark.parametrize("kind", [OlderNetwork, StartsAtIdentity, Large])
def test_what_older_networks_do_is_no_breach(kind: type) -> None:
    check_model(kind)


class Wide(Sound):
    """Takes frames of one size."""

    def __init__(self, config, inputs) -> None:
        if (inputs.height, inputs.width) != (24, 40):
            raise InvalidSetting("Wide takes frames of 40 x 24 pixels.")
        super().__init__(config, inputs)


@pytest.mark.parametrize("actions", [None, Discrete.numbered(3)])
def test_before_a_training_its_own_frames_are_tried(actions: Discrete | None) -> None:
    drawn = torch.get_rng_state()
    check_before_training(Wide, "compact", ModelInputs(height=24, width=40, actions=actions))
    assert torch.equal(torch.get_rng_state(), drawn)
    with pytest.raises(ModelContractBroken, match=r"raised InvalidSetting: Wide takes frames of 40 x 24"):
        check_before_training(Wide, "compact", ModelInputs(height=24, width=41, actions=actions))


def test_before_a_training_its_own_settings_are_tried() -> None:
    inputs = ModelInputs(height=24, width=40, actions=Discrete.numbered(3))
    sizes: list[int] = []

    class Counting(Sound):
        def __init__(self, config, inputs) -> None:
            sizes.append(config.width)
            super().__init__(config, inputs)

    check_before_training(Counting, "compact", inputs, Counting.Config(width=7))
    assert {*sizes} == {7}


def test_a_size_that_a_model_refuses_is_said() -> None:
    with pytest.raises(ModelContractBroken, match=r"no frames of 64 pixels \(frames are 64 x 64; .*size=SIDE"):
        check_model(Large, size=64)


def test_channels_last_is_tried_where_the_training_asks_for_it() -> None:
    packed = classmethod(lambda kind, preset, arch: TrainingConfig(epochs=1, channels_last=True))
    check_model(breaks(Sound, training_defaults=packed), size=16)
    said = r"on channels-last images, which its training_defaults ask for .*: losses\(batch\) raised RuntimeError: view"
    with pytest.raises(ModelContractBroken, match=said):
        check_model(breaks(OlderNetwork, training_defaults=packed), size=16)


@pytest.mark.parametrize("channels_last", [False, True])
def test_bfloat16_is_tried_once_in_the_layout_of_the_training_unless_it_cannot_come(
    channels_last: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a processor that only emulates it, it would take longer than all the rest."""
    seen: list[tuple[bool, bool]] = []

    def losses(self: Any, batch: TripletBatch) -> Losses:
        packed = batch.current.is_contiguous(memory_format=torch.channels_last)
        seen.append((torch.is_autocast_enabled("cpu"), packed))
        return Sound.losses(self, batch)

    packed = classmethod(lambda kind, preset, arch: TrainingConfig(epochs=1, channels_last=channels_last))
    kind = breaks(Sound, training_defaults=packed, losses=losses)
    inputs = ModelInputs(height=16, width=16, actions=Discrete.numbered(4))
    check_before_training(kind, "compact", inputs)
    assert [layout for halved, layout in seen if halved] == [channels_last]
    seen.clear()
    check_before_training(kind, "compact", inputs, bf16=False)
    assert seen
    assert not any(halved for halved, _ in seen)


def _raises(self: Any, *_: Any) -> None:
    raise ZeroDivisionError("by hand")


def _init(extra: Callable[[Any], None]) -> Callable[..., None]:
    def init(self: Any, config: Any, inputs: Any) -> None:
        Sound.__init__(self, config, inputs)
        extra(self)

    return init


def _share(self: Any) -> None:
    self.register_buffer("other", self.layer.weight.detach())


def _losses(change: Callable[..., Losses], base: type = Sound) -> Callable[..., Losses]:
    return lambda self, batch: change(self, batch, base.losses(self, batch))


def _spoil(batch: Any) -> None:
    batch.current.mul_(0)


def _holding(losses: Losses, **values: torch.Tensor) -> Losses:
    """Values that the shape checker, at work in these tests alone, would refuse."""
    for name, value in values.items():
        object.__setattr__(losses, name, value)
    return losses


BREACHES: dict[str, tuple[Any, str]] = {
    "no class": (Sound.losses, r"is no subclass of .*ForwardModel"),
    "another class": (nn.Linear, r"is no subclass of .*ForwardModel"),
    "abstract": (type("Broken", (ForwardModel,), {}), r"does not define losses"),
    "no supervision": (breaks(Sound, supervision="none"), r"supervision is 'none'; it can be"),
    "no paper": (breaks(Sound, paper=""), r"paper says no authors"),
    "thawed config": (breaks(Sound, Config=dataclass(type("Loose", (), {}))), r"Config is no @dataclass\(frozen"),
    "architectures": (breaks(Sound, architectures="compact"), r"architectures is 'compact', not a tuple"),
    "no prediction": (
        breaks(ForwardModel, supervision=Supervision.NONE, paper="x", Config=SoundConfig, losses=Sound.losses),
        r"neither predict nor all of begin, advance and frame",
    ),
    "other config": (
        breaks(Sound, configure=classmethod(lambda kind, arch: SimpleNamespace(width=1))),
        r"configure\('compact'\) gave a SimpleNamespace, not its Config",
    ),
    "no training config": (
        breaks(Sound, training_defaults=classmethod(lambda kind, preset, arch: {"epochs": 1})),
        r"training_defaults\('tiny', 'compact'\) gave a dict",
    ),
    "wrong training config": (
        breaks(Sound, training_defaults=classmethod(lambda kind, preset, arch: TrainingConfig(epochs=0))),
        r"training_defaults\('tiny', 'compact'\) raised InvalidSetting: epochs is 0",
    ),
    "constructor": (breaks(Sound, __init__=_raises), r"__init__\(config, inputs\) raised ZeroDivisionError: by hand"),
    "no super": (
        breaks(Sound, __init__=lambda self, config, inputs: nn.Module.__init__(self)),
        r"__init__ does not call super\(\).__init__",
    ),
    "no parameters": (breaks(Sound, __init__=ForwardModel.__init__), r"it has no parameters"),
    "shared memory": (breaks(Sound, __init__=_init(_share)), ""),  # a checkpoint keeps it under both names
    "own randomness": (
        breaks(
            Sound, __init__=_init(lambda self: self.layer.bias.data.copy_(torch.rand(3, generator=torch.Generator())))
        ),
        "",  # a generator with a fixed seed is sound
    ),
    "unseeded": (
        breaks(
            Sound,
            __init__=_init(lambda self: self.layer.bias.data.copy_(torch.rand(3, generator=_restless()))),
        ),
        r"two models built after the same torch.manual_seed differ in layer.bias",
    ),
    "no phase": (breaks(Sound, phases=lambda self: ()), r"phases\(\) gave \(\), not a tuple of one Phase"),
    "same phase": (
        breaks(Sound, phases=lambda self: (Phase(fraction=0.5), Phase(fraction=0.5))),
        r"two phases have one name",
    ),
    "fractions": (breaks(Sound, phases=lambda self: (Phase(fraction=0.9),)), r"fractions of its phases sum to 0.9"),
    "greedy": (
        breaks(SoundVideo, phases=lambda self: (Phase(needs_actions=True),)),
        r"supervision is NONE but the phase \['train'\] needs actions",
    ),
    "modest": (breaks(Sound, phases=lambda self: (Phase(),)), r"supervision is ACTIONS but no phase needs actions"),
    "enter": (breaks(Sound, enter=_raises), r"enter\('train'\) raised ZeroDivisionError"),
    "progress": (breaks(Sound, progress=_raises), r"progress\(0.0\) raised ZeroDivisionError"),
    "losses": (breaks(Sound, losses=_raises), r"losses\(batch\) raised ZeroDivisionError"),
    "bare tensor": (
        breaks(Sound, losses=_losses(lambda s, b, given: given.total)),
        r"losses\(batch\) gave a Tensor, not Losses",
    ),
    "vector": (
        breaks(Sound, losses=_losses(lambda s, b, given: _holding(given, total=given.total[None]))),
        r"total has the shape \(1,\); it is to be one number",
    ),
    "nan": (breaks(Sound, losses=_losses(lambda s, b, given: Losses(total=given.total * torch.nan))), r"total is nan"),
    "attached term": (
        breaks(Sound, losses=_losses(lambda s, b, given: Losses(total=given.total, terms={"a": given.total}))),
        r"the term 'a' of its losses is no detached number",
    ),
    "hardness": (
        breaks(Sound, losses=_losses(lambda s, b, given: _holding(given, per_triplet=given.total.detach()))),
        r"per_triplet has the shape \(\); it is one detached number per triplet",
    ),
    **{
        f"hardness {value}": (
            breaks(
                Sound,
                losses=_losses(
                    lambda s, b, given, value=value: _holding(given, per_triplet=given.per_triplet * 0 + value)
                ),
            ),
            rf"per_triplet is \[{value}, .* for some images; it is a finite loss of each triplet, and none is below",
        )
        for value in (-1.0, float("inf"), float("nan"))
    },
    "spoilt batch": (
        breaks(Sound, losses=lambda self, batch: (Sound.losses(self, batch), _spoil(batch))[0]),
        r"losses\(batch\) changes the batch in place",
    ),
    "no gradient": (
        breaks(Sound, losses=_losses(lambda s, b, given: Losses(total=given.total.detach()))),
        r"total has no gradient in the phase 'train'",
    ),
    "gradient of nothing": (
        breaks(Sound, losses=_losses(lambda s, b, given: Losses(total=given.total * 0))),
        r"no parameter gets a gradient in the phase 'train'",
    ),
    "infinite gradient": (
        breaks(Sound, losses=_losses(lambda s, b, given: Losses(total=(s.layer.bias * 0).abs().sqrt().sum()))),
        r"a gradient is not finite",
    ),
    "peeping": (
        breaks(
            SoundVideo,
            losses=_losses(
                lambda s, b, given: Losses(total=given.total if b.action is None else given.total * 2), base=SoundVideo
            ),
        ),
        r"supervision is NONE but losses\(batch\) depends on batch.action",
    ),
    "restless validation": (
        breaks(
            Sound,
            losses=_losses(
                lambda s, b, given: (
                    given if s.training else Losses(total=given.total + torch.rand((), generator=_restless()))
                )
            ),
        ),
        r"in evaluation mode differ from one call to the next",
    ),
    "validation that trains": (
        breaks(Sound, losses=_losses(lambda s, b, given: given if s.training else _moved(s, given))),
        r"losses\(batch\) changes table in evaluation mode",
    ),
    "align": (breaks(SoundVideo, align=_raises), r"align\(demonstrations\) raised ZeroDivisionError"),
    "align does nothing": (
        breaks(SoundVideo, align=lambda self, demonstrations: None),
        r"align\(demonstrations\) leaves the same state whichever actions are shown",
    ),
    "align forgets": (
        breaks(
            SoundVideo,
            align=lambda self, shown: (SoundVideo.align(self, shown), setattr(self, "scale", 2.0))[0],
            predict=lambda self, *given: SoundVideo.predict(self, *given) * getattr(self, "scale", 1.0),
        ),
        r"what align\(demonstrations\) learned is lost when the weights are saved",
    ),
    "predict": (breaks(Sound, predict=_raises), r"predict\(previous, current, action\) raised ZeroDivisionError"),
    "shape": (
        breaks(Sound, predict=lambda self, p, c, a: Sound.predict(self, p, c, a)[..., :8]),
        r"gave the shape \(3, 3, 16, 8\), not frames of the shape \(3, 3, 16, 16\)",
    ),
    "half": (
        breaks(Sound, predict=lambda self, p, c, a: Sound.predict(self, p, c, a).bfloat16()),
        r"gave torch.bfloat16, not torch.float32",
    ),
    "infinite": (
        breaks(Sound, predict=lambda self, p, c, a: Sound.predict(self, p, c, a) / 0),
        r"gave frames that are not finite",
    ),
    "of 0 to 255": (
        breaks(Sound, predict=lambda self, p, c, a: 127.5 * (Sound.predict(self, p, c, a).clamp(-0.5, 1) + 1)),
        r"gave frames whose values reach \d+(\.\d+)?; those of frames lie in \[-1, 1\]",
    ),
    "in place": (
        breaks(Sound, predict=lambda self, p, c, a: Sound.predict(self, p, c.mul_(0.5), a)),
        r"predict changes its arguments in place",
    ),
    "noisy": (
        breaks(Sound, predict=lambda self, p, c, a: Sound.predict(self, p, c, a) + torch.randn(1)),
        r"predict differs from one call to the next",
    ),
    "nothing": (
        breaks(SoundVideo, predict=lambda self, *given: None),
        r"predict\(previous, current, action\) gave a NoneType, not frames of the shape",
    ),
    "in place, of video": (
        breaks(SoundVideo, predict=lambda self, p, c, a: SoundVideo.predict(self, p, c.mul_(0.5), a)),
        r"predict changes its arguments in place",
    ),
    "noisy, of video": (
        breaks(SoundVideo, predict=lambda self, *given: SoundVideo.predict(self, *given) + torch.randn(1)),
        r"predict differs from one call to the next",
    ),
    "batch": (
        breaks(Sound, predict=lambda self, p, c, a: Sound.predict(self, p, c - c.mean(0), a)),
        r"depends on the other frames of the batch",
    ),
    "state": (
        breaks(
            Sound,
            begin=lambda self, p, c: (p, c, 0),
            advance=lambda self, s, a: (s[1], self.predict(s[0], s[1], a), s[2] + 1),
        ),
        r"a state is no tuple of tensors whose first axis is the batch",
    ),
    "rollout": (
        breaks(Sound, rollout=lambda self, p, c, a: ForwardModel.rollout(self, p, c, a) * 0.5),
        r"rollout differs from begin, advance and frame",
    ),
    "first frame": (
        breaks(Sound, advance=lambda self, s, a: (s[1], self.predict(s[0], s[1], a) * 0.5)),
        r"the first frame of rollout differs from predict",
    ),
}


def _restless() -> torch.Generator:
    generator = torch.Generator()
    generator.seed()
    return generator


def _moved(self: Any, losses: Losses) -> Losses:
    self.table.add_(1)
    return losses


@pytest.mark.parametrize("name", BREACHES)
def test_every_breach_is_said(name: str) -> None:
    kind, sentence = BREACHES[name]
    if name == "validation that trains":
        kind = type("Broken", (kind,), {"__init__": _init(lambda self: self.register_buffer("table", torch.zeros(1)))})
    if not sentence:
        check_model(kind, size=16)
        return
    with pytest.raises(ModelContractBroken, match=sentence) as raised:
        check_model(kind, size=16)
    assert "contract" in str(raised.value) or "ForwardModel" in str(raised.value)


@pytest.mark.parametrize("kind", [Sound, SoundVideo])
def test_predictions_that_no_action_changes_are_a_warning(kind: type) -> None:
    still = breaks(kind, predict=lambda self, p, c, a: kind.predict(self, p, c, torch.zeros_like(a)))
    with pytest.warns(UserWarning, match="after 3 steps of training predict gives the same frames whatever the action"):
        check_model(still, size=16)


def test_of_one_action_no_prediction_can_depend() -> None:
    check_model(Sound, size=16, actions=1)


def test_a_model_that_predicts_in_no_way_is_told_so() -> None:
    image = torch.zeros(1, 3, 16, 16)
    for methods in ({}, {"begin": lambda self, previous, current: (current, current)}):
        kind = breaks(ForwardModel, losses=Sound.losses, **methods)
        model = kind(SoundConfig(), ModelInputs(height=16, width=16, actions=Discrete.numbered(2)))
        with pytest.raises(ModelContractBroken, match="defines neither predict nor all of begin, advance and frame"):
            model.predict(image, image, 0)
        with pytest.raises(ModelContractBroken, match="defines neither predict nor all of begin, advance and frame"):
            model.rollout(image, image, torch.zeros(1, 2, dtype=torch.long))
