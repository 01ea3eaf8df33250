"""Places where runs and data sets are published: manifests, files under their hashes, names, and entries to check."""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from dmotion_bench.errors import DmbenchError
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.storage.check import check_dataset
from dmotion_bench.storage.dataset import Dataset
from tests.fuzz.case import Answers, Case, Checksums, Fault, Probe
from tests.fuzz.command import dmbench
from tests.fuzz.mutations import pick
from tests.fuzz.mutations.json_text import spoil_json, spoil_lines
from tests.fuzz.mutations.mcap_file import spoil_mcap
from tests.fuzz.mutations.names import spoil_names
from tests.fuzz.mutations.parquet_table import spoil_parquet
from tests.fuzz.mutations.plain import spoil_bytes
from tests.fuzz.mutations.weights import spoil_weights
from tests.fuzz.targets import Target, copied
from tests.fuzz.targets.entry import figures_of, same_figures
from tests.fuzz.targets.published import DATA, ENTRIES, RUN, SpoiltPlace, forge
from tests.fuzz.worlds import write_noise

PLAIN = 0.2
"""Share of the spoilt files whose bytes are spoilt without regard to their format."""


class ShareTarget(Target):
    """See above."""

    name: ClassVar[str] = "share"
    share: ClassVar[int] = 1

    def make(self) -> None:
        """A scored run with its data set and its entry, published with labels."""
        workspace = self.originals / "published" / "workspace"
        write_noise(workspace / "data" / DATA)
        os.environ["DMBENCH_WORKSPACE"] = str(workspace)
        dmbench("train", "fuzz-small", "--data", DATA, "--out", str(workspace / "runs" / RUN)).done()
        dmbench("score", RUN, "--horizon", "2").done()
        dmbench("leaderboard", "build").done()
        for folder in (workspace / "data" / DATA / "cache", workspace / "runs" / RUN / "samples"):
            _emptied(folder)
        entry = next((workspace / ENTRIES).glob(f"{RUN}*.json"))
        dmbench("share", "push", str(entry), "--to", str(self.originals / "published" / "place")).done()

    def names(self) -> list[str]:
        return ["published"]

    def intact(self, case: Case, name: str) -> SpoiltPlace:
        for folder in ("place", "workspace"):
            copied(self.originals / name / folder, case.folder / folder)
        beside = case.folder / "beside"
        beside.mkdir()
        (beside / "secret").write_text("nobody may read or change this\n")
        weights, fingerprint = (_only_folder(case.folder / "place" / kind) for kind in ("runs", "datasets"))
        spoilt = SpoiltPlace(case.folder, weights, fingerprint, {})
        listed = json.loads(spoilt.manifest.read_bytes())["files"]
        spoilt.files = {name: spoilt.run / "files" / facts["sha256"] for name, facts in listed.items()}
        return spoilt

    def spoil(self, case: Case) -> SpoiltPlace:
        spoilt = self.intact(case, "published")
        names = case.chance(0.25)
        for _ in range(int(case.rng.choice([1, 1, 1, 2])) if not names or case.chance(0.2) else 0):
            _spoil_file(case, spoilt)
        if case.checksums is not Checksums.KEPT:
            forge(spoilt, everything=case.checksums is Checksums.ALL)
        if names:
            case.tell("place", spoil_names(case.rng, spoilt.place, spoilt.root / "beside"))
            spoilt.changed.add("names")
        return spoilt

    def probes(self, case: Case, spoilt: SpoiltPlace) -> Iterator[Probe]:
        place, entry = str(spoilt.place), str(spoilt.entry)
        before = snapshot(spoilt.root)
        hashes = [spoilt.weights[:16], spoilt.fingerprint[:16]]
        yield Probe("list", lambda: dmbench("share", "list", place, "--json").json()["shared"])
        yield Probe("listed", lambda: _readable(dmbench("share", "list", place)))
        yield Probe("pull run", partial(_pulled, case.folder / "one", place, hashes[:1]))
        yield Probe("pull data", partial(_pulled, case.folder / "one", place, hashes[1:]))
        if case.chance(0.5):
            yield Probe("pull again", partial(_pulled, case.folder / "one", place, hashes))
        yield Probe("pull entry", partial(_pulled, case.folder / "two", place, [entry]))
        if case.chance(0.3):
            yield Probe("pull all", partial(_pull_listed, case.folder / "three", place))
        quick = ("--quick",) if case.chance(0.8) else ()
        yield Probe("check", partial(_checked, case.folder / "four", place, entry, quick))
        yield Probe("unchanged", partial(_unchanged, spoilt.root, before))
        if case.chance(0.4):
            things = pick(case.rng, ([RUN, DATA], [DATA], [RUN], [entry]))
            yield Probe("push", partial(_pushed, spoilt, things, self.originals / "published" / "place"))
            yield Probe("mend", partial(_mended, spoilt, self.originals / "published" / "place"))

    def judge(
        self, case: Case, spoilt: SpoiltPlace, answers: Answers, reference: dict[str, Any]
    ) -> Iterator[tuple[str, str]]:
        original, what = reference["published"], " and ".join(sorted(spoilt.changed))
        check = answers.get("check")
        if check is not None and check.value == repr("holds"):
            truth = next((self.originals / "published" / "workspace" / ENTRIES).glob(f"{RUN}*.json"))
            said, true = figures_of(spoilt.entry), figures_of(truth)
            forged = said is None or any(said[name] != true[name] for name in ("weights", "samples"))
            if not forged and not same_figures(said, true):
                yield "wrong content", "'leaderboard check --from' says that figures hold which are not the run's"
        if case.checksums is Checksums.ALL or spoilt.entry_spoilt:
            return
        for name in ("pull run", "pull data", "pull entry"):
            answer = answers.get(name)
            if answer is not None and answer.value not in (None, original[name].value):
                yield "wrong content", f"{name} gives another than the original, of {what}"


