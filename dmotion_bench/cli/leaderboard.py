"""``dmbench leaderboard``: compare runs, build the page, check entries, serve it.

The core knows no leaderboard: what the commands call comes through entry points of the group
``dmbench.leaderboard``.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dmotion_bench.api.settings import require_one_of
from dmotion_bench.cli.cache import CacheFolder, use_cache
from dmotion_bench.cli.jobs import executor_option, workers_option
from dmotion_bench.cli.options import AsJson, listed
from dmotion_bench.cli.stdout import print_json, say

if TYPE_CHECKING:
    from dmotion_bench.execution.job_progress import JobProgress
    from dmotion_bench.specs import SplitName

group = typer.Typer(help="Compare runs, build the leaderboard's page, and check entries.", no_args_is_help=True)


def register(app: typer.Typer) -> None:
    """Add the group of commands."""
    app.add_typer(group, name="leaderboard")


@group.command()
def build(
    runs: Annotated[
        list[Path] | None,
        typer.Argument(metavar="RUN", help="Scored runs, by path or name. Default: every run of the workspace."),
    ] = None,
    entries: Annotated[
        list[Path] | None,
        typer.Option(metavar="PATH", help="Entries of other people: a file or a folder. Can be repeated."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder to write. Default: reports/leaderboard of the workspace.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a web page that compares scored runs with each other and with published results."""
    from dmotion_bench.api.leaderboard import leaderboard_build
    from dmotion_bench.cli.progress import progress_bar

    with progress_bar() as bar:
        built = leaderboard_build(runs or None, entries=entries or (), out=out, progress=bar.tell)
    if as_json:
        print_json(built.to_json())
        return
    for name, why in built.left_out.items():
        say(f"left out {name}: {why}", err=True)
    for name in built.doubtful:
        say(
            f"left in place: {name} has the name of one of these runs and other weights. Delete it if it is of an "
            "earlier training of yours.",
            err=True,
        )
    say(f"{built.page}: {built.measured} measured and {built.published} published results")


@group.command()
def check(
    paths: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="PATH", help="Entries, folders of entries, or runs. Default: the entries that 'build' wrote."
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Compare the figures with the stored samples only, without scoring again.")
    ] = False,
    differing: Annotated[
        float,
        typer.Option(min=0.0, max=1.0, help="Share of samples that may differ, because processors round differently."),
    ] = 0.0,
    draw: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Draws the control tasks that are planned anew, as an earlier check did. Default: drawn now, so that "
            "nobody knew them.",
            show_default=False,
        ),
    ] = None,
    workers: Annotated[
        int | None,
        workers_option(
            "How many entries are checked at a time. Default: one; with --executor, as there are processors "
            "and memory for."
        ),
    ] = None,
    executor: Annotated[
        str | None,
        executor_option("Where entries are checked"),
    ] = None,
    place: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="PLACE",
            help="Fetch the runs and data sets that the entries need from there first: a folder or an address to which "
            "somebody published them with 'dmbench share push'.",
        ),
    ] = None,
    cache: CacheFolder = None,
    as_json: AsJson = False,
) -> None:
    """Check that the figures of entries are right: score them again from their weights and data."""
    from dmotion_bench.api.leaderboard import leaderboard_check
    from dmotion_bench.cli.progress import progress_bar
    from dmotion_bench.errors import Interrupted, RunError

    use_cache(cache)
    many = workers if workers or executor else 1
    finished: tuple[float, float | None] = 0, None
    with progress_bar() as bar:

        def show(told: JobProgress) -> None:
            nonlocal finished
            finished = told.done, told.total
            bar.tell(told)

        try:
            verdicts = leaderboard_check(
                paths or None,
                quick=quick,
                differing=differing,
                draw=draw,
                workers=many,
                executor=executor or "local",
                place=place,
                progress=show,
                watch=bar.watch,
                warn=lambda told: say(told, err=True),
            )
        except KeyboardInterrupt:
            if finished[1] is None or (many == 1 and executor in (None, "local")):
                raise
            raise Interrupted(
                f"interrupted after {finished[0]} of {finished[1]} entries; the same command checks all of them again, "
                "'dmbench leaderboard check PATH' some of them."
            ) from None
    if as_json:
        print_json({"verdicts": [verdict.to_json() for verdict in verdicts]})
    else:
        for verdict in verdicts:
            _show_verdict(verdict)
    failed = sum(bool(verdict.findings) for verdict in verdicts)
    unknown = sum(not verdict.holds for verdict in verdicts) - failed
    told = [f"{failed} of {len(verdicts)} entries {'does' if failed == 1 else 'do'} not hold"] if failed else []
    told += [f"{unknown} of {len(verdicts)} could not be checked here"] if unknown else []
    if told:
        raise RunError("; ".join(told) + ".")


