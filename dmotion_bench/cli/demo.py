"""``dmbench demo``: everything once, small: record, train, score, look."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from dmotion_bench.cli.options import AsJson
from dmotion_bench.wording import command

ENVIRONMENT = "grid_world"
MODEL = "dmotion"
EPISODES = 200
EPOCHS = 8


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(demo)


def demo(
    out: Annotated[Path, typer.Option(help="Folder to write everything to; it becomes a workspace.")] = Path("demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the recording and the training.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Try everything on a small example: record, train on video alone, score, and write a Rerun file."""
    from dmotion_bench.cli.progress import duration
    from dmotion_bench.cli.record import record_with_progress
    from dmotion_bench.cli.report_table import show_report
    from dmotion_bench.cli.score import score_runs
    from dmotion_bench.cli.train import train_run
    from dmotion_bench.cli.view import scene_of
    from dmotion_bench.execution.executors import make_executor
    from dmotion_bench.execution.local_executor import available_workers
    from dmotion_bench.learning.start import TrainingRequest, open_run
    from dmotion_bench.recording.preset import recipe_for
    from dmotion_bench.scoring.score import ScoreSettings
    from dmotion_bench.specs import Preset
    from dmotion_bench.storage.dataset import Dataset
    from dmotion_bench.viewing.scene import write_scene
    from dmotion_bench.viewing.target import find_target
    from dmotion_bench.workspace import Workspace

    began = time.monotonic()
    workspace = Workspace(out)

    def say(line: str) -> None:
        if not as_json:
            typer.echo(line)

    say(f"1/4 recording {EPISODES} episodes of {ENVIRONMENT}")
    recipe = recipe_for(ENVIRONMENT, Preset.SMALL, episodes=EPISODES, tasks=0, seed=seed)
    folder = workspace.data / f"{ENVIRONMENT}-demo"
    recorded = record_with_progress(folder, recipe, make_executor("local", available_workers()))
    say(f"    {recorded.frames} frames in {folder}")

    dataset = Dataset.open(folder)
    request = TrainingRequest(model=MODEL, seed=seed, settings=(f"epochs={EPOCHS}",))
    run = open_run(request, dataset, workspace.runs / f"{MODEL}-demo", workspace)
    say(f"2/4 training {MODEL} on the video, without a single action label")
    result = train_run(run, dataset)
    say(f"    {result['triplets']} triplets in {result['seconds']:.0f} s, {result['triplets_per_s']:.0f} triplets/s")
    say(f"    then {result['labels_total']} labels: one demonstration of each action")

    say("3/4 scoring it on episodes that it has not seen")
    reports, failures = score_runs([run.path], ("prediction", "rollout"), ScoreSettings())
    assert not failures, failures  # a single run's failure is raised

    say("4/4 writing what it imagines for Rerun")
    recording = workspace.root / "demo.rrd"
    write_scene(scene_of(find_target(run.path, workspace), [], None), recording)
    seconds = time.monotonic() - began
    if as_json:
        summary: dict[str, Any] = {
            "dataset": str(folder),
            "run": str(run.path),
            "recording": str(recording),
            "seconds": round(seconds, 1),
            "reports": [report.summary() | {"run": str(path)} for path, report in reports.items()],
        }
        typer.echo(json.dumps(summary))
        return
    for path, report in reports.items():
        show_report(report, path)
    say(f"Done in {duration(seconds)}. See the model's imagination with {command('rerun', recording)},")
    say(f"or in a browser with {command('dmbench view', run.path, '--web')}.")
