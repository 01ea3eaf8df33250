"""Publish a run or a data set: what is there already is not sent again, and what describes the rest comes last."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

from dmotion_bench.errors import DatasetCorrupt, DatasetError, FolderInUse, ShareCorrupt, UsageError
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.sharing.place import DATASETS, RUNS, Place, plain_name
from dmotion_bench.sharing.run_share import RunShare, share_of
from dmotion_bench.storage.atomic import write_atomically
from dmotion_bench.storage.check import labels_state
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.limits import LARGEST_MANIFEST
from dmotion_bench.storage.manifest import TABLES, Manifest
from dmotion_bench.storage.shard import LABELS, VIDEO, FileFacts, file_facts, shard_path
from dmotion_bench.wording import command, shown
from dmotion_bench.workspace import DATASET_MANIFEST

Kind = Literal["run", "data set"]
Tell = Callable[[str, int, int], None]
"""Told a name, how many of its files are done, and of how many."""
FILES: Final = "files"


@dataclass(frozen=True, kw_only=True)
class Pushed:
    """What was published.

    Attributes:
        kind, name: Of what.
        fingerprint: The hash of its weights or of its content, under which it stands.
        address: Of its folder in the place.
        files, sent: All of its files there, and those that were not there before.
        bytes: Of those that were sent.
        labels: Whether labels of a data set are there.
        scored: Whether there is a report of a run.
    """

    kind: Kind
    name: str
    fingerprint: str
    address: str
    files: int
    sent: int
    bytes: int
    labels: bool = False
    scored: bool = False


def push_run(place: Place, run: Run, *, mend: bool, tell: Tell) -> Pushed:
    """Publish a run: its weights, settings, curves and reports; never labels.

    Args:
        place: Where.
        run: Trained to its end.
        mend: Read what is there already, and replace what is damaged.
        tell: Told how far it is.

    Raises:
        RunMissing, RunCorrupt: It is not finished, or damaged.
        UsageError: It has what nobody could fetch, such as more reports than a manifest may list.
        FolderInUse: A file changed meanwhile.
        PlaceUnreachable: The place does not take it.
    """
    share = share_of(run)
    _require_plain("run", share.name)
    _require_plain("data set", share.dataset)
    try:
        RunShare.parse(share.content())
    except ValueError as error:
        raise UsageError(
            f"the run {shown(share.name)} cannot be published, for nobody could fetch it: its manifest would be "
            f"refused ({error})."
        ) from None
    folder = f"{RUNS}/{share.weights}"
    files = {f"{folder}/{FILES}/{facts.sha256}": (run.path / name, facts) for name, facts in share.files.items()}
    sent = _send(place, files, place.sizes(f"{folder}/{FILES}"), share.name, mend=mend, tell=tell)
    with tempfile.TemporaryDirectory() as scratch:
        manifest = Path(scratch) / f"{share.digest}.json"
        manifest.write_bytes(share.content())
        name, facts = f"{folder}/{manifest.name}", file_facts(manifest)
        new = _send(place, {name: (manifest, facts)}, place.sizes(folder), share.name, mend=mend)
    return Pushed(
        kind="run",
        name=share.name,
        fingerprint=share.weights,
        address=f"{place.address}/{folder}",
        files=len(files) + 1,
        sent=len(sent) + len(new),
        bytes=sum(facts.size for _, facts in (sent | new).values()),
        scored=bool(share.samples),
    )


def push_dataset(place: Place, dataset: Dataset, *, labels: bool, mend: bool, tell: Tell) -> Pushed:
    """Publish a data set, which can then be opened by the address of its folder there.

    Args:
        place: Where.
        dataset: In a folder of this machine; each file is held against its hash before it is sent.
        labels: Whether to publish ``labels/``, where it is there.
        mend: Read what is there already, and replace what is damaged.
        tell: Told how far it is.

    Raises:
        DatasetCorrupt: A file is not what was recorded.
        UsageError: It is on object storage already.
        FolderInUse: A file changed meanwhile.
        ShareCorrupt: What is there is damaged, and nothing is to be mended.
        PlaceUnreachable: The place does not take it.
    """
    if dataset.remote is not None:
        raise UsageError(
            f"{shown(dataset.remote.address)} is on object storage, where others can open it by its address; "
            "only data sets in a folder are published."
        )
    _require_plain("data set", dataset.name)
    standing = standing_name(place, dataset.fingerprint)
    folder = f"{DATASETS}/{dataset.fingerprint}/{standing or dataset.name}"
    there = labels_state(dataset.path, dataset.manifest) == "present"
    kinds = (VIDEO, LABELS) if labels and there else (VIDEO,)
    sent = dict[str, tuple[Path, FileFacts]]()
    files = {kind: _shards(dataset, kind) for kind in kinds}
    total = sum(map(len, files.values())) + len(TABLES) + 1
    for kind, own in files.items():
        named = {f"{folder}/{kind}/{path.name}": (path, facts) for path, facts in own}
        done = 0 if kind == VIDEO else len(files[VIDEO])

        def told(_name: str, count: int, _all: int, done: int = done) -> None:
            tell(dataset.name, done + count, total)

        sent |= _send(place, named, place.sizes(f"{folder}/{kind}"), dataset.name, mend=mend, tell=told)
    if not standing or not _tables_stand(place, folder, dataset.fingerprint, mend=mend):
        sent |= _send_tables(place, folder, dataset)
    tell(dataset.name, total, total)
    return Pushed(
        kind="data set",
        name=dataset.name,
        fingerprint=dataset.fingerprint,
        address=f"{place.address}/{folder}",
        files=total,
        sent=len(sent),
        bytes=sum(facts.size for _, facts in sent.values()),
        labels=labels_stand(place, folder, dataset.manifest),
    )


def standing_name(place: Place, fingerprint: str) -> str:
    """The name under which a data set is published; empty if it is not there."""
    names = [name for name in place.folders(f"{DATASETS}/{fingerprint}") if plain_name(name)]
    return next((name for name in names if DATASET_MANIFEST in place.sizes(f"{DATASETS}/{fingerprint}/{name}")), "")


def labels_stand(place: Place, folder: str, manifest: Manifest) -> bool:
    """Whether every shard's labels are published, as long as they were recorded."""
    found = place.sizes(f"{folder}/{LABELS}")
    facts = {shard_path(Path(), LABELS, index).name: one.labels for index, one in enumerate(manifest.shards)}
    return bool(facts) and all(one is not None and found.get(name) == one.size for name, one in facts.items())


