"""An entry of the leaderboard: one result, as one JSON file that conforms to ``schema.json``.

A measured entry is a run's report word for word, and with it what a page, a comparison or a check needs and a report
leaves to other files: the errors by episode, so that two entries can be compared on the same triplets, the actions of
control, and a few pictures.
A published entry is a row of somebody's table.

Entries come from anybody (``entry_file.py``): they are checked against the schema, and nothing in them is taken for a
path or for markup; their pictures are decoded and encoded anew before they are shown (``pictures.py``).
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Final, NamedTuple

from dmotion_bench.errors import EntryInvalid
from dmotion_bench.planning.mpc import CONTROL_VERSION
from dmotion_bench.recording.session import SHARD_EPISODES
from dmotion_bench.scoring.decisive import GAINED, planning_settings
from dmotion_bench.scoring.references import PublishedResult
from dmotion_bench.scoring.report import (
    CONTROL_OF_CODE,
    LABEL_USES,
    SCORING_OF_CODE,
    SCORING_VERSION,
    FigureJson,
    Version,
)
from dmotion_bench.scoring.samples import CONTROL
from dmotion_bench.specs import IMPORTED, VERSION, DatasetRecipe
from dmotion_bench.storage.manifest import identified_recipe, record_words
from leaderboard.json_schema import Schema

FORMAT: Final = "dmbench-entry/1"
OWN_FIELDS: Final = ("format", "kind", "by_episode", "control", "pictures")
"""Of a measured entry; all others are those of the run's report."""

_DECIDE: Final = {"rollout_": ("horizon",), "planning_gain": (GAINED,)}
"""The settings, by how their names begin, that decide the figures whose names begin so."""

SHOWN_VIOLATIONS: Final = 3
HASH: Final = re.compile(r"[0-9a-f]{64}")


USUAL_PRECISION: Final = "float32"
SUMMED: Final = 1e-6
"""Relative; between a mean and that of its sums over episodes, which were added up in another order."""


class Frames(NamedTuple):
    """The samples that a figure is the mean of: frames, or tasks.

    Attributes:
        episodes: Their episodes.
        counts: How many there are of each.
    """

    episodes: tuple[int, ...]
    counts: tuple[float, ...]


class Planner(NamedTuple):
    """By what control is told apart: only what one planner did is averaged and compared.

    Attributes:
        version: Of control.
        settings: The solver, the objective where one was named, the tasks, their steps and the seed, as a text.
        tasks: The tasks that distances at the end truly are of; None where the entry does not tell.
    """

    version: Version
    settings: str
    tasks: Frames | None = None


@functools.cache
def schema() -> Schema:
    """The published schema."""
    return Schema(json.loads(schema_text()))


def schema_text() -> str:
    """The published schema as it stands in its file."""
    return resources.files(__package__).joinpath("schema.json").read_text()


