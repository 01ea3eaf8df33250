"""How a run used its labels, where it did not do so in the usual way: what reports, entries and boards mark it by.

The usual way of a model of video is to be told its actions after the training, and that of a supervised one to learn
from them all along. What differs is in ``labels.use`` of a report and an entry, and in words on every row.
"""

from __future__ import annotations

from typing import Final

from dmotion_bench.learning.runs.run import RunSpec
from dmotion_bench.specs import Supervision

USUAL_USES: Final = ("", "during")
"""The values of ``labels.use`` that say how a model always uses labels: who learns with a few has no other way."""


def label_use(spec: RunSpec, supervision: Supervision) -> str:
    """The value of ``labels.use``, a name in ``LABEL_USES``; empty where labels were used in the usual way.

    Args:
        spec: Of the run.
        supervision: Of its model.
    """
    during = supervision is Supervision.FEW
    adaptation = spec.training_config.adaptation
    return ", ".join(["during"] * during + [adaptation] * (adaptation != "averaged"))