def read_standing(place: Place, folder: str, fingerprint: str) -> Manifest:
    """The ``dataset.json`` of a published data set, if it is one of this fingerprint.

    Raises:
        FileNotFoundError: There is none.
        ValueError: It is another, or none; says why.
    """
    content = place.read(f"{folder}/{DATASET_MANIFEST}", largest=LARGEST_MANIFEST)
    with tempfile.TemporaryDirectory() as scratch:
        write_atomically(Path(scratch) / DATASET_MANIFEST, content)
        try:
            manifest = Manifest.read_complete(Path(scratch))
        except DatasetError as error:
            said = str(error).replace(scratch, f"{place.address}/{folder}")  # where it is, not where it was read
            raise ValueError(f"its {DATASET_MANIFEST} cannot be used: {said}".rstrip(".")) from None
    if manifest.fingerprint != fingerprint:
        raise ValueError(f"its {DATASET_MANIFEST} has the fingerprint {manifest.fingerprint[:12]}")
    return manifest


def _require_plain(kind: str, name: str) -> None:
    if not plain_name(name):
        raise UsageError(f"the {kind} is named {shown(name)}, which can be no name in a place; rename its folder.")


def _shards(dataset: Dataset, kind: str) -> list[tuple[Path, FileFacts]]:
    """The shards of a kind, each as it was recorded.

    Raises:
        DatasetCorrupt: One is not.
    """
    found = []
    for index, shard in enumerate(dataset.manifest.shards):
        path, facts = shard_path(dataset.path, kind, index), shard.video if kind == VIDEO else shard.labels
        if facts is not None:
            _require_sound(dataset, path, facts)
            found.append((path, facts))
    return found