@group.command()
def compare(
    first: Annotated[
        Path,
        typer.Argument(
            metavar="RUN",
            help="A scored run, by path or name, or the mean of several trainings: their name without the seed, such "
            "as dmotion-grid_world-small for dmotion-grid_world-small-s0, -s1 and -s2.",
        ),
    ],
    second: Annotated[Path, typer.Argument(metavar="RUN", help="The same of another model on the same data set.")],
    data: Annotated[
        Path | None, typer.Option(help="Data set that both were scored on. Default: the one that they were trained on.")
    ] = None,
    split: Annotated[
        str,
        typer.Option(metavar=listed(("test", "validation")), help="Which held-out episodes both were scored on."),
    ] = "test",
    everything: Annotated[bool, typer.Option("--all", help="Compare every figure, not only the main ones.")] = False,
    as_json: AsJson = False,
) -> None:
    """Tell which of two models is better, by their difference on the same frames and its interval."""
    from dmotion_bench.api.leaderboard import leaderboard_compare
    from dmotion_bench.workspace import Workspace

    require_one_of("split", split, ("test", "validation"))
    one, other = (Workspace.current().trainings(run) for run in (first, second))
    chosen: SplitName = "validation" if split == "validation" else "test"
    differences = leaderboard_compare(
        one, other, data=data, split=chosen, warn=lambda told: say(f"left out: {told}", err=True)
    )
    if as_json:
        named = {"first": _plain_runs(one), "second": _plain_runs(other)}
        print_json(named | {"differences": list(map(_plain, differences))})
        return
    from dmotion_bench.cli.report_table import show_differences

    over = "episodes" if len(one) == len(other) == 1 else "episodes and trainings"
    show_differences(differences, _name_of(one), _name_of(other), over, everything=everything)


@group.command()
def results(
    pages: Annotated[list[Path], typer.Argument(metavar="PAGE...", help="Markdown files with places for results.")],
    folder: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="DIR",
            help="Folder that 'build' wrote. Default: reports/leaderboard of the workspace.",
        ),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Only compare: fail if a page differs from the entries.")
    ] = False,
) -> None:
    """Write the leaderboard's tables into pages, between '<!-- results:NAME -->' and '<!-- /results -->'."""
    from dmotion_bench.api.leaderboard import built_page
    from dmotion_bench.errors import DmbenchError

    changed = _part("results")(folder or built_page(), pages, check=check)
    if check and changed:
        differing = ", ".join(map(str, changed))
        raise DmbenchError(f"results differ from the entries in {differing}; run the same command without --check.")
    for page in pages:
        say(f"{page}: {'written' if page in changed else 'as it was'}")


@group.command()
def serve(
    folder: Annotated[
        Path | None,
        typer.Argument(
            metavar="[DIR]",
            help="Folder that 'build' wrote. Default: reports/leaderboard of the workspace.",
            show_default=False,
        ),
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the server; 0 takes a free one.")] = 8000,
) -> None:
    """Show the page in browsers of this machine."""
    from dmotion_bench.api.leaderboard import built_page
    from dmotion_bench.cli.progress import note

    with _part("serve")(folder or built_page(), port) as server:
        say(server.url)
        note(
            "Open it in a browser on this machine, or on another one after running there "
            f"'ssh -L {server.port}:127.0.0.1:{server.port} HOST'."
        )
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            return


def _part(name: str) -> Any:
    """The function with this name in the leaderboard's package."""
    from dmotion_bench.registry import leaderboard_part

    return leaderboard_part(name)


def _show_verdict(verdict: Any) -> None:
    held = f"{verdict.figures} figures, {verdict.samples} samples" if verdict.samples else f"{verdict.figures} figures"
    word = "DOES NOT HOLD" if verdict.findings else "not checked" if verdict.missing else "holds"
    say(f"{word:13}  {verdict.entry} ({held})")
    for finding in (*verdict.findings, *verdict.missing):
        say(f"    {finding}")
    for remark in verdict.remarks:
        say(f"    ({remark})")


def _name_of(runs: Sequence[Path]) -> str:
    """A run's name or, of several trainings, what their names have in common and their number."""
    if len(runs) == 1:
        return runs[0].name
    stem, _, seeds = runs[0].name.rpartition("-s")
    return f"{stem} ({len(runs)} trainings, s{seeds} to {runs[-1].name.rpartition('-')[2]})"


def _plain_runs(runs: Sequence[Path]) -> str | list[str]:
    """A run's folder or, of several trainings, those of all."""
    return str(runs[0]) if len(runs) == 1 else list(map(str, runs))


def _plain(difference: Any) -> dict[str, Any]:
    return {
        "figure": difference.figure,
        "first": difference.first,
        "second": difference.second,
        "difference": difference.difference.to_json(),
        "better": difference.better,
        "verdict": difference.verdict,
    }
