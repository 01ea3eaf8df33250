"""Build the leaderboard's folder from scored runs, other people's entries and the paper's tables.

::

    index.html       the page
    schema.json      what an entry is
    entries/         one JSON file an entry, measured and published; in references/ what they share

The folder can be copied anywhere, put on any static host, or opened from the disk.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dmotion_bench.errors import DatasetError, DmbenchError, EntryInvalid, RunError, UsageError
from dmotion_bench.learning.runs.own_data import find_own_data
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.references import published_results
from dmotion_bench.scoring.report import PROTOCOL, REPORT_FILE, REPORT_FOLDER, TRANSFERS, Report
from dmotion_bench.scoring.transfer import fitting, transfer_folders
from dmotion_bench.storage.atomic import remove_leftovers, write_atomically
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.json_file import read_json
from dmotion_bench.storage.links import require_within
from dmotion_bench.wording import command, shown
from dmotion_bench.workspace import DATASET_MANIFEST, RUN_MANIFEST
from leaderboard.action_texts import actions_of
from leaderboard.comparison import as_in_an_entry, scored, sums_by_episode
from leaderboard.entry import FORMAT, Entry, published_entry, schema_text
from leaderboard.entry_file import read_entries, read_entry, remove_unused_references, write_entry
from leaderboard.layout import ENTRIES, PAGE, REFERENCES, SCHEMA
from leaderboard.page import make_page
from leaderboard.paper import label_count
from leaderboard.pictures import shows_pictures, take_pictures

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, kw_only=True)
class Built:
    """The result of building a leaderboard.

    Attributes:
        page: The page's file.
        measured, published: Entries of each kind.
        left_out: By the runs' names, why they have no entry; by their files' names, why given entries are not shown.
        doubtful: Entries that were left in the folder although they have the name of one of the runs, as file names:
            they are of an earlier training, or of somebody else's.
    """

    page: Path
    measured: int
    published: int
    left_out: dict[str, str]
    doubtful: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """What ``dmbench leaderboard build --json`` prints."""
        return {
            "page": str(self.page),
            "measured": self.measured,
            "published": self.published,
            "left_out": self.left_out,
            "doubtful": list(self.doubtful),
        }


def build(
    runs: Sequence[Path], given: Sequence[Path], out: Path, *, on_progress: Progress = lambda _what, _done, _all: None
) -> Built:
    """Build the leaderboard of some runs and of entries that others made.

    Args:
        runs: Scored runs; those that are not are left out, and it is said why.
        given: Entry files, or folders of them. None replaces what the paper published, or one that is given before.
        out: The folder; made if need be. Entries of earlier scorings of these runs are taken away, other files left
            alone: an entry of other weights may be another author's, whose run has the same name.
        on_progress: Told which run is at work, how many are done, and of how many.

    Raises:
        EntryInvalid: A given entry is none.
        UsageError: The folder holds a page of another kind, data sets or runs, or what is written into it would be
            written elsewhere.
    """
    _require_place(out)
    for inner in (out / ENTRIES, out / ENTRIES / REFERENCES):
        require_within(inner, out, "leaderboard", UsageError)
    found: dict[str, Entry] = {}
    own: list[Entry] = []
    left_out: dict[str, str] = {}
    published = [published_entry(row, label_count(row.environment, row.labels)) for row in published_results()]
    for entry in (*published, *_given(given)):
        if found.setdefault(entry.slug, entry).content != entry.content:
            left_out[f"{entry.slug}.json"] = (
                "another entry of the same result says something else, and was there before"
            )
    for place, path in enumerate(runs):
        on_progress(path.name, place, len(runs))
        for folder in (None, *transfer_folders(path)):
            try:
                own.append(entry_of_run(path, folder, earlier=out / ENTRIES))
            except DmbenchError as error:
                where = "" if folder is None else f" on {folder.relative_to(path / REPORT_FOLDER / TRANSFERS)}"
                left_out[f"{path.name}{where}"] = str(error)
    on_progress("", len(runs), len(runs))
    entries = list((found | {entry.slug: entry for entry in own}).values())
    for folder in (out, out / ENTRIES, out / ENTRIES / REFERENCES):
        remove_leftovers(folder)
    if (out / PAGE).is_file() and not (out / PAGE).is_symlink():
        with contextlib.suppress(PermissionError):  # somebody else's
            os.utime(out / PAGE, (0, 0))  # older than every entry until it is written anew, even if the clock went back
    for entry in entries:
        write_entry(entry, out / ENTRIES)
    doubtful = _remove_outdated(out / ENTRIES, entries, own)
    remove_unused_references(out / ENTRIES)
    write_atomically(out / SCHEMA, schema_text().encode())
    write_atomically(out / PAGE, make_page(entries).encode())
    measured = sum(entry.is_measured for entry in entries)
    return Built(
        page=out / PAGE,
        measured=measured,
        published=len(entries) - measured,
        left_out=left_out,
        doubtful=tuple(doubtful),
    )


def _require_place(out: Path) -> None:
    """Refuse a folder that holds no leaderboard and something else that a page may not stand beside.

    Raises:
        UsageError: It holds a page of another kind, or data sets or runs.
    """
    if (out / PAGE).exists():
        if not (out / SCHEMA).exists():
            raise UsageError(
                f"{shown(str(out / PAGE))} is no leaderboard's page; name another folder with '--out DIR'."
            )
        return
    for kind, manifest in (("a data set", DATASET_MANIFEST), ("a run", RUN_MANIFEST)):
        if (held := next((one for at in (manifest, f"*/{manifest}") for one in out.glob(at)), None)) is not None:
            raise UsageError(
                f"{shown(str(out))} holds {kind} and no leaderboard ({shown(str(held))}); name another folder with "
                "'--out DIR'."
            )


def _remove_outdated(folder: Path, entries: Sequence[Entry], own: Sequence[Entry]) -> list[str]:
    """Remove entries of runs that have been scored again since an earlier build.

    Returns:
        The files of entries that have a run's name and stay, since nothing shows that they are of this run.
    """
    current = {entry.slug for entry in entries}
    scorings, runs = {_scoring(entry) for entry in own}, {_of_run(entry) for entry in own}
    doubtful = []
    for path in sorted(folder.glob("*.json")):
        if path.stem in current:
            continue
        with contextlib.suppress(EntryInvalid):  # what is no entry is somebody else's
            old = read_entry(path)
            if not old.is_measured or path.stem != old.slug:
                continue
            if _scoring(old) in scorings:
                path.unlink()
            elif _of_run(old) in runs:
                doubtful.append(path.name)
    return doubtful


def _of_run(entry: Entry) -> tuple[str, str, str | None]:
    """What the entries of a run's trainings have in common, and with them those of another run of its name."""
    return entry.name, str(entry.content["dataset"]["name"]), entry.column


