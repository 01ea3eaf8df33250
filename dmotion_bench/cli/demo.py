"""``dmbench demo``: everything once, small: record, train, score, look."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from dmotion_bench.cli.options import AsJson
from dmotion_bench.cli.stdout import print_json, say
from dmotion_bench.wording import command


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(demo)


def demo(
    out: Annotated[Path, typer.Option(help="Folder to write everything to; it becomes a workspace.")] = Path("demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the recording and the training.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Try everything on a small example: record, train on video alone, score, and write a Rerun file."""
    from dmotion_bench.api.demonstration import demo as demonstrate
    from dmotion_bench.cli.progress import BarOnDemand, duration, note
    from dmotion_bench.cli.report_table import show_report

    with BarOnDemand() as bar:

        def tell(line: str) -> None:
            bar.end()
            if not as_json:
                say(line)

        done = demonstrate(out, seed=seed, workers=None, say=tell, note=note, progress=bar)
    if as_json:
        print_json(done.to_json())
        return
    show_report(done.report, done.run)
    say(f"Done in {duration(done.seconds)}. See the model's imagination with {command('rerun', done.recording)},")
    say(f"or in a browser with {command('dmbench view', done.run, '--web')}.")
