"""Data sets: the manifest, both tables, the shards of video and labels, the cache, and the files among themselves."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import DmbenchError
from dmotion_bench.learning.data.triplets import TripletSet
from dmotion_bench.storage.dataset import Dataset
from tests.fuzz.case import Answers, Case, Checksums, Fault, Probe
from tests.fuzz.command import dmbench
from tests.fuzz.mutations import pick
from tests.fuzz.mutations.arrow_file import spoil_arrow
from tests.fuzz.mutations.json_text import spoil_json
from tests.fuzz.mutations.mcap_file import spoil_mcap
from tests.fuzz.mutations.parquet_table import spoil_parquet
from tests.fuzz.mutations.plain import spoil_bytes
from tests.fuzz.targets import Target, copied
from tests.fuzz.worlds import MOVES, record_grid_world, write_noise

MANIFEST = "dataset.json"
PLAIN = 0.25
"""Share of the spoilt files whose bytes are spoilt without regard to their format."""


@dataclass
class SpoiltDataset:
    """A data set's folder, the original that it is a copy of, and the names of the files that were spoilt,
    and whether ``labels/`` was taken away, which is allowed."""

    path: Path
    original: str
    files: list[str]
    unlabelled: bool = False


class DatasetTarget(Target):
    """See above."""

    name: ClassVar[str] = "dataset"
    share: ClassVar[int] = 5

    def make(self) -> None:
        """Noise with labels, the same without, noise with continuous actions, and Grid World, to record anew."""
        write_noise(self.originals / "noise").cache()
        write_noise(self.originals / "moves", MOVES).cache()
        video = copied(self.originals / "noise", self.originals / "video")
        shutil.rmtree(video / "labels")
        record_grid_world(self.originals / "grid").cache()
        for name in dict.fromkeys(self.names()):
            (self.originals / f"{name}.frames").write_text(json.dumps(sorted(frames_of(self.originals / name))))

    def names(self) -> list[str]:
        return ["noise", "noise", "moves", "moves", "video", "grid"]

    def intact(self, case: Case, name: str) -> SpoiltDataset:
        return SpoiltDataset(copied(self.originals / name, case.folder / "data" / name), name, [])

    def spoil(self, case: Case) -> SpoiltDataset:
        spoilt = self.intact(case, pick(case.rng, self.names()))
        for _ in range(int(case.rng.choice([1, 1, 1, 2]))):
            self._spoil_file(case, spoilt)
        if case.checksums is Checksums.ALL:
            forge(spoilt.path, case)
        return spoilt

    def _spoil_file(self, case: Case, spoilt: SpoiltDataset) -> None:
        rng, kind = (
            case.rng,
            pick(
                case.rng,
                ("manifest",) * 4
                + ("episodes",) * 4
                + ("tasks", "tasks")
                + ("video",) * 4
                + ("labels",) * 3
                + ("cache",) * 3
                + ("files",),
            ),
        )
        if kind == "files":
            return _move_files(case, spoilt)
        files = {
            "manifest": [spoilt.path / MANIFEST],
            "episodes": [spoilt.path / "episodes.parquet"],
            "tasks": [spoilt.path / "tasks.parquet"],
            "video": sorted((spoilt.path / "video").glob("*.mcap")),
            "labels": sorted((spoilt.path / "labels").glob("*.mcap")),
            "cache": sorted(path for path in (spoilt.path / "cache").glob("*") if path.is_file()),
        }[kind]
        if not files:
            return None
        file = pick(rng, files)
        if not file.is_file():
            return None
        mend = case.checksums is not Checksums.KEPT
        spoil = {
            ".json": spoil_json,
            ".parquet": spoil_parquet,
            ".mcap": partial(spoil_mcap, mend=mend),
            ".arrow": partial(spoil_arrow, mend=mend),
        }.get(file.suffix, spoil_bytes)
        before = file.read_bytes()
        after, told = spoil_bytes(rng, before) if case.chance(PLAIN) else spoil(rng, before)
        file.write_bytes(after)
        name = str(file.relative_to(spoilt.path))
        case.tell(name, told)
        if after != before:
            spoilt.files.append(name)
        return None

    def probes(self, case: Case, spoilt: SpoiltDataset) -> Iterator[Probe]:
        path = spoilt.path
        os.environ["DMBENCH_WORKSPACE"] = str(case.folder)
        checks_first = case.chance(0.3)
        if checks_first:
            yield Probe("check", partial(_check, path))
        opened: list[Dataset] = []

        def open_it() -> Any:
            opened.append(Dataset.open(path))
            return identity(opened[0])

        yield Probe("open", open_it)
        yield Probe("info", lambda: dmbench("data", "info", str(path), "--json").json() and None)
        if case.chance(0.2):
            yield Probe("list", lambda: dmbench("list", "datasets", "--json").json() and None)
        if opened:
            yield from self._reads(case, opened[0])
        if not checks_first:
            yield Probe("check", partial(_check, path))
        if opened and case.chance(0.06):
            yield Probe("view", lambda: dmbench("view", str(path), "--save", str(case.folder / "a.rrd")).code and None)
        if opened and case.chance(0.04) and isinstance(opened[0].spec.actions, Discrete):
            yield Probe(
                "export",
                lambda: dmbench("data", "export", str(path), "--out", str(case.folder / "lerobot")).code and None,
            )
        if case.chance(0.12 if spoilt.original != "grid" else 0.4):
            yield Probe("repair", partial(_repair, path))
            yield Probe("repaired", partial(_frames_kept, path, self.originals / f"{spoilt.original}.frames"))

    def _reads(self, case: Case, dataset: Dataset) -> Iterator[Probe]:
        yield Probe("fingerprint", lambda: dataset.fingerprint)
        yield Probe("split", lambda: {name: dataset.split(name) for name in ("train", "validation", "test")})
        count = len(dataset)
        episodes = range(count) if count <= 12 else case.rng.choice(count, 8, replace=False).tolist()
        for episode in episodes:
            yield Probe(f"video {episode}", partial(dataset.video, episode))
            yield Probe(f"labels {episode}", partial(_labels, dataset, episode))
        yield Probe("tasks", lambda: [tuple(task) for task in dataset.tasks()])
        yield Probe("cache", partial(_cache, dataset))
        yield Probe("videos", partial(_videos, dataset))
        yield Probe("triplets", partial(_triplets, dataset))

    def judge(
        self, case: Case, spoilt: SpoiltDataset, answers: Answers, reference: dict[str, Any]
    ) -> Iterator[tuple[str, str]]:
        original = reference[spoilt.original]
        check, opened = answers.get("check"), answers.get("open")
        sound = check is not None and check.value == original["check"].value
        same_identity = opened is not None and opened.value == original["open"].value
        told = sound is False
        if case.checksums is Checksums.KEPT or (case.checksums is Checksums.INNER and not told):
            for name, answer in answers.items():
                belongs = name.startswith(("video", "labels", "cache", "tasks", "triplets", "repaired"))
                if name.startswith("repaired"):
                    continue
                if not belongs and not (same_identity and name in ("fingerprint", "split")):
                    continue
                if name == "triplets" and not same_identity:
                    continue
                wanted = original.get(name)
                if answer.value is not None and (wanted is None or answer.value != wanted.value):
                    yield "wrong content", f"{name.split()[0]} differs from the original's, of {_kinds(spoilt)}"
            damaged = [name for name in spoilt.files if name != MANIFEST and not name.startswith("cache")]
            if sound and damaged:
                yield "unnoticed", f"'data check' calls it sound, of {_kinds(spoilt)}"
        if sound:
            for name, answer in answers.items():
                if name.startswith("labels") and spoilt.unlabelled:
                    continue
                if (
                    name not in ("check", "repaired")
                    and answer.sentence
                    and original.get(name, answer).sentence is None
                ):
                    yield (
                        "check contradicted",
                        f"'data check' calls it sound, {name.split()[0]} fails, of {_kinds(spoilt)}: {answer.sentence}",
                    )
            videos, cache = answers.get("videos"), answers.get("cache")
            if videos and cache and videos.value and cache.value and videos.value != cache.value:
                yield "wrong content", f"the cache differs from the video, of {_kinds(spoilt)}"
        kept = answers.get("repaired")
        if kept is not None and case.checksums is Checksums.KEPT and kept.value == repr("others"):
            yield "wrong content", "a repaired data set holds frames that the original does not"


def identity(dataset: Dataset) -> dict[str, Any]:
    """What says which data set it is."""
    return {"recipe": dataset.recipe, "spec": dataset.spec, "fingerprint": dataset.fingerprint}


def _kinds(spoilt: SpoiltDataset) -> str:
    return " and ".join(sorted({name.partition("/")[0] for name in spoilt.files})) or "the files' names"


def _labels(dataset: Dataset, episode: int) -> Any:
    labels = dataset.labels(episode)
    parts = {name: getattr(labels, name) for name in ("actions", "pushed", "masks")}
    for who, states in (("agent", labels.agent), ("objects", labels.objects)):
        parts |= {f"{who}.{one.name}": getattr(states, one.name) for one in dataclasses.fields(states)}
    return parts | {"factors": dict(labels.factors)}


def _videos(dataset: Dataset) -> str:
    found = hashlib.sha256()
    for episode in range(len(dataset)):
        found.update(np.ascontiguousarray(dataset.video(episode)).data)
    return found.hexdigest()


def _cache(dataset: Dataset) -> str:
    cache = dataset.cache()
    found = hashlib.sha256()
    for episode in range(len(dataset)):
        found.update(np.ascontiguousarray(cache.episode(episode)).data)
    return found.hexdigest()


def _triplets(dataset: Dataset) -> Any:
    triplets = TripletSet.of_split(dataset, "train")
    index = np.arange(min(len(triplets), 16))
    return triplets.gather(index)


def _check(path: Path) -> Any:
    said = dmbench("data", "check", str(path), "--json").json()
    if said["sound"] is not True:
        raise Fault("no sentence", "'data check' ends well and says that something is damaged")
    return "sound"


def _repair(path: Path) -> Any:
    said = dmbench("data", "repair", str(path), "--json").json()
    assert said["how"] in ("sound", "restored", "salvaged", "cache")
    checked = dmbench("data", "check", str(path), "--json")
    if checked.code:
        raise Fault("repair", f"after it, 'data check' says: {checked.err}")
    return None


def frames_of(path: Path) -> set[str]:
    """A hash of every frame of a data set's video."""
    dataset = Dataset.open(path)
    return {hashlib.sha256(frame.tobytes()).hexdigest() for e in range(len(dataset)) for frame in dataset.video(e)}


