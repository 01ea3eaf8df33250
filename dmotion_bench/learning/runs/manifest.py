"""``run.json``: a run's request, the conditions of its training, and its result.

The file may come from anybody. Each field is held against its kind and its bounds before anybody uses it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, get_args

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook
from torch.overrides import TorchFunctionMode

from dmotion_bench.actions import MOST_ACTIONS, ActionSpec, Discrete, actions_from_json, actions_to_json
from dmotion_bench.errors import DmbenchError, InvalidSetting
from dmotion_bench.learning.data.label_request import LabelRequest
from dmotion_bench.learning.data.triplets import SplitProtocol
from dmotion_bench.learning.hardware.precision import Precision
from dmotion_bench.learning.model import ForwardModel, ModelInputs, TrainingConfig
from dmotion_bench.learning.runs.checkpoint import Form, forms_of
from dmotion_bench.learning.settings import from_json, to_json
from dmotion_bench.registry import model_class
from dmotion_bench.specs import MOST_THREADS, Preset
from dmotion_bench.storage.json_fields import Fields
from dmotion_bench.storage.json_file import read_json
from dmotion_bench.storage.limits import LARGEST_SIDE, LONGEST_NAME, LONGEST_TEXT
from dmotion_bench.wording import shown

RUN_FORMAT: Final = "dmbench-run/1"
PARTS: Final = "parts"
"""In the place of joint actions: how many each agent has."""
ACTION_NAMES: Final = "action_names"
"""Of ``run.json``: the names of discrete actions. They stand beside the spec, since no training depends on them."""

LARGEST_RUN: Final = 2**23
"""Bytes of a run.json that are read; the longest names of the most actions take half of them."""
_COUNTS: Final = range(2**53)
_SHA256: Final = re.compile(r"[0-9a-f]{64}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunSpec:
    """Everything that decides the result of a training on given hardware, besides its ``Conditions``.

    Attributes:
        model, arch: Registry name and architecture.
        config, training: The configs, as JSON's types.
        preset: Where the defaults came from.
        labels: The label budget, as ``LabelRequest`` prints it.
        seed: Of the weights, the order of the batches and the draw of demonstrations.
        dataset: Its name.
        fingerprint: The hash of its content.
        protocol: How triplets are split.
        height, width: What the model was built for [px].
        actions: What the model was built for: the number of discrete actions, 0 if they are not known; of joint actions
            of several agents ``{"parts": [4, 4]}``, the number of each one's; or the fields of ``Continuous``.
    """

    model: str
    arch: str
    config: Mapping[str, Any]
    training: Mapping[str, Any]
    preset: str
    labels: str
    seed: int
    dataset: str
    fingerprint: str
    protocol: str = "episode"
    height: int
    width: int
    actions: int | Mapping[str, Any]

    def __post_init__(self) -> None:
        _within("seed", self.seed, range(2**63))
        _within("height", self.height, range(1, LARGEST_SIDE + 1))
        _within("width", self.width, range(1, LARGEST_SIDE + 1))
        if isinstance(self.actions, int):
            _within("actions", self.actions, range(MOST_ACTIONS + 1))
        else:
            _ = self.action_spec
        for name, choices in (("preset", [one.value for one in Preset]), ("protocol", get_args(SplitProtocol))):
            if getattr(self, name) not in choices:
                raise InvalidSetting(f"{name} is {shown(getattr(self, name))}; it can be {', '.join(choices)}.")
        LabelRequest.parse(self.labels)

    @property
    def inputs(self) -> ModelInputs:
        """The facts that the model is built for."""
        return ModelInputs(height=self.height, width=self.width, actions=self.action_spec)

    @property
    def action_spec(self) -> ActionSpec | None:
        """The actions that the model is built for; discrete ones have numbers in the place of names.

        Raises:
            InvalidSetting: There are no such actions.
        """
        if isinstance(self.actions, int):
            return Discrete.numbered(self.actions) if self.actions else None
        if set(self.actions) == {PARTS}:
            return _joint_actions(self.actions[PARTS])
        try:
            return actions_from_json(dict(self.actions))
        except ValueError as error:
            raise InvalidSetting(f"{error}.") from None

    @property
    def training_config(self) -> TrainingConfig:
        """How the model is optimised."""
        return from_json(TrainingConfig, self.training)

    def completed(self) -> RunSpec:
        """The same, settings that later versions added at their defaults: what specs are compared by.

        Raises:
            InvalidSetting: It has settings that this version does not know.
        """
        config: Any = from_json(model_class(self.model).Config, self.config)
        return dataclasses.replace(self, config=to_json(config), training=to_json(self.training_config))

    def build(self) -> ForwardModel[Any]:
        """The model with weights that the seed decides, whatever random numbers were drawn before."""
        kind = model_class(self.model)
        with torch.random.fork_rng():
            torch.manual_seed(self.seed)
            model = kind(from_json(kind.Config, self.config), self.inputs)
        model.channels_last = self.training_config.channels_last
        return model

    def forms(self, most: int) -> dict[str, Form]:
        """The tensors of the model, told without memory for any of them.

        Args:
            most: A model of more parameters is not built to its end.

        Raises:
            InvalidSetting: There is no such model.
        """
        kind = model_class(self.model)
        config: Any = from_json(kind.Config, self.config)
        try:
            with torch.device("meta"), _Undrawn(), _at_most(most):
                return forms_of(kind(config, self.inputs).state_dict())
        except DmbenchError:
            raise
        except Exception as error:  # a stranger's model may raise anything
            if "meta" in str(error):  # it reads numbers while it is built, and tensors without memory have none
                return forms_of(self.build().state_dict())
            raise InvalidSetting(f"no {self.model} can be built so: {type(error).__name__}: {error}") from None


def stored_actions(spec: ActionSpec | None) -> int | dict[str, Any]:
    """A data set's actions as ``RunSpec`` holds them."""
    if isinstance(spec, Discrete) and len(spec.parts) > 1:
        return {PARTS: list(map(len, spec.parts))}
    stored = actions_to_json(spec)
    return stored if isinstance(stored, dict) else len(stored)


