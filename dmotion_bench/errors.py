"""Every error that dmbench raises on purpose.

::

    DmbenchError                      the command line prints its sentence and exits with 1
    ├── UsageError                    a name, option or value that is not allowed: exit with 2
    │   ├── UnknownName               no such environment, model, preset, run, data set, episode ...
    │   └── InvalidSetting            a --set key or a field's value that cannot be
    ├── DatasetError
    │   ├── DatasetMissing            no data set where one was expected
    │   ├── DatasetIncomplete         recording was interrupted; the command that goes on is named
    │   ├── DatasetCorrupt            bytes that are not what was written
    │   ├── DatasetVersionUnknown     written by another version of the format
    │   ├── CacheNotWritable          what is derived from a data set can be kept nowhere; another folder helps
    │   ├── RecipeMismatch            the folder holds a data set made by another recipe
    │   └── PlaceUnreachable          object storage that does not answer, however often it is asked
    ├── RecordingFailed               an environment or a policy failed in the middle of an episode
    ├── RecordingImportError          a foreign recording that cannot be read
    │   ├── RecordingTruncated        it ends in the middle
    │   └── RecordingNotFetched       a pointer of Git LFS stands in its place
    ├── LabelsNotAvailable            labels/ is not there, or the budget does not allow them
    ├── RunError
    │   ├── RunMissing
    │   ├── RunCorrupt                a checkpoint or configuration that cannot be read
    │   ├── RunMismatch               a run that was made with other settings or data
    │   └── ProcessLost               one of the processes that train together has ended, and so do the others
    ├── ModelContractBroken           a model does not do what learning/model.py asks
    ├── PlannerContractBroken         a solver or an objective does not do what its contract asks
    ├── ShareMissing                  nothing is published in that place under that fingerprint
    ├── ShareCorrupt                  what is published there is not what its name or its manifest says
    ├── EntryInvalid                  an entry of the leaderboard that breaks its schema
    ├── PackageNotInstalled           an optional dependency is absent; names the command
    ├── JobsLost                      the workers at some of many jobs were killed again and again; the others are done
    ├── FolderInUse                   another process writes into the folder
    ├── StorageFull                   no space left on the device
    ├── ViewerError                   Rerun could not be started or reached
    └── Interrupted                   in a command that does not go on where it stopped: exit with 130, 143 or 129

Each message says what was given, what is allowed, and the next command to type.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any, Final

from dmotion_bench.wording import sentence, shown

_SAID_AT_MOST: Final = 12  # names that stand in a sentence beside the one that was probably meant


class DmbenchError(Exception):
    """Base of all errors that a user can cause and mend. A worker process sends it back as it is.

    Whatever a sentence echoes, it stays short enough to be read and safe to print.
    """

    def __init__(self, said: str = "") -> None:
        super().__init__(sentence(said))

    def add(self, said: str) -> None:
        """Put another sentence behind those that are there."""
        self.args = (sentence(f"{str(self).removesuffix('.')}. {said}"),)

    def __reduce__(self) -> tuple[Any, ...]:
        return _again, (type(self), self.args, self.__dict__)


def _again(kind: type[DmbenchError], args: tuple[Any, ...], attributes: dict[str, Any]) -> DmbenchError:
    """Rebuild an error from its attributes after unpickling, without calling its constructor."""
    error = kind.__new__(kind)
    error.args = args
    error.__dict__.update(attributes)
    return error


class UsageError(DmbenchError):
    """A name, option or value that is not allowed."""


class UnknownName(UsageError):
    """No thing of this kind is known under the name asked for.

    Args:
        kind: What was looked for, in the singular: ``"model"``.
        name: What was asked for.
        known: Every allowed name.
        listing: The command that lists them, if there is one.
        registering: The function that makes one of the user's own known, if there is one.
    """

    def __init__(self, kind: str, name: str, known: Iterable[str], listing: str = "", registering: str = "") -> None:
        self.kind, self.name, self.known = kind, name, sorted(known)
        near = difflib.get_close_matches(str(name), self.known, n=1)  # Python passes what is no text, too
        if near:
            hint = f"did you mean {shown(near[0])}?"
            if not listing and len(self.known) <= _SAID_AT_MOST:
                hint += f" Known: {', '.join(self.known)}."
        elif self.known:
            hint = f"known: {', '.join(self.known)}."
        else:
            hint = "none is known here."
        tail = f" List them with '{listing}'." if listing else ""
        if registering and not near:
            tail += f" One of your own is known where {registering} was called, or once its package is installed."
        super().__init__(f"no {kind} named {shown(name)}; {hint}{tail}")


class InvalidSetting(UsageError):
    """A setting that does not exist or a value that it cannot take."""


class DatasetError(DmbenchError):
    """Something is wrong with a data set on disk."""


class DatasetMissing(DatasetError):
    """No data set where one was expected."""


class DatasetIncomplete(DatasetError):
    """A recording was interrupted and not yet completed."""


class DatasetCorrupt(DatasetError):
    """Files that do not hold what was written."""


class DatasetVersionUnknown(DatasetError):
    """The data set was written by another version of the format."""


class CacheNotWritable(DatasetError):
    """What is derived from a data set cannot be kept where it should be."""


class RecipeMismatch(DatasetError):
    """The folder holds a data set that another recipe made."""


class PlaceUnreachable(DatasetError):
    """Object storage that does not answer, or refuses."""


class RecordingFailed(DmbenchError):
    """An environment or a policy failed in the middle of an episode."""


class RecordingImportError(DmbenchError):
    """A foreign recording that cannot be read."""


class RecordingTruncated(RecordingImportError):
    """A foreign recording that ends in the middle."""


class RecordingNotFetched(RecordingImportError):
    """A pointer of Git LFS stands where a file of a recording should."""


class LabelsNotAvailable(DmbenchError):
    """The labels are not there, or the run's budget does not allow them."""