def _scoring(entry: Entry) -> tuple[str, ...]:
    """What only entries of one and the same training have in common, scored on the same data set for the same table."""
    return (*map(str, _of_run(entry)), str(entry.content["dataset"]["fingerprint"]), str(entry.content["weights"]))


def _given(paths: Iterable[Path]) -> list[Entry]:
    found: list[Entry] = []
    for path in paths:
        if path.is_dir():
            own = read_entries(path)
            if not own:
                raise EntryInvalid(f"{str(path)!r} holds no entry (no .json file).")
            found += own
        else:
            found.append(read_entry(path))
    return found


def entry_of_run(path: Path, folder: Path | None = None, *, earlier: Path | None = None) -> Entry:
    """The entry of a scored run.

    Args:
        path: Its folder.
        folder: Of a report on another data set; its own if left out.
        earlier: Where an entry of it may stand already; its pictures are kept if the report is still the same.

    Raises:
        RunMissing: It is not scored, or not trained to its end.
        EntryInvalid: Its report is of weights or data that the run no longer has.
    """
    folder = path / REPORT_FOLDER if folder is None else folder
    run = Run.open(path)
    report, samples = scored(path, folder)
    trained_on = report.dataset.get("trained_on", report.dataset)
    if (
        run.result is None
        or run.result["weights"] != report.weights
        or run.spec.fingerprint != trained_on["fingerprint"]
    ):
        raise EntryInvalid(
            f"the report of {str(path)!r} is of an earlier training; score it with {command('dmbench score', path)}."
        )
    stored = read_json(folder / REPORT_FILE)
    content: dict[str, Any] = {"format": FORMAT, "kind": "measured", "protocol": PROTOCOL}
    content |= stored
    content |= {
        "figures": as_in_an_entry(stored["figures"]),
        "reference": {name: as_in_an_entry(figures) for name, figures in stored["reference"].items()},
    }
    content |= {"by_episode": sums_by_episode(samples), "control": actions_of(samples), "pictures": []}
    dataset = _dataset(run, report)
    entry = Entry(content, b"" if dataset is None else dataset.manifest.identity)
    if not shows_pictures(run.spec.labels):
        return entry
    old = _standing(earlier, entry)
    if old is not None:
        return old if old.identity else replace(old, identity=entry.identity)
    read = None if dataset is None else _as_read(run, dataset)
    if read is None:
        return entry  # a page without this model's pictures is still a page
    return replace(entry, content=content | {"pictures": take_pictures(run, read, samples)})


def _dataset(run: Run, report: Report) -> Dataset | None:
    """The data set that a report was scored on, if it still exists unchanged."""
    try:
        own = run.dataset_path
        path = own if report.trained_on is None else own.parent / Path(report.dataset["name"]).name
        workspace = run.path.absolute().parent.parent
        dataset = Dataset.open(find_own_data([path], [workspace], report.dataset["fingerprint"]) or path)
    except (DatasetError, RunError):
        return None
    return dataset if dataset.fingerprint == report.dataset["fingerprint"] else None


def _as_read(run: Run, dataset: Dataset) -> Dataset | None:
    """A data set as the run's model reads it; None if that cannot be told."""
    try:
        return dataset if dataset.fingerprint == run.spec.fingerprint else fitting(run, dataset)
    except (DatasetError, RunError):
        return None


def _standing(folder: Path | None, entry: Entry) -> Entry | None:
    """The entry that was built earlier, if its content is the same."""
    path = None if folder is None else folder / f"{entry.slug}.json"
    if path is None or not path.is_file():
        return None
    try:
        old = read_entry(path)
    except EntryInvalid:
        return None
    same = {**old.content, "pictures": None} == {**entry.content, "pictures": None}
    return old if same and old.pictures else None
