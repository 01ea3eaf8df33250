"""``dmbench bench``: speeds on this machine beside their physical limits."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from dmotion_bench.cli.options import AsJson


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

    from dmotion_bench.benchmarks.speeds import measure
    from dmotion_bench.cli.progress import progress_bar

    with progress_bar() as bar:
        task = bar.add_task("measuring", total=None, status="")
        results = list(measure(only, seconds, lambda name: bar.update(task, status=name)))
    if as_json:
        typer.echo(json.dumps({"results": [asdict(result) for result in results]}))
        return
    from dmotion_bench.cli.tables import show_rows

    rows = []
    for result in results:
        share = f"{100 * result.value / result.limit:.0f}%" if result.limit else ""
        bound = f"{result.limit:,.0f} ({result.limit_name})" if result.limit else ""
        speed = f"{result.value:,.1f}" if result.value >= 10 else f"{result.value:.3g}"
        rows.append((result.name, speed, result.unit, share, bound))
    show_rows(("what", "speed", "unit", "of limit", "limit"), rows, right=frozenset({"speed", "of limit"}))
