"""``dmbench bench``: speeds on this machine beside their physical limits."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated

import typer

from dmotion_bench.cli.options import AsJson

if TYPE_CHECKING:
    from dmotion_bench.benchmarks.result import Result


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(bench)


def bench(
    only: Annotated[
        str, typer.Option(help="Measure only the speeds whose names contain this text, such as 'train'.")
    ] = "",
    seconds: Annotated[float, typer.Option(min=0.1, help="Duration of each measurement.")] = 5.0,
    as_json: AsJson = False,
) -> None:
    """Measure how fast this machine records, loads, trains and plans, beside its limits."""
    from dataclasses import asdict

    import torch

    from dmotion_bench.benchmarks.machine import processor
    from dmotion_bench.benchmarks.result import Failure
    from dmotion_bench.benchmarks.speeds import measure
    from dmotion_bench.cli.progress import progress_bar

    with progress_bar() as bar:
        task = bar.add_task("measuring", total=None, status="")
        measured = list(measure(only, seconds, lambda name: bar.update(task, status=name)))
    results = [one for one in measured if not isinstance(one, Failure)]
    failures = [one for one in measured if isinstance(one, Failure)]
    if as_json:
        found = {"processor": processor(), "threads": torch.get_num_threads()}
        typer.echo(json.dumps(found | {"results": list(map(asdict, results)), "failures": list(map(asdict, failures))}))
    elif results:
        from dmotion_bench.cli.tables import show_rows

        typer.echo(f"{processor()}, {torch.get_num_threads()} threads")
        head = ("what", "speed", "unit", "of limit", "limit, or the fastest setting")
        show_rows(head, map(_row, results), right=frozenset({"speed", "of limit"}))
    for failure in failures:
        typer.echo(f"{failure.name} could not be measured: {failure.said}", err=True)
    if failures:
        raise typer.Exit(1)


def _row(result: Result) -> tuple[str, ...]:
    share = f"{100 * result.value / result.limit:.0f}%" if result.limit else ""
    bound = f"{result.limit:,.0f} ({result.limit_name})" if result.limit else ""
    speed = f"{result.value:,.1f}" if result.value >= 10 else f"{result.value:.3g}"
    return result.name, speed, result.unit, share, "; ".join(part for part in (bound, result.setting) if part)