def _spoil_file(case: Case, spoilt: SpoiltPlace) -> None:
    rng = case.rng
    kinds = ("manifest",) * 6 + ("run",) * 4 + ("dataset.json",) * 4 + ("tables", "video", "labels") + ("entry",) * 2
    kind = pick(rng, kinds)
    name = kind
    if kind == "run":
        name = pick(rng, sorted(spoilt.files))
        file = spoilt.files[name]
    elif kind in ("video", "labels", "tables"):
        found = {"tables": "*.parquet"}.get(kind, f"{kind}/*.mcap")
        file = pick(rng, sorted(spoilt.dataset.glob(found)))
        name = file.name
    else:
        file = {"manifest": spoilt.manifest, "entry": spoilt.entry}.get(kind, spoilt.dataset / "dataset.json")
        name = f"{kind.removesuffix('.json')}.json"
    spoil = {
        ".json": spoil_json,
        ".jsonl": spoil_lines,
        ".safetensors": spoil_weights,
        ".parquet": spoil_parquet,
        ".mcap": partial(spoil_mcap, mend=case.checksums is not Checksums.KEPT),
    }[Path(name).suffix]
    before = file.read_bytes()
    after, told = spoil_bytes(rng, before) if case.chance(PLAIN) else spoil(rng, before)
    file.write_bytes(after)
    case.tell(name, f"{kind}: {told}")
    if after != before:
        spoilt.changed.add(name)
        spoilt.entry_spoilt |= kind == "entry"


def snapshot(root: Path) -> dict[str, str]:
    """What lies in a folder: of each file the hash of its bytes, of each link where it leads. No link is followed."""
    found = {}
    for folder, folders, files in os.walk(root):
        for name in (*folders, *files):
            path = Path(folder, name)
            mode = path.lstat().st_mode
            if stat.S_ISLNK(mode):
                what = f"link {path.readlink()}"
            elif stat.S_ISREG(mode):
                what = hashlib.sha256(path.read_bytes()).hexdigest()
            else:
                what = "folder" if stat.S_ISDIR(mode) else "special"
            found[os.path.relpath(path, root)] = what
    return found


def _unchanged(root: Path, before: dict[str, str]) -> None:
    """See that reading has changed nothing but the workspaces that were read into."""
    after = {
        name: what for name, what in snapshot(root).items() if name.split("/")[0] in ("place", "workspace", "beside")
    }
    _require_same(before, after, "reading")


def _require_same(before: dict[str, str], after: dict[str, str], who: str) -> None:
    changed = sorted(name for name in before.keys() | after.keys() if before.get(name) != after.get(name))
    if changed:
        raise Fault(
            "wrote outside", f"{who} has changed {changed[0]!r}: {before.get(changed[0])}, {after.get(changed[0])}"
        )


def _readable(said: Any) -> None:
    """See that what is listed for people to read has no control characters."""
    said.done()
    if found := re.search(r"[\x00-\x09\x0b-\x1f\x7f-\x9f]", said.out):
        raise Fault("control characters", f"{found[0]!r} in {said.out[:300]!r}")


def _pulled(workspace: Path, place: str, what: list[str]) -> Any:
    """What lies in a workspace once something was fetched into it, or the sentence; both ways all of it is sound."""
    os.environ["DMBENCH_WORKSPACE"] = str(workspace)
    left = any(workspace.rglob(".arriving"))
    said = dmbench("share", "pull", *what, "--from", place, "--json")
    found = _sound(workspace)
    pulled = said.json()["pulled"]
    for one in pulled:
        if found.get(os.path.relpath(one["path"], workspace), {}).get("hash") != one["fingerprint"]:
            raise Fault("wrong content", f"'share pull' says that it has fetched {one}, and there is {found}")
    if not left and any(workspace.rglob(".arriving")):
        raise Fault("unfinished", "'share pull' ends well and leaves the folder where files arrive")
    return [found[os.path.relpath(one["path"], workspace)] for one in pulled]


