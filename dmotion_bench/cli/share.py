"""``dmbench share``: publish runs and data sets by their hashes, fetch them, and list what a place holds."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dmotion_bench.cli.options import AsJson
from dmotion_bench.cli.stdout import print_json, say
from dmotion_bench.wording import command

if TYPE_CHECKING:
    from dmotion_bench.sharing.contents import Shared
    from dmotion_bench.sharing.pull import Pulled
    from dmotion_bench.sharing.push import Pushed

group = typer.Typer(
    help="Publish runs and data sets by their hashes, and fetch them to check results.", no_args_is_help=True
)
_PLACE = "a folder, or an address that begins with s3://, gs:// or hf://"


def register(app: typer.Typer) -> None:
    """Add the group of commands."""
    app.add_typer(group, name="share")


@group.command()
def push(
    what: Annotated[
        list[str],
        typer.Argument(
            metavar="RUN|DATASET|ENTRY...",
            help="Runs and data sets, by path or name; or entries of the leaderboard and folders of them, for all "
            "that checking them takes.",
        ),
    ],
    place: Annotated[str, typer.Option("--to", metavar="PLACE", help=f"Where: {_PLACE}.")],
    labels: Annotated[
        bool,
        typer.Option(
            "--labels/--no-labels", help="Publish the labels of data sets, too. Checking an entry takes them."
        ),
    ] = True,
    mend: Annotated[
        bool, typer.Option("--mend", help="Read what is there already, and replace what is damaged.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Publish runs and data sets under their hashes; only what is not there yet is sent."""
    from dmotion_bench.api.sharing import share_push
    from dmotion_bench.cli.progress import BarOnDemand

    with BarOnDemand() as bar:
        pushed = share_push(what, place, labels=labels, mend=mend, progress=bar)
    if as_json:
        print_json({"pushed": [asdict(one) for one in pushed]})
        return
    for one in pushed:
        _show_pushed(one, labels)
    hashes = dict.fromkeys(one.fingerprint[:16] for one in pushed)
    pull = command("dmbench share pull", *hashes, "--from", place)
    say(f"Others fetch {'them' if len(pushed) > 1 else 'it'} with {pull}, or by the entry in place of hashes.")


@group.command()
def pull(
    what: Annotated[
        list[str],
        typer.Argument(
            metavar="ENTRY|HASH...",
            help="Entries of the leaderboard and folders of them, for all that checking them takes; or hashes of "
            "weights or data sets, at least their first eight digits.",
        ),
    ],
    place: Annotated[str, typer.Option("--from", metavar="PLACE", help=f"Where: {_PLACE}.")],
    labels: Annotated[
        bool,
        typer.Option("--labels/--no-labels", help="Fetch the labels of data sets, too. Checking an entry takes them."),
    ] = True,
    as_json: AsJson = False,
) -> None:
    """Fetch runs and data sets into the workspace; each is held against its hashes before it appears."""
    from dmotion_bench.api.sharing import share_pull
    from dmotion_bench.cli.progress import BarOnDemand

    with BarOnDemand() as bar:
        pulled = share_pull(what, place, labels=labels, progress=bar)
    if as_json:
        print_json({"pulled": [asdict(one) | {"path": str(one.path)} for one in pulled]})
        return
    for one in pulled:
        _show_pulled(one, labels)
    say(_next(what, pulled, place))


@group.command("list")
def list_(
    place: Annotated[str, typer.Argument(metavar="PLACE", help=f"Where: {_PLACE}.")], as_json: AsJson = False
) -> None:
    """List what is published in a place."""
    from dmotion_bench.api.sharing import share_list

    found = share_list(place)
    if as_json:
        print_json({"shared": [asdict(one) for one in found]})
        return
    if not found:
        push_there = command("dmbench share push RUN --to", place)
        say(f"Nothing is published in {place}; publish with {push_there}.")
        return
    for one in found:
        say(f"{one.kind:8}  {one.fingerprint[:16]}  {one.name or '?'}  ({_facts(one)})")


def _facts(one: Shared) -> str:
    if one.damage:
        return f"damaged: {one.damage}"
    if one.kind == "data set":
        return f"{_size(one.bytes)}, {'with' if one.labels else 'without'} labels"
    reports = f"{one.reports} report{'' if one.reports == 1 else 's'}" if one.reports else "not scored"
    return f"{_size(one.bytes)}, {one.model}, {reports}, trained on {one.dataset[:16]}"


def _show_pushed(one: Pushed, labels: bool) -> None:
    sent = f"{one.sent} of {one.files} files sent, {_size(one.bytes)}" if one.sent else "was there already"
    say(f"{one.kind} {one.name}: {sent}\n  {one.address}")
    if one.kind == "data set" and labels and not one.labels:
        say("  without labels, which are not here: entries cannot be checked with it")
    if one.kind == "run" and not one.scored:
        say("  without a report: score it with 'dmbench score' and publish it again to have it checked")


def _show_pulled(one: Pulled, labels: bool) -> None:
    fetched = f"{one.fetched} of {one.files} files fetched, {_size(one.bytes)}" if one.fetched else "was here already"
    say(f"{one.kind} {one.name}: {fetched}, every hash is right\n  {one.path}")
    if one.kind == "data set" and labels and not one.labels:
        say("  without labels, which are not there: entries cannot be checked with it")


def _next(what: list[str], pulled: list[Pulled], place: str) -> str:
    """What to type next."""
    entries = [one for one in what if Path(one).exists()]
    if entries:
        return f"Check with {command('dmbench leaderboard check', *entries)}."
    here: dict[str, Any] = {one.fingerprint: one for one in pulled}
    run = next((one for one in pulled if one.kind == "run"), None)
    if run is None:
        return f"Look at it with {command('dmbench data info', pulled[0].path)}."
    if run.dataset not in here:
        fetch = command("dmbench share pull", run.dataset[:16], "--from", place)
        return f"Its data set comes with {fetch}, if it is published there."
    return f"Check the run's own figures with {command('dmbench leaderboard check', run.path)}."


def _size(count: int) -> str:
    return f"{count / 2**20:.1f} MiB" if count >= 2**20 else f"{count / 2**10:.1f} KiB"