@dataclass(frozen=True)
class Entry:
    """One result.

    Args:
        content: As in the file, but for references, whose figures stand here where a file has their hash; checked here.
        identity: What the fingerprint of its data set is the hash of (``Manifest.identity``); empty if not known.

    Raises:
        EntryInvalid: It breaks the schema, or the identity is another data set's.
    """

    content: Mapping[str, Any]
    identity: bytes = field(default=b"", compare=False, repr=False)

    def __post_init__(self) -> None:
        found = schema().violations(self.content)
        if not found and self.identity:
            found += self._identity_violations()
        if not found and self.is_measured:
            found = [one for name, sums in self.by_episode.items() for one in _sums_violations(name, sums)]
            shared = (name for name, figures in self.content["reference"].items() if isinstance(figures, str))
            found += [f"reference.{name} is a hash without its figures" for name in shared]
            lone = (
                f"pictures[{place}].{name} is a hash without its picture"
                for place, picture in enumerate(self.content["pictures"])
                for name in ("current", "truth", "predicted")
                if HASH.fullmatch(picture[name])
            )
            found += lone
        if found:
            more = f" (and {len(found) - SHOWN_VIOLATIONS} more)" if len(found) > SHOWN_VIOLATIONS else ""
            raise EntryInvalid(f"it breaks the schema: {'; '.join(found[:SHOWN_VIOLATIONS])}{more}")

    @property
    def is_measured(self) -> bool:
        """Whether the entry is of a run, and not of a published table."""
        return bool(self.content["kind"] == "measured")

    @property
    def name(self) -> str:
        """The run's name, or the model and budget of a published row."""
        if self.is_measured:
            return str(self.content["run"])
        return f"{self.model} {self.labels} {self.environment}"

    @property
    def model(self) -> str:
        """The model's registry name."""
        return str(self.content["model"])

    @property
    def environment(self) -> str:
        """The environment's registry name."""
        return str(self.content["dataset"]["environment"] if self.is_measured else self.content["environment"])

    @property
    def version(self) -> int:
        """The version of the environment that a measured entry was scored in."""
        return int(self.content["dataset"].get(VERSION, 1))

    @property
    def actions(self) -> str:
        """The kind of actions that it was measured with, an ``ActionKind``; those of published ones are discrete."""
        return str(self.content["dataset"].get("actions", "discrete")) if self.is_measured else "discrete"

    @property
    def recipe(self) -> DatasetRecipe | None:
        """Makes the data set that a measured entry was scored on; None where that is not known."""
        return _recipe_of(self.identity) if self.identity else None

    def record_words(self, data: Path | str = "data") -> list[str]:
        """The words of the command that records its data set into a folder of ``data``; none if no command does."""
        if self.recipe is None or self.recipe.environment == IMPORTED or self.recipe.shard_episodes != SHARD_EPISODES:
            return []
        return record_words(self.recipe, Path(data) / _plain(self.content["dataset"]["name"]))

    def _identity_violations(self) -> list[str]:
        said = self.content["dataset"]
        if hashlib.sha256(self.identity).hexdigest() != said["fingerprint"]:
            return ["dataset.fingerprint is not that of the data set that stands beside it"]
        try:
            made = _recipe_of(self.identity).environment
        except ValueError as error:
            return [f"what stands beside it of its data set cannot be read: {error}"]
        return [] if made == self.environment else [f"dataset.environment is {said['environment']!r}, not {made!r}"]

    @property
    def trained_on(self) -> str | None:
        """The name of the run's own data set, where it was scored on another."""
        own = self.content["dataset"].get("trained_on") if self.is_measured else None
        return None if own is None else str(own["name"])

    @property
    def labels(self) -> str:
        """The label budget that was asked for."""
        return str(self.content["labels"]["asked"])

    @property
    def label_use(self) -> str:
        """In words how labels were used, where that is not the usual way."""
        return LABEL_USES.get(self.content["labels"].get("use", ""), "")

    @property
    def label_count(self) -> int | None:
        """The number of labels that were handed out; None if it is unknown."""
        count: int | None = self.content["labels"]["total"]
        return count

    @property
    def scored_by(self) -> Version:
        """The version of scoring; of measured entries."""
        code = self.content.get("code")
        version: Version = self.content["scoring_version"] if code is None else SCORING_OF_CODE.get(code, code)
        return version

    @property
    def planned_by(self) -> Version | None:
        """The version of control; None where control was not scored."""
        settings = self.content["settings"] if self.is_measured else {}
        code = settings.get("control_code")
        version: Version | None = settings.get("control_version") if code is None else CONTROL_OF_CODE.get(code, code)
        return version

    @functools.cached_property
    def planner(self) -> Planner | None:
        """What besides the model decides its figures of control; None where control was not scored."""
        version = self.planned_by
        if version is None:
            return None
        decisive = planning_settings(self.content["settings"])
        ended = next((name for name in self.by_episode if name.startswith(CONTROL)), "")
        return Planner(version, json.dumps([*decisive.values()], default=str), self.frames.get(ended))

    @property
    def made_by(self) -> str:
        """Which version of scoring, or of control by a column, made its figures; empty of this dmbench's."""
        of_column = self.column is not None
        version, present = (self.planned_by, CONTROL_VERSION) if of_column else (self.scored_by, SCORING_VERSION)
        what = "control of" if of_column else "scored by"
        return "" if version == present else f"{what} version {version}"

    @property
    def precision(self) -> str:
        """That the model predicted in."""
        return str(self.content["settings"]["precision"])

    @functools.cached_property
    def frames(self) -> Mapping[str, Frames]:
        """The samples that figures are the means of, by the figures whose sums over episodes come to the mean."""
        return {
            name: Frames(tuple(sums["episode"]), tuple(sums["n"]))
            for name, sums in self.by_episode.items()
            if name in self.figures and _is_mean_of(sums, self.figures[name])
        }

    def decisive(self, figure: str) -> str:
        """The settings that decide a figure beside those that a board has in common, as a text to compare."""
        return next((told for prefix, told in self._decisive.items() if figure.startswith(prefix)), "")

    @functools.cached_property
    def _decisive(self) -> Mapping[str, str]:
        """The settings of each of ``_DECIDE``."""
        settings = self.content["settings"]
        return {
            prefix: json.dumps({name: value for name, value in settings.items() if name.startswith(names)})
            for prefix, names in _DECIDE.items()
        }

    @property
    def column(self) -> str | None:
        """The column of the table of control that planned; None where control was planned otherwise, or not at all."""
        name = self.content["settings"].get("control_column") if self.is_measured else None
        return None if name is None else str(name)

    @property
    def figures(self) -> Mapping[str, FigureJson]:
        """The figures by their fixed names."""
        figures: Mapping[str, FigureJson] = self.content["figures"]
        return figures

    @property
    def by_episode(self) -> Mapping[str, Mapping[str, Any]]:
        """See ``comparison.sums_by_episode``; empty for published entries."""
        sums: Mapping[str, Mapping[str, Any]] = self.content.get("by_episode", {})
        return sums

    @property
    def pictures(self) -> list[Mapping[str, Any]]:
        """As the schema has them; empty for published entries."""
        pictures: list[Mapping[str, Any]] = self.content.get("pictures", [])
        return pictures

    @property
    def report(self) -> Mapping[str, Any]:
        """The part of a measured entry that is the run's report."""
        return {name: value for name, value in self.content.items() if name not in OWN_FIELDS}

    @property
    def slug(self) -> str:
        """The entry's name in files and links: plain letters, and different for every result."""
        plain = _plain(self.name)[:80]
        identity = [self.content.get(key) for key in ("run", "weights", "source", "environment")]
        identity += [self.content.get("dataset"), self.content.get("settings"), self.labels, self.model]
        return f"{plain}-{hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:8]}"


