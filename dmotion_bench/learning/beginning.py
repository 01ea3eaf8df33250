"""How a training begins: it is over already, goes on, takes over another budget's training, or starts anew."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from dmotion_bench.errors import RunCorrupt, RunMissing
from dmotion_bench.learning.run import Run
from dmotion_bench.learning.twins import take_over


def finished_result(run: Run, note: Callable[[str], None] = lambda _: None) -> dict[str, Any] | None:
    """The result of a run that is trained already; None if it is to be trained.

    A finished run whose weights are damaged begins anew. A run that has not begun takes over the training of another
    one that differs only in its labels.

    Args:
        run: Its folder may be changed.
        note: Told in a sentence what was found.
    """
    if run.result is not None:
        try:
            run.weights()
        except (RunMissing, RunCorrupt) as error:
            note(f"{error}\ntraining {run.path} anew.")
            run.begin_anew()
        else:
            note(f"{run.path} is already trained; here is its result.")
            return run.result
    if (twin := take_over(run)) is not None:
        note(f"using the training of {twin.path}, which differs only in its labels.")
    elif run.last.exists():
        note(f"going on with {run.path}.")
    return None