def _frames_kept(path: Path, known: Path) -> str:
    """Whether every frame of a repaired data set is one of the original's."""
    try:
        found = frames_of(path)
    except DmbenchError:
        return "nothing to see"  # which the repair has said
    return "known" if found <= set(json.loads(known.read_text())) else "others"


def forge(path: Path, case: Case | None = None) -> None:
    """Make the manifest's sizes and hashes fit the files, as far as there still is a manifest."""
    manifest = path / MANIFEST
    if not manifest.is_file():
        return
    raw = manifest.read_bytes()
    try:
        content = json.loads(raw)
        before = fingerprint_of(content)
        for name in content["tables"]:
            content["tables"][name] = _facts(path / name)
        for index, shard in enumerate(content["shards"]):
            for kind in ("video", "labels"):
                file = path / kind / f"shard-{index:05d}.mcap"
                if shard[kind] is not None and file.is_file():
                    shard[kind] = _facts(file)
        text = json.dumps(content, indent=2) + "\n"
    except (ValueError, RecursionError, KeyError, TypeError, AttributeError, OSError):
        return
    if text.encode("utf-8", "surrogatepass") != raw:
        manifest.write_text(text, errors="surrogatepass")
    after = fingerprint_of(content)
    if after != before and (case is None or case.chance(0.7)):
        _forge_cache(path, before, after)


