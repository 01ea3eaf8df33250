"""``dataset.json``: what a data set is, how it was made, and the hashes of its files.

It is written when the recording starts (``complete`` is false, no shard is listed) and replaced when all is
there, so a folder always says what it is meant to become. What is read is checked: the kinds of its fields here,
whether they can be true by ``manifest_check.py``. The file may come from anybody.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from dmotion_bench.actions import actions_from_json, actions_to_json
from dmotion_bench.errors import (
    DatasetCorrupt,
    DatasetError,
    DatasetIncomplete,
    DatasetMissing,
    DatasetVersionUnknown,
    InvalidSetting,
)
from dmotion_bench.registry import environment_versions, usual_policy
from dmotion_bench.specs import IMPORTED, VERSION, DatasetRecipe, EnvSpec, ObjectSpec
from dmotion_bench.storage.atomic import write_atomically
from dmotion_bench.storage.json_fields import Fields
from dmotion_bench.storage.json_file import parse_json, read_json
from dmotion_bench.storage.limits import LARGEST_MANIFEST, SHARD_ENTRY
from dmotion_bench.storage.links import require_no_link_out
from dmotion_bench.storage.manifest_check import check_episode_size, check_manifest, check_recipe, check_spec
from dmotion_bench.storage.shard import FileFacts, shard_count
from dmotion_bench.wording import command, shown
from dmotion_bench.workspace import DATASET_MANIFEST

FORMAT: Final = "dmbench/1"
TABLES: Final = ("episodes.parquet", "tasks.parquet")
_IDENTIFYING: Final = ("format", "recipe", "environment", "shards")


@dataclass(frozen=True, kw_only=True)
class ShardEntry:
    """A shard as the manifest lists it."""

    episodes: int
    frames: int
    video: FileFacts
    labels: FileFacts | None


@dataclass(frozen=True, kw_only=True)
class Replay:
    """What came of recording a sample of the episodes again, where an environment may not be exact.

    Attributes:
        episodes: The sample.
        differs: The first difference, such as ``"frame 3 of episode 0"``; empty if the bytes were the same.
    """

    episodes: tuple[int, ...]
    differs: str = ""

    @property
    def identical(self) -> bool:
        """Whether the same frames and actions were recorded again."""
        return not self.differs


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
        replay: Whether the recording repeats; None where the environment is known to be exact.
    """

    recipe: DatasetRecipe
    spec: EnvSpec
    complete: bool = False
    shards: tuple[ShardEntry, ...] = ()
    tables: Mapping[str, FileFacts] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    salvaged: bool = False
    replay: Replay | None = None

    @property
    def identity(self) -> bytes:
        """What the fingerprint is the SHA-256 of, as JSON: format version, recipe, facts and all shards' hashes."""
        content = self.to_json()
        return json.dumps({key: content[key] for key in _IDENTIFYING}, sort_keys=True).encode()

    @property
    def fingerprint(self) -> str:
        """The SHA-256 of ``identity``."""
        return hashlib.sha256(self.identity).hexdigest()

    def to_json(self) -> dict[str, Any]:
        """As plain values."""
        return {
            "format": FORMAT,
            "complete": self.complete,
            "salvaged": self.salvaged,
            "recipe": dataclasses.asdict(self.recipe),
            "environment": _spec_to_json(self.spec),
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
        } | ({} if self.replay is None else {"replay": dataclasses.asdict(self.replay)})

    def require_possible(self) -> None:
        """See that such a data set can be written and read again.

        Raises:
            InvalidSetting: It cannot.
        """
        try:
            check_manifest(self, TABLES)
            check_episode_size(self.recipe, self.spec)
            self._check_size()
        except ValueError as error:
            raise InvalidSetting(f"there can be no such data set: {error}.") from None

    def write(self, dataset: Path) -> None:
        """Replace the file in a data set's folder.

        Raises:
            InvalidSetting: There can be no such data set; nothing is written.
        """
        self.require_possible()
        write_atomically(dataset / DATASET_MANIFEST, self._written(), make_folders=False)

    def _written(self) -> bytes:
        return (json.dumps(self.to_json(), indent=2) + "\n").encode()

    def _check_size(self) -> None:
        """See that the file can be read again when all shards are listed.

        Raises:
            ValueError: It cannot.
        """
        lacking = shard_count(self.recipe) - len(self.shards)
        if len(self._written()) + lacking * SHARD_ENTRY > LARGEST_MANIFEST:
            raise ValueError(
                f"its {DATASET_MANIFEST} would be larger than {LARGEST_MANIFEST:,} bytes, with "
                f"{shard_count(self.recipe):,} shards and {len(self.recipe.parameters):,} parameters"
            )

    @classmethod
    def read(cls, dataset: Path) -> Manifest:
        """The manifest of a data set's folder.

        Raises:
            DatasetMissing: There is none.
            DatasetVersionUnknown: It is of another version of the format.
            DatasetCorrupt: It is not what ``write`` writes.
            DatasetError: A link in the folder leads out of it.
        """
        path = dataset / DATASET_MANIFEST
        require_no_link_out(path, "data set", DatasetError)
        try:
            content = read_json(path, largest=LARGEST_MANIFEST)
            _check_format(content.get("format"), dataset)
            manifest = _manifest(Fields(content, "it"))
            check_manifest(manifest, TABLES)
        except (FileNotFoundError, NotADirectoryError):
            record = command("dmbench record grid_world --out", dataset)
            raise DatasetMissing(
                f"no data set in {str(dataset)!r}: there is no {DATASET_MANIFEST}; record one with {record}."
            ) from None
        except ValueError as error:
            raise DatasetCorrupt(
                f"{str(path)!r} cannot be read: {error}; restore it from a copy, or record the data set anew with "
                f"'dmbench record' into another folder."
            ) from None
        return manifest

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
                f"go on with it: {command(*record_words(manifest.recipe, dataset))}."
            )
        return manifest


