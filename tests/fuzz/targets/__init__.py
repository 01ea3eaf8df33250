"""What is spoilt, what a user then does with it, and what may come of that."""

from __future__ import annotations

import shutil
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

from tests.fuzz.case import Answers, Case, Probe


class Target(ABC):
    """One kind of folder or file."""

    name: ClassVar[str]
    share: ClassVar[int]
    """Of all cases, beside the other targets' shares."""

    def __init__(self, originals: Path) -> None:
        self.originals = originals / self.name

    @abstractmethod
    def make(self) -> None:
        """Make the originals, once."""

    @abstractmethod
    def names(self) -> list[str]:
        """Of the originals; each has a reference."""

    @abstractmethod
    def spoil(self, case: Case) -> Any:
        """Put a spoilt copy of an original into the case's folder."""

    @abstractmethod
    def intact(self, case: Case, name: str) -> Any:
        """What ``spoil`` gives, of a copy that is not spoilt."""

    @abstractmethod
    def probes(self, case: Case, spoilt: Any) -> Iterator[Probe]:
        """What a user does."""

    @abstractmethod
    def judge(self, case: Case, spoilt: Any, answers: Answers, reference: dict[str, Any]) -> Iterator[tuple[str, str]]:
        """What is wrong with the answers: the kind of fault, and what is to be known of it."""


def copied(source: Path, to: Path) -> Path:
    """A copy without anything that one who looks at it could change in the original."""
    shutil.copytree(source, to, symlinks=True, copy_function=shutil.copyfile)
    return to
