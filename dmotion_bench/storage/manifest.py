"""``dataset.json``: what a data set is, how it was made, and the hashes of its files.

It is written when the recording starts (``complete`` is false, no shard is listed) and replaced when all is
there, so a folder always says what it is meant to become. What is read is checked field by field: the file may
come from anybody.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from dmotion_bench.errors import DatasetCorrupt, DatasetIncomplete, DatasetMissing, DatasetVersionUnknown
from dmotion_bench.registry import environment_versions
from dmotion_bench.specs import IMPORTED, VERSION, DatasetRecipe, EnvSpec, ObjectSpec
from dmotion_bench.storage.atomic import write_atomically
from dmotion_bench.storage.shard import FileFacts
from dmotion_bench.workspace import DATASET_MANIFEST

FORMAT: Final = "dmbench/1"
_LARGEST: Final = 64 * 2**20  # bytes of a dataset.json that are read
_LARGEST_SIDE: Final = 8192  # [px]
_LARGEST_COUNT: Final = 2**31


@dataclass(frozen=True, kw_only=True)
class ShardEntry:
    """A shard as the manifest lists it."""

    episodes: int
    frames: int
    video: FileFacts
    labels: FileFacts | None


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """The content of ``dataset.json``.

    Attributes:
        recipe: Makes the same data set again, unless ``salvaged``.
        spec: What is true of every episode.
        complete: Whether every shard and table is there.
        shards: In the order of their numbers.
        tables: Hashes of ``episodes.parquet`` and ``tasks.parquet``.
        versions: Of the packages that had a part in the recording.
        salvaged: Whether episodes were lost and the rest was kept, so that the recipe no longer tells all.
    """

    recipe: DatasetRecipe
    spec: EnvSpec
    complete: bool = False
    shards: tuple[ShardEntry, ...] = ()
    tables: Mapping[str, FileFacts] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    salvaged: bool = False

    @property
    def fingerprint(self) -> str:
        """SHA-256 over format version, recipe, facts and the hashes of all shards."""
        content = self.to_json()
        parts = {key: content[key] for key in ("format", "recipe", "environment", "shards")}
        return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()

    def to_json(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "format": FORMAT,
            "complete": self.complete,
            "salvaged": self.salvaged,
            "recipe": dataclasses.asdict(self.recipe),
            "environment": dataclasses.asdict(self.spec),
            "versions": dict(self.versions),
            "tables": {name: facts._asdict() for name, facts in self.tables.items()},
            "shards": [
                {
                    "episodes": shard.episodes,
                    "frames": shard.frames,
                    "video": shard.video._asdict(),
                    "labels": shard.labels._asdict() if shard.labels else None,
                }
                for shard in self.shards
            ],
        }

    def write(self, dataset: Path) -> None:
        """Replace the file in a data set's folder."""
        write_atomically(dataset / DATASET_MANIFEST, (json.dumps(self.to_json(), indent=2) + "\n").encode())

    @classmethod
    def read(cls, dataset: Path) -> Manifest:
        """The manifest of a data set's folder.

        Raises:
            DatasetMissing: There is none.
            DatasetVersionUnknown: It is of another version of the format.
            DatasetCorrupt: It is not what ``write`` writes.
        """
        path = dataset / DATASET_MANIFEST
        try:
            with path.open("rb") as file:
                raw = file.read(_LARGEST + 1)
        except (FileNotFoundError, NotADirectoryError):
            raise DatasetMissing(
                f"no data set in {str(dataset)!r}: there is no {DATASET_MANIFEST}; "
                f"record one with 'dmbench record grid_world --out {dataset}'."
            ) from None
        try:
            content = _checked(raw, dataset)
            return _manifest(content)
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise DatasetCorrupt(
                f"{str(path)!r} cannot be read: {error}; restore it from a copy, or record the data set anew with "
                f"'dmbench record' into another folder."
            ) from None

    @classmethod
    def read_complete(cls, dataset: Path) -> Manifest:
        """The manifest of a data set whose recording was finished.

        Raises:
            DatasetIncomplete: It was not; and what ``read`` raises.
        """
        manifest = cls.read(dataset)
        if not manifest.complete:
            raise DatasetIncomplete(
                f"the recording of {str(dataset)!r} was not finished; "
                f"go on with it: '{record_command(manifest.recipe, dataset)}'."
            )
        return manifest


def record_command(recipe: DatasetRecipe, dataset: Path) -> str:
    """The command that completes a data set."""
    if recipe.environment == IMPORTED:
        return "dmbench data import"
    words = ["dmbench", "record", recipe.environment]
    for name in ("episodes", "frames", "tasks", "seed"):
        words += [f"--{name}", str(getattr(recipe, name))]
    if recipe.vary:
        words += ["--vary", ",".join(recipe.vary)]
    version = {VERSION: recipe.version} if environment_versions(recipe.environment) else {}
    for key, value in (version | dict(recipe.parameters)).items():
        words += ["--ranges", str(value)] if key == "ranges" else ["--set", f"{key}={value}"]
    return shlex.join([*words, "--out", str(dataset)])