def _plain(name: str) -> str:
    """A name as plain letters, for files."""
    return re.sub(r"[^A-Za-z0-9_]+", "-", name).strip("-")


@functools.lru_cache(maxsize=64)
def _recipe_of(identity: bytes) -> DatasetRecipe:
    """``identified_recipe``, read once for all entries of a data set."""
    return identified_recipe(identity)


def _is_mean_of(sums: Mapping[str, Any], figure: FigureJson) -> bool:
    """Whether a figure is the mean of some sums over episodes, and of as many samples."""
    whole, mean = sum(sums["n"]), figure["mean"]
    if mean is None or not whole or figure["n"] != whole:
        return False
    return math.isclose(sum(sums["sum"]) / whole, mean, rel_tol=SUMMED, abs_tol=SUMMED)


def _sums_violations(name: str, sums: Mapping[str, Any]) -> Iterable[str]:
    episodes = sums["episode"]
    if not len(episodes) == len(sums["n"]) == len(sums["sum"]):
        yield f"by_episode.{name} has columns of different lengths"
    if sorted(set(episodes)) != episodes:
        yield f"by_episode.{name}.episode is not in order"


def published_entry(result: PublishedResult, count: int | None) -> Entry:
    """A row of a published table; ``count`` is the number of labels, if it is known."""
    return Entry(
        {
            "format": FORMAT,
            "kind": "published",
            "model": result.model,
            "environment": result.environment,
            "labels": {"asked": result.labels, "total": count},
            "figures": {name: figure.to_json() for name, figure in result.figures.items()},
            "source": result.source,
            "note": result.note,
        }
    )
