"""A use of labels that is not the usual one is marked on the report, the entry and the row, and nowhere else."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dmotion_bench.learning.model import TrainingConfig
from dmotion_bench.learning.runs.run import RunSpec
from dmotion_bench.learning.settings import to_json
from dmotion_bench.registry import model_class
from dmotion_bench.scoring.label_use import label_use
from dmotion_bench.scoring.report import LABEL_USES

SPEC = RunSpec(
    model="lapo",
    arch="compact",
    config=to_json(model_class("lapo").configure("compact")),
    training=to_json(TrainingConfig(epochs=1)),
    preset="tiny",
    labels="64",
    seed=0,
    dataset="noise-tiny",
    fingerprint="0",
    height=32,
    width=32,
    actions=4,
)


@pytest.mark.parametrize(
    ("model", "adaptation", "use"),
    [
        ("lapo", "averaged", ""),
        ("ed-cnn", "averaged", ""),
        ("lapo", "clustered", "clustered"),
        ("lapo", "finetuned", "finetuned"),
        ("laom-labels", "clustered", "during, clustered"),
        ("laom-labels", "averaged", "during"),
        ("idm-ed-cnn", "averaged", "during"),
        ("laom-labels", "finetuned", "during, finetuned"),
    ],
)
def test_what_is_not_usual_has_a_name(model, adaptation, use) -> None:
    spec = replace(SPEC, model=model, training={**SPEC.training, "adaptation": adaptation})
    assert label_use(spec, model_class(model).supervision) == use
    assert use == "" or use in LABEL_USES
