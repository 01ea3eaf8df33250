"""The sources of an entry: find the run and the data set with its hashes, and compare what they say."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from dmotion_bench.actions import kind_of
from dmotion_bench.addresses import remote_address
from dmotion_bench.errors import DatasetError, DmbenchError, RunMismatch
from dmotion_bench.learning.data.curriculum import labels_given
from dmotion_bench.learning.data.label_request import LabelRequest
from dmotion_bench.learning.data.labels import LabelBudget
from dmotion_bench.learning.data.triplets import SplitProtocol, TripletSet
from dmotion_bench.learning.runs.run import Run, RunSpec
from dmotion_bench.registry import model_class
from dmotion_bench.scoring.earlier_planning import present_planning
from dmotion_bench.scoring.label_use import label_use
from dmotion_bench.scoring.references import published_for
from dmotion_bench.scoring.report import CONTRACT, LATER_TRAINING, protocol_of, read_report, training_facts
from dmotion_bench.scoring.transfer import own_dataset, training_is_here, training_of, transferable
from dmotion_bench.specs import IMPORTED
from dmotion_bench.storage.check import cache_damages, labels_state, table_damages
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.shard import LABELS, VIDEO, FileFacts, file_facts, shard_path
from dmotion_bench.wording import command, shown
from dmotion_bench.workspace import Workspace
from leaderboard.verdict import SHOWN, Findings

ELSEWHERE: Final = (
    "if it is in another workspace, go there or name it with DMBENCH_WORKSPACE; if it was published, fetch it with "
    "'--from PLACE'"
)


def find_run(check: Findings, workspace: Workspace) -> Run | None:
    """The run with the entry's weights; of several the one with the entry's name."""
    wanted, found = check.entry.content["weights"], list[Run]()
    for path in workspace.all_runs():
        try:
            run = Run.open(path)
        except DmbenchError:
            continue
        if run.result is not None and run.result["weights"] == wanted:
            found.append(run)
        elif run.name == check.entry.name and run.result is not None:
            check.remarks.append(f"the run {str(path)!r} has other weights: {run.result['weights'][:12]}")
    if not found:
        check.missing.append(f"weights: no run in {str(workspace.runs)!r} has the hash {wanted[:12]}; {ELSEWHERE}")
        return None
    return next((run for run in found if run.name == check.entry.name), found[0])


def find_dataset(check: Findings, workspace: Workspace, run: Run | None = None) -> Dataset | None:
    """The data set with the entry's fingerprint, its files as they were recorded; of copies the one with its name.

    Where the workspace has none, it is looked for where the run was trained.
    """
    said = check.entry.content["dataset"]
    found = list(_of_fingerprint(said["fingerprint"], workspace.datasets()))
    found = found or list(_of_fingerprint(said["fingerprint"], _remote_of(run)))
    if not found:
        check.missing.append(
            f"data set: none in {str(workspace.data)!r} has the fingerprint {said['fingerprint'][:12]}; {ELSEWHERE}"
            + (f"; or record it: {command(*words)}" if (words := check.entry.record_words(workspace.data)) else "")
        )
        return None
    chosen = next((dataset for dataset in found if dataset.name == said["name"]), found[0])
    if labels_state(chosen.path, chosen.manifest, chosen.remote) == "missing":
        check.missing.append(f"labels: {shown(str(chosen.where))} is here without them, and a check takes them")
        return None
    check.wrong += [f"data set: {chosen.name}/{damage}" for damage in _damages(chosen)]
    return chosen


def _of_fingerprint(fingerprint: str, paths: Iterable[Path]) -> Iterator[Dataset]:
    for path in paths:
        try:
            dataset = Dataset.open(path)
        except DmbenchError:
            continue
        if dataset.fingerprint == fingerprint:
            yield dataset


def _remote_of(run: Run | None) -> Iterator[Path]:
    """The address of the data set that a run was trained on, if it is on object storage and was opened from here."""
    if run is None or remote_address(run.manifest["dataset_path"]) is None:
        return
    with contextlib.suppress(DmbenchError):
        yield run.dataset_path


def _damages(dataset: Dataset) -> Iterator[str]:
    """The files, and the cached frames, that differ from what the fingerprint says; and tables from the recordings."""
    for index, shard in enumerate(dataset.manifest.shards):
        for kind, facts in ((VIDEO, shard.video), (LABELS, shard.labels)):
            file = shard_path(dataset.path, kind, index)
            if facts is not None and not _is_sound(dataset, kind, index, facts):
                yield f"{kind}/{file.name} is not what was recorded"
                return
    for damage in table_damages(dataset):  # the fingerprint says nothing of them: other tasks would have the same
        yield f"{damage.file} {damage.what}; mend it with {command('dmbench data repair', dataset.where)}"
        return
    for damage in cache_damages(dataset):
        yield f"{damage.file} {damage.what}; delete it"


def _is_sound(dataset: Dataset, kind: str, index: int, facts: FileFacts) -> bool:
    """Whether a shard's file is there, with the bytes that were recorded."""
    file = shard_path(dataset.path, kind, index)
    if dataset.remote is not None:
        try:
            file = dataset.remote.shard(kind, index, dataset.manifest)
        except (FileNotFoundError, DatasetError):
            return False
    return file.is_file() and file_facts(file) == facts