class RunError(DmbenchError):
    """Something is wrong with a training run on disk."""


class RunMissing(RunError):
    """No run where one was expected."""


class RunCorrupt(RunError):
    """A checkpoint or configuration that cannot be read."""


class RunMismatch(RunError):
    """The run was made with other settings or other data."""


class ProcessLost(RunError):
    """Another one of the processes that train together has ended."""

    def __init__(self, rank: int) -> None:
        self.rank = rank
        super().__init__(
            f"process {rank} of this training ends because another one has ended. Run the same command again: it goes "
            "on from the last checkpoint."
        )


class ModelContractBroken(DmbenchError):
    """A model does not do what ``learning/model.py`` asks of it."""


class PlannerContractBroken(DmbenchError):
    """A solver or an objective does not do what its contract asks."""


class ShareMissing(DmbenchError):
    """Nothing is published in that place under that fingerprint."""


class ShareCorrupt(DmbenchError):
    """What is published there is not what its name or its manifest says."""


class EntryInvalid(DmbenchError):
    """A file that is no entry of the leaderboard."""


class PackageNotInstalled(DmbenchError):
    """An optional dependency is absent."""

    def __init__(self, package: str, why: str, install: str) -> None:
        self.package = package
        super().__init__(f"{why} needs the package {package!r}, which is not installed; install it: {install}")


class JobsLost(DmbenchError):
    """The workers at some of many jobs were killed again and again; all others are done.

    Args:
        said: The sentence.
        jobs: Which ones.
    """

    def __init__(self, said: str, jobs: Iterable[Any] = ()) -> None:
        self.jobs = tuple(jobs)
        super().__init__(said)


class FolderInUse(DmbenchError):
    """Another process writes into the folder."""


class StorageFull(DmbenchError):
    """No space left on the device."""


class ViewerError(DmbenchError):
    """Rerun could not be started or reached."""


class Interrupted(DmbenchError):
    """Ctrl-C or a signal in a command that starts anew when it is called again."""
