"""dmbench from Python: record, train, score, plan and look, by the functions that the command line calls.

::

    import dmotion_bench as dm

    recorded = dm.record("grid_world", "tiny")
    run = dm.train("dmotion", recorded)
    report = dm.score(run)

Importing this loads no torch, no simulator and no model: each name loads what it needs when it is first used. It does
make the installed environments known to Gymnasium, ``gymnasium.make("dmbench/GridWorld-v0")``.

The core knows no environment and no model by name. They reach it through entry points (``dmbench.environments``,
``dmbench.models``), the same door that a third party's package uses.
"""

from __future__ import annotations

import importlib
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any, Final

from dmotion_bench.gymnasium_ids import register_ids

if TYPE_CHECKING:
    from dmotion_bench.api.datasets import Dataset, TripletDataset, open_dataset
    from dmotion_bench.api.demonstration import Demonstrated, demo
    from dmotion_bench.api.importing import export_dataset, import_recordings
    from dmotion_bench.api.leaderboard import Built, Verdict, leaderboard_build, leaderboard_check, leaderboard_compare
    from dmotion_bench.api.planning import Planned, plan
    from dmotion_bench.api.recording import record
    from dmotion_bench.api.reproducing import Reproduced, reproduce
    from dmotion_bench.api.runs import Run, load_run
    from dmotion_bench.api.scoring import score
    from dmotion_bench.api.sharing import share_list, share_pull, share_push
    from dmotion_bench.api.training import train
    from dmotion_bench.api.viewing import Served, view
    from dmotion_bench.errors import DmbenchError
    from dmotion_bench.execution.job_progress import JobProgress
    from dmotion_bench.recording.session import Recorded
    from dmotion_bench.registry import (
        environment_names,
        model_names,
        objective_names,
        register_environment,
        register_model,
        register_objective,
        register_solver,
        solver_names,
    )
    from dmotion_bench.scoring.differences import Difference
    from dmotion_bench.scoring.report import Report
    from dmotion_bench.sharing.contents import Shared
    from dmotion_bench.sharing.pull import Pulled
    from dmotion_bench.sharing.push import Pushed
    from dmotion_bench.specs import Episode, EpisodeLabels
    from dmotion_bench.storage.exports.lerobot import ExportReport
    from dmotion_bench.storage.imports.options import ImportReport
    from dmotion_bench.workspace import Workspace

try:
    __version__ = version("dmbench")
except PackageNotFoundError:  # the source tree on a path, never installed
    __version__ = "0.0.0"

__all__ = [
    "Built",
    "Dataset",
    "Demonstrated",
    "Difference",
    "DmbenchError",
    "Episode",
    "EpisodeLabels",
    "ExportReport",
    "ImportReport",
    "JobProgress",
    "Planned",
    "Pulled",
    "Pushed",
    "Recorded",
    "Report",
    "Reproduced",
    "Run",
    "Served",
    "Shared",
    "TripletDataset",
    "Verdict",
    "Workspace",
    "__version__",
    "demo",
    "environment_names",
    "export_dataset",
    "import_recordings",
    "leaderboard_build",
    "leaderboard_check",
    "leaderboard_compare",
    "load_run",
    "model_names",
    "objective_names",
    "open_dataset",
    "plan",
    "record",
    "register_environment",
    "register_model",
    "register_objective",
    "register_solver",
    "reproduce",
    "score",
    "share_list",
    "share_pull",
    "share_push",
    "solver_names",
    "train",
    "view",
]

_HOMES: Final = {
    "Built": "api.leaderboard",
    "Dataset": "api.datasets",
    "Demonstrated": "api.demonstration",
    "Difference": "scoring.differences",
    "DmbenchError": "errors",
    "Episode": "specs",
    "EpisodeLabels": "specs",
    "ExportReport": "storage.exports.lerobot",
    "ImportReport": "storage.imports.options",
    "JobProgress": "execution.job_progress",
    "Planned": "api.planning",
    "Pulled": "sharing.pull",
    "Pushed": "sharing.push",
    "Recorded": "recording.session",
    "Report": "scoring.report",
    "Reproduced": "api.reproducing",
    "Run": "api.runs",
    "Served": "api.viewing",
    "Shared": "sharing.contents",
    "TripletDataset": "api.datasets",
    "Verdict": "api.leaderboard",
    "Workspace": "workspace",
    "demo": "api.demonstration",
    "environment_names": "registry",
    "export_dataset": "api.importing",
    "import_recordings": "api.importing",
    "leaderboard_build": "api.leaderboard",
    "leaderboard_check": "api.leaderboard",
    "leaderboard_compare": "api.leaderboard",
    "load_run": "api.runs",
    "model_names": "registry",
    "objective_names": "registry",
    "open_dataset": "api.datasets",
    "plan": "api.planning",
    "record": "api.recording",
    "register_environment": "registry",
    "register_model": "registry",
    "register_objective": "registry",
    "register_solver": "registry",
    "reproduce": "api.reproducing",
    "score": "api.scoring",
    "share_list": "api.sharing",
    "share_pull": "api.sharing",
    "share_push": "api.sharing",
    "solver_names": "registry",
    "train": "api.training",
    "view": "api.viewing",
}
"""The module of each name; loaded when the name is first used."""


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'dmotion_bench' has no attribute {name!r}")
    found = getattr(importlib.import_module(f"dmotion_bench.{_HOMES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_ids()