def _require_sound(dataset: Dataset, path: Path, facts: FileFacts) -> None:
    if not path.is_file() or file_facts(path) != facts:
        raise DatasetCorrupt(
            f"{shown(str(path))} is not what was recorded, so it is not published; mend the data set with "
            f"{command('dmbench data repair', dataset.path)}."
        )


def _send(
    place: Place,
    files: Mapping[str, tuple[Path, FileFacts]],
    there: Mapping[str, int],
    name: str,
    *,
    mend: bool,
    tell: Tell = lambda _name, _done, _all: None,
) -> dict[str, tuple[Path, FileFacts]]:
    """Send the files that are not there yet; their names decide their content, so the right size is enough.

    Args:
        place: Where.
        files: By their names there.
        there: The sizes of the files of their folder.
        name: What they belong to.
        mend: Whether files that are there are read.
        tell: Told how far it is.

    Raises:
        FolderInUse: One changed meanwhile; none of them stays.
    """
    sent = {}
    for done, (target, (path, facts)) in enumerate(files.items()):
        tell(name, done, len(files))
        stands = there.get(target.rpartition("/")[2]) == facts.size
        if not stands or (mend and not place.holds(target, facts)):
            place.write(path, target)
            sent[target] = (path, facts)
            if file_facts(path) != facts:  # what was sent may be neither
                for one in sent:
                    place.remove(one)
                raise _changed(path)
    return sent


def _changed(path: Path) -> FolderInUse:
    return FolderInUse(f"{shown(str(path))} changed while it was published; it does not stay. Publish it again.")


def _tables_stand(place: Place, folder: str, fingerprint: str, *, mend: bool) -> bool:
    """Whether ``dataset.json`` and the tables there belong together; another dmbench may have written them otherwise.

    Raises:
        ShareCorrupt: They do not, and nothing is to be mended.
    """
    try:
        manifest = read_standing(place, folder, fingerprint)
        sizes = place.sizes(folder)
        wrong = [name for name, facts in manifest.tables.items() if sizes.get(name) != facts.size]
        if mend:
            wrong += [name for name, facts in manifest.tables.items() if not place.holds(f"{folder}/{name}", facts)]
        said = f"its {wrong[0]} is not what its {DATASET_MANIFEST} says" if wrong else ""
    except (FileNotFoundError, ValueError) as error:
        said = str(error)
    if said and not mend:
        raise ShareCorrupt(
            f"{shown(f'{place.address}/{folder}')} is damaged: {said}. Nothing was replaced; to write it anew, run the "
            "same command with '--mend'."
        )
    return not said


def _send_tables(place: Place, folder: str, dataset: Dataset) -> dict[str, tuple[Path, FileFacts]]:
    """Write the tables and then ``dataset.json``, which is taken away first: a mixture is never there.

    Raises:
        DatasetCorrupt: A table is not what was recorded.
        FolderInUse: Another command has changed the data set meanwhile, as a recording of more episodes.
    """
    files = {f"{folder}/{name}": (dataset.path / name, facts) for name, facts in dataset.manifest.tables.items()}
    for path, facts in files.values():
        _require_sound(dataset, path, facts)
    with tempfile.TemporaryDirectory() as scratch:
        manifest, same = Path(scratch) / DATASET_MANIFEST, False
        shutil.copyfile(dataset.path / DATASET_MANIFEST, manifest)
        with contextlib.suppress(DatasetError):
            same = Manifest.read(manifest.parent) == dataset.manifest
        if not same:
            raise _changed(dataset.path / DATASET_MANIFEST)
        place.remove(f"{folder}/{DATASET_MANIFEST}")
        sent = _send(place, files, {}, dataset.name, mend=False)
        return sent | _send(
            place, {f"{folder}/{DATASET_MANIFEST}": (manifest, file_facts(manifest))}, {}, dataset.name, mend=False
        )