def fingerprint_at(folder: Path) -> str:
    """The fingerprint of the data set in a folder; empty where none can be read."""
    try:
        return Manifest.read(folder).fingerprint
    except (DatasetError, OSError):
        return ""


def identified_recipe(identity: bytes) -> DatasetRecipe:
    """The recipe in a data set's ``identity``, which may come from anybody.

    Raises:
        ValueError: There is none, or there can be no such data set.
    """
    content = Fields(parse_json(identity, largest=LARGEST_MANIFEST), "it")
    recipe, spec = _recipe(content.inner("recipe")), _spec(content.inner("environment"))
    check_spec(spec)
    check_recipe(recipe, spec)
    return recipe


def record_words(recipe: DatasetRecipe, dataset: Path | str) -> list[str]:
    """The words of the command that completes a data set."""
    if recipe.environment == IMPORTED:
        return ["dmbench", "data", "import"]
    words = ["dmbench", "record", recipe.environment]
    for name in ("episodes", "frames", "tasks", "seed"):
        words += [f"--{name}", str(getattr(recipe, name))]
    return [*words, *setting_words(recipe), "--out", str(dataset)]


def setting_words(recipe: DatasetRecipe) -> list[str]:
    """Of such a command, the options that are not about the size of the data set."""
    words = ["--vary", ",".join(recipe.vary)] if recipe.vary else []
    if recipe.policy != usual_policy(recipe.environment):
        words += ["--policy", recipe.policy]
    version = {VERSION: recipe.version} if environment_versions(recipe.environment) else {}
    for key, value in (version | dict(recipe.parameters)).items():
        words += ["--ranges", str(value)] if key == "ranges" else ["--set", f"{key}={value}"]
    return words


def _check_format(found: object, dataset: Path) -> None:
    """See that this is the version of the format that is read here."""
    if isinstance(found, str) and found != FORMAT and re.fullmatch(r"dmbench/\d+", found):
        raise DatasetVersionUnknown(
            f"{shown(str(dataset))} is of the format {shown(found)} and this dmbench reads {FORMAT!r}; install the "
            "dmbench that wrote it, or record the data set anew with 'dmbench record' into another folder."
        )
    if found != FORMAT:
        raise ValueError(f"its format is {shown(found)}, not {FORMAT!r}")


def _manifest(fields: Fields) -> Manifest:
    tables = fields.inner("tables")
    return Manifest(
        recipe=_recipe(fields.inner("recipe")),
        spec=_spec(fields.inner("environment")),
        complete=fields.truth("complete"),
        salvaged=fields.truth("salvaged"),
        shards=tuple(_shard(Fields(one, "a shard")) for one in fields.many("shards")),
        tables={name: _facts(tables.inner(name)) for name in fields.pairs("tables")},
        versions={name: str(value) for name, value in fields.pairs("versions").items()},
        replay=None if fields.value("replay") is None else _replay(fields.inner("replay")),
    )


def _replay(fields: Fields) -> Replay:
    episodes = fields.many("episodes")
    return Replay(episodes=fields.wholes("episodes", len(episodes)), differs=fields.text("differs"))


def _recipe(fields: Fields) -> DatasetRecipe:
    parameters = fields.pairs("parameters")
    if not all(isinstance(value, str | int | float | bool) for value in parameters.values()):
        raise ValueError(f"recipe.parameters is {shown(parameters)}")
    return DatasetRecipe(
        environment=fields.text("environment"),
        parameters=parameters,
        policy=fields.text("policy"),
        seed=fields.whole("seed"),
        episodes=fields.whole("episodes"),
        frames=fields.whole("frames"),
        tasks=fields.whole("tasks"),
        shard_episodes=fields.whole("shard_episodes"),
        vary=fields.texts("vary"),
    )


def _spec_to_json(spec: EnvSpec) -> dict[str, Any]:
    content = dataclasses.asdict(spec) | {"actions": actions_to_json(spec.actions)}
    if not spec.other_agents:
        del content["other_agents"]  # data sets with one agent keep their bytes
    return content


def _spec(fields: Fields) -> EnvSpec:
    return EnvSpec(
        id=fields.text("id"),
        actions=actions_from_json(fields.value("actions")),
        agent=_object(fields.inner("agent")),
        objects=tuple(_object(Fields(one, "an object")) for one in fields.many("objects")),
        height=fields.whole("height"),
        width=fields.whole("width"),
        step_ns=fields.whole("step_ns"),
        agent_has_color=fields.truth("agent_has_color"),
        shaded=fields.truth("shaded"),
        push_threshold=fields.real("push_threshold"),
        other_agents=tuple(
            _object(Fields(one, "an agent"))
            for one in ([] if fields.value("other_agents") is None else fields.many("other_agents"))
        ),
    )


def _object(fields: Fields) -> ObjectSpec:
    red, green, blue = fields.wholes("color", 3)
    return ObjectSpec(name=fields.text("name"), shape=fields.text("shape"), color=(red, green, blue))


def _shard(fields: Fields) -> ShardEntry:
    labels = fields.inner_or_none("labels")
    return ShardEntry(
        episodes=fields.whole("episodes"),
        frames=fields.whole("frames"),
        video=_facts(fields.inner("video")),
        labels=None if labels is None else _facts(labels),
    )


def _facts(fields: Fields) -> FileFacts:
    return FileFacts(fields.whole("size"), fields.text("sha256"))