def _checked(raw: bytes, dataset: Path) -> object:
    """The JSON content, if it is of this version of the format."""
    if len(raw) > _LARGEST:
        raise ValueError(f"it is larger than {_LARGEST} bytes")
    content = json.loads(raw)
    found = content.get("format") if isinstance(content, dict) else None
    if isinstance(found, str) and found != FORMAT and re.fullmatch(r"dmbench/\d+", found):
        raise DatasetVersionUnknown(
            f"{str(dataset)!r} is of the format {found!r} and this dmbench reads {FORMAT!r}; install the dmbench "
            "that wrote it, or record the data set anew with 'dmbench record' into another folder."
        )
    if found != FORMAT:
        raise ValueError(f"its format is {found!r}, not {FORMAT!r}")
    return content


class _Fields:
    """Takes fields out of a JSON object and checks their kinds."""

    def __init__(self, value: object, where: str) -> None:
        if not isinstance(value, dict):
            raise ValueError(f"{where} is no object")  # noqa: TRY004 (a file's fault, not a caller's)
        self._value, self._where = value, where

    def _take(self, name: str, kind: type | tuple[type, ...]) -> Any:
        value = self._value.get(name)
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is int):
            raise ValueError(f"{self._where}.{name} is {value!r}")
        return value

    def text(self, name: str) -> str:
        return str(self._take(name, str))

    def truth(self, name: str) -> bool:
        return bool(self._take(name, bool))

    def real(self, name: str) -> float:
        return float(self._take(name, (int, float)))

    def whole(self, name: str, low: int, high: int = _LARGEST_COUNT) -> int:
        value = int(self._take(name, int))
        if not low <= value <= high:
            raise ValueError(f"{self._where}.{name} is {value}; it can be {low} to {high}")
        return value

    def many(self, name: str) -> list[Any]:
        return list(self._take(name, list))

    def pairs(self, name: str) -> dict[str, Any]:
        return dict(self._take(name, dict))

    def inner(self, name: str) -> _Fields:
        return _Fields(self._value.get(name), f"{self._where}.{name}")

    def texts(self, name: str) -> tuple[str, ...]:
        values = self.many(name)
        if not all(isinstance(value, str) for value in values):
            raise ValueError(f"{self._where}.{name} is {values!r}")
        return tuple(values)


def _manifest(content: object) -> Manifest:
    fields = _Fields(content, "dataset")
    recipe, spec = _recipe(fields.inner("recipe")), _spec(fields.inner("environment"))
    tables = fields.inner("tables")
    return Manifest(
        recipe=recipe,
        spec=spec,
        complete=fields.truth("complete"),
        salvaged=fields.truth("salvaged"),
        shards=tuple(_shard(_Fields(one, "shard")) for one in fields.many("shards")),
        tables={name: _facts(tables.inner(name)) for name in fields.pairs("tables")},
        versions={name: str(value) for name, value in fields.pairs("versions").items()},
    )


def _recipe(fields: _Fields) -> DatasetRecipe:
    parameters = fields.pairs("parameters")
    if not all(isinstance(value, str | int | float | bool) for value in parameters.values()):
        raise ValueError(f"recipe.parameters is {parameters!r}")
    return DatasetRecipe(
        environment=fields.text("environment"),
        parameters=parameters,
        policy=fields.text("policy"),
        seed=fields.whole("seed", 0, 2**64),
        episodes=fields.whole("episodes", 1),
        frames=fields.whole("frames", 1),
        tasks=fields.whole("tasks", 0),
        shard_episodes=fields.whole("shard_episodes", 1),
        vary=fields.texts("vary"),
    )


def _spec(fields: _Fields) -> EnvSpec:
    return EnvSpec(
        id=fields.text("id"),
        actions=fields.texts("actions"),
        agent=_object(fields.inner("agent")),
        objects=tuple(_object(_Fields(one, "object")) for one in fields.many("objects")),
        height=fields.whole("height", 1, _LARGEST_SIDE),
        width=fields.whole("width", 1, _LARGEST_SIDE),
        step_ns=fields.whole("step_ns", 1, 2**62),
        agent_has_color=fields.truth("agent_has_color"),
        shaded=fields.truth("shaded"),
        push_threshold=fields.real("push_threshold"),
    )


def _object(fields: _Fields) -> ObjectSpec:
    color = fields.many("color")
    if len(color) != 3 or not all(isinstance(value, int) and 0 <= value <= 255 for value in color):
        raise ValueError(f"a colour is {color!r}")
    red, green, blue = color
    return ObjectSpec(name=fields.text("name"), shape=fields.text("shape"), color=(red, green, blue))


def _shard(fields: _Fields) -> ShardEntry:
    labels = fields._value.get("labels")
    return ShardEntry(
        episodes=fields.whole("episodes", 1),
        frames=fields.whole("frames", 1),
        video=_facts(fields.inner("video")),
        labels=None if labels is None else _facts(fields.inner("labels")),
    )


def _facts(fields: _Fields) -> FileFacts:
    digest = fields.text("sha256")
    if not re.fullmatch(r"[0-9a-f]{64}", digest):
        raise ValueError(f"a hash is {digest!r}")
    return FileFacts(fields.whole("size", 0, 2**62), digest)
