"""``dmbench data``: inspect, check, repair, import and export data sets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final

import typer

from dmotion_bench.addresses import remote_address
from dmotion_bench.cli import data_export, data_import
from dmotion_bench.cli.options import AsJson
from dmotion_bench.cli.stdout import print_json, say
from dmotion_bench.specs import IMPORTED
from dmotion_bench.wording import command, counted

_SIMULATORS: Final = ("gymnasium", "pymunk", "pybullet")
"""Packages that have no part in an import, although ``dataset.json`` states their versions."""
_NAMED: Final = 2  # recordings of an import; of more, the first and the last are named
_UNSAID: Final = {"clock": "log", "min_frames": 3}
"""Usual values of an import that are not said; neither is what is empty, zero or false."""

group = typer.Typer(help="Inspect, check, repair, import and export data sets.", no_args_is_help=True)


def _argument(named_by: str) -> Any:
    told = f"The data set, by {named_by}. Default: the only one of the workspace."
    return typer.Argument(metavar="[DIR]", help=told, show_default=False)


DatasetFolder = Annotated[Path | None, _argument("path, name or address (s3://bucket/path)")]
LocalFolder = Annotated[Path | None, _argument("path or name")]


def register(app: typer.Typer) -> None:
    """Add the group of commands."""
    data_import.register(group)
    data_export.register(group)
    app.add_typer(group, name="data")


@group.command()
def info(dataset: DatasetFolder = None, as_json: AsJson = False) -> None:
    """Show how a data set was made, how large it is, and how it is split."""
    from dmotion_bench.storage.summary import summarize
    from dmotion_bench.workspace import Workspace

    summary = summarize(Workspace.current().dataset(dataset))
    if as_json:
        print_json(summary)
        return
    for name, text in _lines(summary):
        say(f"{name:12s} {_printable(text)}")


def _lines(summary: dict[str, Any]) -> list[tuple[str, str]]:
    recipe, frame = summary["recipe"], summary["frame"]
    lines = [
        ("data set", f"{summary['dataset']} ({summary['format']})"),
        ("made by", _imported(recipe) if recipe["environment"] == IMPORTED else _recorded(recipe)),
        ("frames", f"{frame['width']}x{frame['height']} pixels, {1e9 / frame['step_ns']:g} a second"),
        ("actions", _actions(summary["actions"])),
        ("objects", ", ".join(summary["objects"]) or "unknown"),
    ]
    if not summary["complete"]:
        shards = -(-recipe["episodes"] // recipe["shard_episodes"])
        lines.append(("state", f"not finished: {summary['shards_done']} of {shards} shards are there"))
        return [*lines, ("go on with", summary["go_on_with"])]
    per_frame = (summary["video_bytes"] + summary["labels_bytes"]) / summary["frames"]
    split = ", ".join(f"{count} {name}" for name, count in summary["split"].items())
    sizes = (("video", "video_bytes"), ("labels", "labels_bytes"), ("cache", "cache_bytes"))
    return [
        *lines,
        (
            "episodes",
            f"{summary['episodes']}: {split}; {counted(summary['frames'], 'frame')} "
            f"in {counted(summary['shards'], 'shard')}",
        ),
        ("labels", summary["labels"]),
        (
            "size",
            ", ".join(f"{name} {_size(summary[key])}" for name, key in sizes) + f"; {per_frame:.0f} bytes a frame",
        ),
        ("state", "repaired; episodes were lost" if summary["salvaged"] else "complete"),
        ("fingerprint", summary["fingerprint"]),
        (
            "made with",
            ", ".join(
                f"{name} {version}"
                for name, version in summary["versions"].items()
                if recipe["environment"] != IMPORTED or name not in _SIMULATORS
            ),
        ),
    ]


def _recorded(recipe: dict[str, Any]) -> str:
    """What a recording was made by."""
    drawn = "".join(f", {name}={value}" for name, value in recipe["parameters"].items())
    drawn += f", varying {', '.join(recipe['vary'])}" if recipe["vary"] else ""
    return f"{recipe['environment']}, policy {recipe['policy']}, seed {recipe['seed']}{drawn}"


def _imported(recipe: dict[str, Any]) -> str:
    """What an import was made of: its recordings, without their hashes, and the options that are not the usual ones."""
    from dmotion_bench.storage.imports.import_plan import FILE, HASH

    given = recipe["parameters"]
    files = [str(value) for name, value in given.items() if name.startswith(FILE)]
    listed = ", ".join(files) if len(files) <= _NAMED else f"{files[0]} ... {files[-1]}"
    facts = "".join(
        f", {name}={value}"
        for name, value in given.items()
        if not name.startswith((FILE, HASH)) and value not in ("", 0, _UNSAID.get(name))
    )
    return f"import of {len(files)} recording{'s' * (len(files) != 1)}: {listed}; seed {recipe['seed']}{facts}"


def _printable(text: str) -> str:
    """A line without what would move the terminal's cursor: the names in a data set may come from anybody."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