def _pull_listed(workspace: Path, place: str) -> None:
    """Fetch each thing that is listed as sound."""
    for one in dmbench("share", "list", place, "--json").json()["shared"]:
        if not one["damage"]:
            name = f"{one['fingerprint']}/{one['share']}" if one["share"] else one["fingerprint"]
            try:
                _pulled(workspace, place, [name])
            except DmbenchError:
                continue


def _checked(workspace: Path, place: str, entry: str, quick: tuple[str, ...]) -> str:
    """What the check of an entry says that fetches what it needs: ``holds``, or not."""
    os.environ["DMBENCH_WORKSPACE"] = str(workspace)
    said = dmbench("leaderboard", "check", entry, "--from", place, *quick, "--json")
    _sound(workspace)
    if not said.code and not json.loads(said.out)["verdicts"]:
        raise Fault("no sentence", "the check says nothing")
    return "holds" if not said.code else "not"


def _sound(workspace: Path) -> dict[str, dict[str, Any]]:
    """The runs and data sets of a workspace, by their paths: their hashes and what they hold.

    Raises:
        Fault: One is damaged, or something else lies there.
    """
    found = dict[str, dict[str, Any]]()
    folders = [path for kind in ("runs", "data") for path in sorted((workspace / kind).glob("*"))]
    for path in folders:
        if path.name == ".arriving":
            continue
        try:
            found[os.path.relpath(path, workspace)] = _contents(path)
        except DmbenchError as error:
            raise Fault("wrong content", f"what 'share pull' has left is not sound: {error}") from None
    others = {path.name for path in workspace.glob("*")} - {"runs", "data", "reports"}
    if others or any(workspace.rglob("*.part")):
        raise Fault("unfinished", f"beside runs and data there is {sorted(others)}, or a temporary file")
    return found


def _contents(path: Path) -> dict[str, Any]:
    if path.parent.name == "runs":
        run = Run.open(path)
        weights = checkpoint.weights_hash(run.weights())
        return {"hash": weights, "model": run.spec.model, "result": run.result}
    if damages := check_dataset(path).damages:
        raise DmbenchError(f"{damages[0]}")
    dataset = Dataset.open(path)
    files = {name: what for name, what in snapshot(path).items() if name.startswith("video/")}  # labels may be lacking
    return {"hash": dataset.fingerprint, "episodes": len(dataset), "files": files}


def _pushed(spoilt: SpoiltPlace, things: list[str], original: Path) -> None:
    """Publish once more: nothing but the place changes, and nothing in it becomes other than it is published."""
    before = snapshot(spoilt.root)
    try:
        _push(spoilt, *things)
    finally:
        _require_published(before, snapshot(spoilt.root), original)


def _mended(spoilt: SpoiltPlace, original: Path) -> None:
    """Mend the place: then an outsider can fetch all of it, and gets what is published."""
    before = snapshot(spoilt.root)
    try:
        _push(spoilt, RUN, DATA, "--mend")
    finally:
        _require_published(before, snapshot(spoilt.root), original)
    true = snapshot(original)
    hashes = [_only_folder(original / kind) for kind in ("runs", "datasets")]
    got = _pulled(spoilt.root / "five", str(spoilt.place), hashes)
    if [one["hash"] for one in got] != hashes:
        raise Fault("wrong content", "after 'share push --mend' something else is fetched")
    for name, what in snapshot(spoilt.root / "five" / "data").items():
        _, _, inside = name.partition("/")  # the data set may have another name there
        if name.endswith(".mcap") and true[f"datasets/{hashes[1]}/{DATA}/{inside}"] != what:
            raise Fault("wrong content", f"after 'share push --mend' another {inside} is fetched")


def _push(spoilt: SpoiltPlace, *words: str) -> None:
    os.environ["DMBENCH_WORKSPACE"] = str(spoilt.root / "workspace")
    dmbench("share", "push", *words, "--to", str(spoilt.place), "--json").json()


def _require_published(before: dict[str, str], after: dict[str, str], original: Path) -> None:
    """See that files which have changed lie in the place, and are now as they were published."""
    published = {(Path(name).name, what) for name, what in snapshot(original).items()}
    fine = {name for name, what in after.items() if name.startswith("place/") and (Path(name).name, what) in published}
    gone = {
        name for name in before if name.startswith("place/") and name.endswith("dataset.json") and name not in after
    }
    beside = {name: what for name, what in before.items() if name not in fine | gone}
    _require_same(beside, {name: what for name, what in after.items() if name not in fine}, "'share push'")


def _only_folder(folder: Path) -> str:
    return next(folder.iterdir()).name


def _emptied(folder: Path) -> None:
    for path in folder.glob("*"):
        path.unlink()
