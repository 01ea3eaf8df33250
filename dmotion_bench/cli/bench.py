"""``dmbench bench``: speeds on this machine beside their physical limits, and beside those of an earlier run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dmotion_bench.api.settings import DEVICES
from dmotion_bench.cli.options import AsJson, listed
from dmotion_bench.cli.stdout import print_json, say
from dmotion_bench.errors import Interrupted

if TYPE_CHECKING:
    from dmotion_bench.benchmarks.comparison import Change, Stored
    from dmotion_bench.benchmarks.result import Result


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(bench)


def bench(
    only: Annotated[
        str, typer.Option(help="Measure only the speeds whose names contain this text, such as 'train'.")
    ] = "",
    seconds: Annotated[float, typer.Option(min=0.1, max=3600, help="Duration of each measurement.")] = 5.0,
    compare: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Say what became slower since this output of 'dmbench bench --json'; exit with 1 if anything did.",
        ),
    ] = None,
    device: Annotated[
        str,
        typer.Option(
            metavar=listed(DEVICES),
            help="Measure training, loading and planning on a GPU as well. auto does where there is one.",
        ),
    ] = "auto",
    as_json: AsJson = False,
) -> None:
    """Measure how fast this machine records, loads, trains and plans, beside its limits."""
    import torch

    from dmotion_bench.api.scoring import compute_device
    from dmotion_bench.benchmarks.comparison import changes, read_stored
    from dmotion_bench.benchmarks.machine import graphics, processor
    from dmotion_bench.benchmarks.result import Failure
    from dmotion_bench.benchmarks.speeds import measure
    from dmotion_bench.cli.progress import progress_bar

    where = compute_device(device)
    gpu = where if where.type == "cuda" else None
    stored = None if compare is None else read_stored(compare)
    measured: list[Result | Failure] = []
    interrupted = False
    with progress_bar() as bar:
        task = bar.add_task("measuring", total=None, status="")

        def show(name: str, done: int, total: int) -> None:
            bar.update(task, completed=done, total=total, status=name)

        try:
            measured.extend(measure(only, seconds, show, gpu))
        except KeyboardInterrupt:
            interrupted = True
    results = [one for one in measured if not isinstance(one, Failure)]
    failures = [one for one in measured if isinstance(one, Failure)]
    changed = [] if stored is None else list(changes(stored, results))
    threads = torch.get_num_threads()
    if as_json:
        found = {
            "processor": processor(),
            "threads": threads,
            "gpu": graphics(gpu),
            "results": [one.to_json() for one in results],
        }
        compared = {} if stored is None else {"changes": list(map(asdict, changed))}
        print_json(found | {"failures": list(map(asdict, failures))} | compared)
    elif results:
        from dmotion_bench.cli.tables import show_rows

        say(", ".join(part for part in (processor(), f"{threads} threads", graphics(gpu)) if part))
        head = ("what", "speed", "unit", "of limit", "limit, or the fastest setting")
        show_rows(head, map(_row, results), right=frozenset({"speed", "of limit"}))
    for failure in failures:
        say(f"{failure.name} could not be measured: {failure.said}", err=True)
    if stored is not None and not as_json:
        _show_changes(stored, changed, processor(), threads)
    if interrupted:
        raise Interrupted(
            "interrupted; the speeds measured so far are above. The same command measures all of them again, "
            "with '--only train' a part of them."
        )
    if failures or any(one.verdict == "slower" for one in changed):
        raise typer.Exit(1)


def _show_changes(stored: Stored, changed: Sequence[Change], processor: str, threads: int) -> None:
    """Print what was compared, and what became slower."""
    from dmotion_bench.cli.tables import show_rows

    if (stored.processor, stored.threads) != (processor, threads):
        say(f"The stored run is of another machine: {stored.processor}, {stored.threads} threads.")
    if not changed:
        say("The stored run has none of these speeds.")
        return
    head = ("what", "before", "now", "unit", "change", "verdict")
    show_rows(head, map(_change_row, changed), right=frozenset({"before", "now", "change"}))
    slower = [one.name for one in changed if one.verdict == "slower"]
    say(f"Slower: {', '.join(slower)}." if slower else "Nothing became slower.")


def _change_row(change: Change) -> tuple[str, ...]:
    beside = " of the limit" if change.relative else ""
    ratio = f"{100 * (change.ratio - 1):+.1f}%{beside}"
    return change.name, _number(change.before), _number(change.now), change.unit, ratio, change.verdict


def _row(result: Result) -> tuple[str, ...]:
    share = f"{100 * result.value / result.limit:.0f}%" if result.limit else ""
    bound = f"{result.limit:,.0f} ({result.limit_name})" if result.limit else ""
    said = "; ".join(part for part in (bound, result.setting) if part)
    return result.name, _number(result.value), result.unit, share, said


def _number(value: float) -> str:
    return f"{value:,.1f}" if value >= 10 else f"{value:.3g}"
