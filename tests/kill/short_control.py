"""Score a run's control with short tasks and a journal that is written often: the command line has neither option."""

from __future__ import annotations

import sys
from pathlib import Path

from dmotion_bench.api.scoring import score_runs
from dmotion_bench.cli.app import main

STEPS, TASKS = 2, 2


def score() -> None:
    """The run that is named."""
    from dmotion_bench.planning import journal
    from dmotion_bench.scoring.control import ControlScoring
    from dmotion_bench.scoring.settings import ScoreSettings

    journal.WRITE_EVERY = 0.1  # type: ignore[misc]
    control = ControlScoring(tasks=TASKS, steps=STEPS, planner="exhaustive", group=1)
    score_runs([Path(sys.argv[1])], ("control",), ScoreSettings(control=control))


if __name__ == "__main__":
    from dmotion_bench.cli import app

    app.register_commands = lambda: None
    app.app = lambda **_: score()  # interruptions and errors end as in every command
    main()