def _actions(actions: list[str] | dict[str, Any]) -> str:
    from dmotion_bench.actions import actions_from_json

    return str(actions_from_json(actions) or "unknown")


def _size(count: int) -> str:
    return f"{count / 2**20:.1f} MiB" if count >= 2**20 else f"{count / 2**10:.1f} KiB"


@group.command()
def check(dataset: DatasetFolder = None, as_json: AsJson = False) -> None:
    """Read every byte of a data set and compare it with what was recorded."""
    from dmotion_bench.errors import DatasetCorrupt
    from dmotion_bench.storage.check import check_dataset
    from dmotion_bench.workspace import Workspace

    folder = Workspace.current().dataset(dataset)
    address = remote_address(folder)
    where = address or str(folder)
    with _progress("checking") as show:
        report = check_dataset(folder, show)
    recipe = report.manifest.recipe
    frames = sum(shard.frames for shard in report.manifest.shards)
    if as_json:
        damages = [{"file": damage.file, "what": damage.what} for damage in report.damages]
        whole = {"dataset": where, "sound": not damages, "damages": damages, "labels": report.labels}
        print_json(whole | {"episodes": recipe.episodes, "frames": frames})
    else:
        for damage in report.damages:
            say(f"{damage.file} {damage.what}")
    if report.damages:
        way_out = f"mend it with {command('dmbench data repair', folder)}" if address is None else "put it there again"
        raise DatasetCorrupt(f"{where!r} is damaged in {len(report.damages)} places; {way_out}.")
    if not as_json:
        say(f"{where} is sound: {recipe.episodes} episodes, {frames} frames, labels {report.labels}.")


@group.command()
def repair(
    dataset: LocalFolder = None,
    workers: Annotated[int, typer.Option(min=1, help="Number of processes that record damaged files again.")] = 1,
    as_json: AsJson = False,
) -> None:
    """Repair a data set: record damaged files again, or keep what can be read where that is not possible."""
    from dmotion_bench.cli.progress import note
    from dmotion_bench.execution.local_executor import local_executor
    from dmotion_bench.recording.restore import repair_dataset
    from dmotion_bench.storage.repair import finish_interrupted
    from dmotion_bench.workspace import Workspace

    workspace = Workspace.current()
    named = [] if dataset is None else [dataset, workspace.data / dataset]  # either may be a link to another disk
    for place in dict.fromkeys([workspace.data.resolve(), *(one.resolve().parent for one in named)]):
        for path in finish_interrupted(place):
            note(f"{path} is there again: its repair was killed at its end. The damaged original is beside it.")
    folder = workspace.dataset(dataset)
    with _progress("checking") as show:
        done = repair_dataset(folder, local_executor(workers), show)
    lost = list(done.salvaged.lost) if done.salvaged else []
    if as_json:
        result = {"dataset": str(folder), "how": done.how, "shards": list(done.shards), "episodes_lost": lost}
        print_json(result | {"original": str(done.salvaged.original) if done.salvaged else None})
    elif done.salvaged:
        say(
            f"{folder} could not be recorded anew; {len(done.salvaged.kept)} episodes were kept and {len(lost)} are "
            f"lost. The damaged original is {done.salvaged.original}: delete it when you do not need it."
        )
    elif done.how == "restored":
        anew = f"recorded anew: {counted(len(done.shards), 'shard')}" if done.shards else "made anew: its tables"
        say(f"{folder} is restored, byte for byte; {anew}.")
    elif done.how == "cache":
        say(f"{folder} is sound; its damaged cache was deleted and is made anew when it is needed.")
    else:
        say(f"{folder} is sound; nothing was changed.")


def _progress(what: str) -> Any:
    """A context manager that shows a progress bar on stderr and yields a function of (done, total)."""
    import contextlib
    from collections.abc import Callable, Iterator

    from dmotion_bench.cli.progress import progress_bar

    @contextlib.contextmanager
    def shown() -> Iterator[Callable[[int, int], None]]:
        with progress_bar() as bar:
            task = bar.add_task(what, total=None, status="shards")
            yield lambda done, total: bar.update(task, completed=done, total=total)

    return shown()