def fingerprint_of(content: Any) -> str:
    """As ``docs/format.md`` defines it."""
    parts = {key: content[key] for key in ("format", "recipe", "environment", "shards")}
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def _forge_cache(path: Path, before: str, after: str) -> None:
    for file in (path / "cache").glob(f"*{before[:16]}*"):
        if file.is_file():
            data = file.read_bytes().replace(before.encode(), after.encode())
            file.with_name(file.name.replace(before[:16], after[:16])).write_bytes(data)


def _facts(file: Path) -> dict[str, Any]:
    data = file.read_bytes()
    return {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def _move_files(case: Case, spoilt: SpoiltDataset) -> None:
    """Files that are gone, in one another's place, folders, links."""
    files = sorted(path for path in spoilt.path.rglob("*") if path.is_file())
    file, other = pick(case.rng, files), pick(case.rng, files)
    name = str(file.relative_to(spoilt.path))
    kind = pick(case.rng, ("gone", "folder", "link", "loop", "swap", "other", "labels", "extra", "unreadable"))
    if kind == "swap":
        first, second = file.read_bytes(), other.read_bytes()
        file.write_bytes(second)
        other.write_bytes(first)
        spoilt.files += [name, str(other.relative_to(spoilt.path))] if first != second else []
    elif kind == "other":
        spoilt.files += [name] if file.read_bytes() != other.read_bytes() else []
        file.write_bytes(other.read_bytes())
    elif kind == "labels":
        shutil.rmtree(spoilt.path / "labels", ignore_errors=True)
        spoilt.files = [name for name in spoilt.files if not name.startswith("labels")]
        spoilt.unlabelled, name = True, "labels"
    elif kind == "extra":
        (spoilt.path / "video" / "shard-99999.mcap").write_bytes(file.read_bytes())
    else:
        file.unlink()
        spoilt.files.append(name)
        if kind == "folder":
            file.mkdir()
        elif kind == "link":
            file.symlink_to("/nonexistent/file")
        elif kind == "loop":
            file.symlink_to(file.name)
        elif kind == "unreadable":
            file.write_bytes(b"")
    case.tell(name, kind)