def _joint_actions(sizes: object) -> Discrete:
    """Joint actions of agents that have so many each.

    Raises:
        InvalidSetting: There are no such actions.
    """
    if (
        not isinstance(sizes, list | tuple)
        or not 2 <= len(sizes) <= MOST_ACTIONS.bit_length()
        or not all(type(size) is int and 2 <= size <= MOST_ACTIONS for size in sizes)
        or math.prod(sizes) > MOST_ACTIONS
    ):
        raise InvalidSetting(
            f"the parts of the actions are {shown(sizes)}; they are whole numbers from 2, one for each of several "
            f"agents, whose product is at most {MOST_ACTIONS:,}."
        )
    return Discrete.joint(*(Discrete.numbered(size).names for size in sizes))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Conditions:
    """Threads and precision, which also decide a training's exact result; fixed before its first step.

    Attributes:
        threads: That each process computes with.
        precision: In which matrices are multiplied.
        probe: Seconds that a step took in each precision; empty where nothing had to be measured.
        threads_probe: The same by the number of threads.
    """

    threads: int
    precision: Precision
    probe: Mapping[str, float] = dataclasses.field(default_factory=dict)
    threads_probe: Mapping[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        _within("threads", self.threads, range(1, MOST_THREADS + 1))
        for name, seconds in self.probe.items():
            if name not in get_args(Precision) or not _is_duration(seconds):
                raise InvalidSetting(f"probe is {shown(dict(self.probe))}; it can be seconds by precision.")
        for count, seconds in self.threads_probe.items():
            if not count.isdecimal() or not _is_duration(seconds):
                raise InvalidSetting(
                    f"threads_probe is {shown(dict(self.threads_probe))}; it can be seconds by number."
                )


def _is_duration(seconds: object) -> bool:
    return type(seconds) in (int, float) and 0 <= seconds < math.inf  # type: ignore[operator]


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunResult:
    """The result of a training.

    Attributes:
        weights: Hash of the weights.
        steps, triplets: Taken and seen, without those that an early end left out.
        seconds: Spent in its steps.
        triplets_per_s: Of those seconds.
        parameters: Of the model.
        best_step, validation_loss: Of the weights that were kept.
        labels, labels_total: Labels handed out by purpose, and their number.
        device, processes: Where the last sitting ran.
        threads, precision: As in ``Conditions``; None in a run of a version that did not record them.
        adapted_steps: Of the fine-tuning that were kept; None where there was none.
        ended: The steps after which phases ended early (``TrainingConfig.patience``), by their names.
    """

    weights: str
    steps: int
    triplets: int
    seconds: float
    triplets_per_s: float
    parameters: int
    best_step: int
    validation_loss: float
    labels: Mapping[str, int]
    labels_total: int
    device: str
    processes: int
    threads: int | None = None
    precision: Precision | None = None
    adapted_steps: int | None = None
    ended: Mapping[str, int] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        if not _SHA256.fullmatch(self.weights):
            raise InvalidSetting(f"weights is {shown(self.weights)}; it must be a SHA-256.")
        for name in ("steps", "triplets", "parameters", "best_step", "labels_total", "processes"):
            _within(name, getattr(self, name), _COUNTS)
        for name, number in self.labels.items():
            _within(f"labels[{name}]", number, _COUNTS)
        for name in ("seconds", "triplets_per_s"):
            if not 0 <= getattr(self, name) < math.inf:
                raise InvalidSetting(f"{name} is {shown(getattr(self, name))}; it cannot be below zero.")
        if not math.isfinite(self.validation_loss):
            raise InvalidSetting(f"validation_loss is {self.validation_loss}; it must be a number.")
        if len(self.device) > LONGEST_NAME:
            raise InvalidSetting(f"device is {shown(self.device)}; it must be a name.")
        if self.threads is not None:
            _within("threads", self.threads, range(1, MOST_THREADS + 1))
        if self.adapted_steps is not None:
            _within("adapted_steps", self.adapted_steps, _COUNTS)
        for name, step in self.ended.items():
            _within(f"ended[{name}]", step, _COUNTS)


def read_manifest(path: Path) -> dict[str, Any]:
    """Read and validate ``run.json``.

    Raises:
        OSError: It cannot be opened.
        ValueError, InvalidSetting: It is no such file; says why.
    """
    manifest = read_json(path, largest=LARGEST_RUN)
    found = manifest.get("format")
    if found != RUN_FORMAT:
        raise ValueError(f"it is of the format {shown(found)}; this dmbench reads {RUN_FORMAT!r}")
    fields = Fields(manifest, "run")
    spec = from_json(RunSpec, fields.pairs("spec"))
    words = {**fields.pairs("versions"), "dataset_path": fields.text("dataset_path"), "trained_as": ""}
    words |= {name: getattr(spec, name) for name in ("model", "arch", "dataset", "fingerprint")}
    if "trained_as" in manifest:
        words["trained_as"] = fields.text("trained_as")
    for name, word in words.items():
        if type(word) is not str or len(word) > LONGEST_TEXT or "\0" in word:
            raise ValueError(f"its {shown(name)} is {shown(word)}")
    if fields.inner_or_none("result") is not None:
        from_json(RunResult, manifest["result"])
    if "conditions" in manifest:
        from_json(Conditions, fields.pairs("conditions"))
    if ACTION_NAMES in manifest:
        known, named = spec.action_spec, Discrete(fields.texts(ACTION_NAMES))
        if not named.fits(known):
            raise ValueError(f"it names {len(named)} actions and is of {shown(spec.actions)}")
    for name, told in fields.pairs("code").items() if "code" in manifest else ():
        if len(name) > LONGEST_TEXT or type(told) is not str or not _SHA256.fullmatch(told):
            raise ValueError(f"its code of {shown(name)} is {shown(told)}, no SHA-256")
    return manifest


def _within(name: str, value: int, allowed: range) -> None:
    if type(value) is not int or value not in allowed:
        raise InvalidSetting(f"{name} is {shown(value)}; it can be {allowed[0]} to {allowed[-1]}.")


class _Undrawn(TorchFunctionMode):
    """Tensors without memory keep no random numbers, so none are drawn; torch would load its compiler to say so."""

    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        named = kwargs or {}
        if func in (Tensor.normal_, nn.init.normal_):
            return named["tensor"] if "tensor" in named else args[0]
        return func(*args, **named)


@contextlib.contextmanager
def _at_most(parameters: int) -> Iterator[None]:
    """Stops the building of a model that has more parameters than a file could hold."""
    count = 0

    def registered(_module: object, _name: str, _parameter: object) -> None:
        nonlocal count
        count += 1
        if count > parameters:
            raise InvalidSetting(f"the model has more than {parameters} parameters, and its checkpoint has fewer.")

    hook = register_module_parameter_registration_hook(registered)
    try:
        yield
    finally:
        hook.remove()