def as_read(check: Findings, run: Run, dataset: Dataset) -> Dataset | None:
    """The data set as the run's model reads it; None if the run cannot be scored on it, which is a finding.

    Raises:
        DatasetError: That takes the data set of the training, which is not there or damaged.
    """
    if dataset.fingerprint == run.spec.fingerprint:
        return dataset
    if not training_is_here(run) and dataset.recipe.environment != IMPORTED:
        check.missing.append(
            f"data set of the training: only {str(run.dataset_path)!r} says which episodes are new to the run, and it "
            "is not there or has changed; record it again, or fetch it with '--from PLACE'"
        )
    try:
        return transferable(run, dataset, "test", check.entry.column)
    except RunMismatch as error:
        check.wrong.append(f"data set: {error}")
    return None


def against_run(check: Findings, run: Run, dataset: Dataset, report: Path) -> None:
    """Compare an entry with its run, its data set and the run's report on that data set."""
    content, spec, result = check.entry.content, run.spec, run.result or {}
    for name in ("model", "arch", "preset", "seed"):
        check.expect(name, content[name], getattr(spec, name))
    check.expect("run", content["run"], run.name)
    check.expect("labels.asked", content["labels"]["asked"], spec.labels)
    check.expect("labels.given", content["labels"]["given"], result.get("labels", {}))
    check.expect("labels.total", content["labels"]["total"], result.get("labels_total", 0))
    given = sum(content["labels"]["given"].values())
    check.expect("labels.total, the sum of labels.given", content["labels"]["total"], given)
    check.expect("labels.use", content["labels"].get("use", ""), label_use(spec, model_class(spec.model).supervision))
    elsewhere = dataset.fingerprint != spec.fingerprint
    check.expect("settings.protocol", content["settings"]["protocol"], "episode" if elsewhere else spec.protocol)
    check.expect("protocol", content["protocol"], protocol_of(check.entry.column))
    facts, said = training_facts(result), content["training"]
    for name in {**facts, **said}:
        if name in said or name not in LATER_TRAINING:
            check.expect(f"training.{name}", said.get(name), facts.get(name))
    check.expect("dataset.trained_on", content["dataset"].get("trained_on"), training_of(run, dataset))
    check.expect("dataset.name", content["dataset"]["name"], dataset.name)
    check.expect("dataset.environment", check.entry.environment, dataset.recipe.environment)
    check.expect("dataset.actions", check.entry.actions, kind_of(dataset.spec.actions))
    check.expect("dataset.version", check.entry.version, dataset.recipe.version)
    environment, actions = check.entry.environment, dataset.spec.actions
    published = None if elsewhere else published_for(spec.model, environment, spec.labels, actions=actions)
    ours = {} if published is None else {name: one.to_json() for name, one in published.figures.items()}
    check.expect_figures("reference.paper", content["reference"].get("paper", {}), ours)
    if CONTRACT in content["remarks"]:
        check.remarks.append(f"{CONTRACT}: {content['remarks'][CONTRACT]}")
    if changed := run.changed_modules:
        check.remarks.append(
            f"the code of the model was changed since the training ({', '.join(changed[:SHOWN])}"
            f"{' and others' if len(changed) > SHOWN else ''}): what is checked is the present code"
        )
    _against_report(check, report)


def same_labels(check: Findings, run: Run, dataset: Dataset) -> None:
    """Compare the number of labels that a run says it was given with what its budget gives on its data set.

    Args:
        check: Takes down what is found.
        run: Has the entry's weights.
        dataset: That the entry was scored on: the one of the training, or another beside which that may be here.

    Raises:
        LabelsNotAvailable: The budget does not allow them.
    """
    trained_on = dataset if dataset.fingerprint == run.spec.fingerprint else own_dataset(run)
    if trained_on is None:
        return  # as_read says that it is missing
    if labels_state(trained_on.path, trained_on.manifest, trained_on.remote) == "missing":
        check.remarks.append(f"labels: {shown(trained_on.name)} is here without them, so they were not counted again")
        return
    found = labels_of(run.spec, trained_on)
    said = {purpose: count for purpose, count in check.entry.content["labels"]["given"].items() if count}
    check.expect(f"labels.given, by the budget {run.spec.labels} and the data set", said, found)


def labels_of(spec: RunSpec, dataset: Dataset) -> dict[str, int]:
    """How many labels a run's budget gives on its data set, by purpose.

    Raises:
        LabelsNotAvailable: The data set does not have them.
    """
    protocol: SplitProtocol = "paper" if spec.protocol == "paper" else "episode"
    train, validation = (TripletSet.of_split(dataset, name, protocol) for name in ("train", "validation"))
    budget = LabelBudget(dataset, LabelRequest.parse(spec.labels), spec.seed)
    given = labels_given(train, validation, budget, model_class(spec.model).supervision)
    return {purpose: count for purpose, count in given.items() if count}


def _against_report(check: Findings, folder: Path) -> None:
    """Compare the parts that only the report on disk can confirm; its owner could change it like the entry."""
    try:
        report = read_report(folder)
    except DmbenchError as error:
        check.wrong.append(f"report: {error}")
        return
    if report is None:
        check.wrong.append(f"report: there is none of this protocol in {str(folder)!r}")
        return
    for name in ("training", "versions", "remarks"):
        check.expect(name, check.entry.content.get(name, {}), getattr(report, name))
    said, own = (present_planning(one) for one in (check.entry.content.get("planning", {}), report.planning))
    check.expect("planning", said, own)
