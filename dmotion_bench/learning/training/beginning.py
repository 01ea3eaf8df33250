"""How a training begins: it is over already, goes on, takes over another budget's training, or starts anew."""

from __future__ import annotations

import platform
from collections.abc import Callable, Mapping
from typing import Any, Final

from dmotion_bench.errors import RunCorrupt, RunMissing
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.training.shared_pretraining import take_over
from dmotion_bench.storage.lock import held
from dmotion_bench.versions import DECIDING, differing, versions, with_earlier
from dmotion_bench.wording import shown
from dmotion_bench.workspace import RUN_MANIFEST

_MOST_NAMED: Final = 5


def finished_result(
    run: Run,
    note: Callable[[str], None] = lambda _: None,
    warn: Callable[[str], None] = lambda _: None,
    ready: Callable[[], None] = lambda: None,
) -> dict[str, Any] | None:
    """The result of a run that is trained already; None if it is to be trained.

    A finished run whose weights are damaged begins anew, and so does one that failed before its first checkpoint: it is
    trained by the code as it is now. A run that has not begun takes over the training of another one that differs only
    in its labels.

    Args:
        run: Its folder may be changed.
        note, warn: Told in a sentence what was found; and that the model's code was changed since.
        ready: Asked before the training of another run is taken over; raises what speaks against it, such as labels
            that are not there.

    Raises:
        FolderInUse: Another training of the run is going on.
        RunMismatch: Another command has begun a run with other settings in the folder since this one was looked up.
    """
    if run.result is not None:
        if (damage := _damage(run)) is not None:
            note(f"{damage}\ntraining {run.path} anew.")
            with held(run.path):
                run.read_again()
                if run.result is not None and _damage(run) is not None:  # else another command was faster
                    run.begin_anew()
        else:
            note(f"{run.path} is already trained; here is its result.")
            tell_changes(run, warn)
            return run.result
    if (source := take_over(run, ready)) is not None:
        note(f"using the training of {source.path}, which differs only in its labels and what it does with them.")
        tell_changes(source, warn)
    elif run.last.exists():
        note(f"going on with {run.path}.")
        tell_changes(run, warn)
        _tell_versions(run, warn)
    elif (run.path / RUN_MANIFEST).exists():
        with held(run.path):
            run.read_again()
            if run.result is None and not run.last.exists():  # nothing is left of an attempt that failed but run.json
                run.begin_anew()
    return None


def is_finished(run: Run) -> bool:
    """Whether a run is trained to its end and its weights are whole; its folder is left as it is."""
    return run.result is not None and _damage(run) is None


def _damage(run: Run) -> RunMissing | RunCorrupt | None:
    """Why the weights of a finished run cannot be used; None if they can."""
    try:
        run.weights()
    except (RunMissing, RunCorrupt) as error:
        return error
    return None


def _tell_versions(run: Run, warn: Callable[[str], None]) -> None:
    """Warn that a training goes on with other packages than it began with, if it does: its weights depend on them."""
    before = run.manifest["versions"]
    both = with_earlier(before, versions())
    if changed := [f"{name} {both[name]}" for name in DECIDING if both.get(name) != before.get(name, both.get(name))]:
        warn(
            f"that training goes on with another version than it began with ({'; '.join(changed)}), so its weights are "
            f"those of neither alone; to train with one version, delete {shown(str(run.path))} first."
        )


def tell_machine(command: Mapping[str, str], warn: Callable[[str], None]) -> None:
    """Warn that this machine trains with other versions than the machine of the command has, if it does."""
    if (other := differing(command)) is not None:
        here, there = other
        warn(
            f"the machine {shown(platform.node())} trains with {here}, and the one where the command was typed has "
            f"{there}; weights depend on it. To compare trainings, install the same versions on all machines."
        )


def tell_changes(run: Run, warn: Callable[[str], None]) -> None:
    """Warn that a model's code was changed since a run began, if it was."""
    if not (names := run.changed_modules):
        return
    named = ", ".join([*names[:_MOST_NAMED], *(["and others"] if len(names) > _MOST_NAMED else [])])
    warn(
        f"the code of the model {run.spec.model!r} was changed since that training began ({named}); to train the model "
        f"as it is now, delete {shown(str(run.path))} first."
    )
