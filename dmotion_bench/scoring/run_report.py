"""The report of a run: its figures and those beside them, with what has to be borne in mind of each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from dmotion_bench.actions import kind_of
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.explanation import REMARK as EXPLAINED
from dmotion_bench.scoring.figures import Figures
from dmotion_bench.scoring.label_use import label_use
from dmotion_bench.scoring.latent_ranking import can_roll_out
from dmotion_bench.scoring.references import PublishedResult, published_for
from dmotion_bench.scoring.report import LABEL_USES, SCORING_VERSION, Report, protocol_of, training_facts
from dmotion_bench.scoring.tiers import refused
from dmotion_bench.scoring.transfer import training_of, transfer_remark
from dmotion_bench.specs import VERSION
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.versions import versions

REMARKS: Final[Mapping[str, str]] = {
    "copy_last": "predicts that nothing changes",
    "agent_moves": "moves the agent as it truly moves, and nothing else; what it uncovers is taken from the truth",
    "idle": "does nothing",
    "random": "takes any action, each as likely",
    "scripted": "pushes by rules that read the simulator",
    "oracle": "plans like the model, with the true simulator in its place",
}


def compose_report(
    run: Run, dataset: Dataset, figures: Figures, reference: Mapping[str, Figures], settings: Mapping[str, Any]
) -> Report:
    """The report of a run, as ``report.py`` describes it, but for what belongs to control's planning.

    Args:
        run, dataset: What was scored, on what.
        figures: Of the model.
        reference: Of the predictors that know nothing.
        settings: What decided the figures, and which groups there are (``ScoreSettings.to_json``).
    """
    result = run.result or {}
    own = training_of(run, dataset)
    spec, environment, actions = run.spec, dataset.recipe.environment, dataset.spec.actions
    published = None if own else published_for(spec.model, environment, spec.labels, actions=actions)
    beside = {name: _json(one) for name, one in reference.items()}
    if published is not None:
        beside["paper"] = {name: figure.to_json() for name, figure in published.figures.items()}
    use = label_use(spec, run.model.supervision)
    return Report(
        run=run.name,
        model=spec.model,
        arch=spec.arch,
        preset=spec.preset,
        seed=spec.seed,
        labels={
            "asked": spec.labels,
            "given": result.get("labels", {}),
            "total": result.get("labels_total", 0),
        }
        | ({"use": use} if use else {}),
        dataset={
            "name": dataset.name,
            "environment": environment,
            "fingerprint": dataset.fingerprint,
        }
        | ({VERSION: dataset.recipe.version} if dataset.recipe.version != 1 else {})
        | ({"actions": kind_of(actions)} if kind_of(actions) != "discrete" else {})
        | ({"trained_on": own} if own else {}),
        weights=result["weights"],
        settings=dict(settings),
        training=training_facts(result),
        versions=versions(),
        figures=_json(figures),
        reference=beside,
        remarks=_remarks(run, dataset, figures, reference, settings, published),
        protocol=protocol_of(settings.get("control_column")),
        scoring_version=SCORING_VERSION,
    )


def _remarks(
    run: Run,
    dataset: Dataset,
    figures: Figures,
    reference: Mapping[str, Figures],
    settings: Mapping[str, Any],
    published: PublishedResult | None,
) -> dict[str, str]:
    """What has to be borne in mind of the figures, and what could not be scored.

    Args:
        run, dataset, figures, reference, settings: See ``compose_report``.
        published: What a paper has published of the model on this data, if it has.
    """
    metrics = settings["metrics"]
    remarks = {name: remark for name, remark in REMARKS.items() if name in reference}
    left_out = refused(dataset.spec, dataset.recipe, metrics, figures)
    if dataset.spec.actions is None:
        remarks["actions"] = EXPLAINED
    elif not dataset.spec.objects and not dataset.spec.agent_has_color:
        remarks["positions"] = (
            "where the agent and the objects are is not known, so no figure is about them: " + left_out
        )
    elif left_out:
        remarks["positions"] = f"the environment does not tell everything: {left_out}"
    if any(name.startswith("control_picture") for name in figures):
        remarks["control"] = (
            "control_picture_distance is the mean squared difference from the goal image, 1 at the start; the "
            "environment tells no positions, so it is no distance of objects, and no task counts as solved"
        )
    if training_of(run, dataset):
        remarks["trained_on"] = transfer_remark(run, dataset, settings["split"])
    if published is not None:
        remarks["paper"] = f"{published.source}; labels: {published.labels}. {published.note}".strip()
    rolled_out = any(name.startswith("rollout_") for name in figures)
    if "rollout" in metrics and can_roll_out(run.model) and not rolled_out:
        remarks["rollout"] = (
            f"no {settings['split']} episode has the {settings['horizon'] + 2} frames that a rollout needs; "
            "ask for a smaller '--horizon'"
        )
    if not run.model.needs_pixels:
        remarks["prediction"] = f"{run.spec.model} draws no frames; what it is good for shows in control"
    if use := label_use(run.spec, run.model.supervision):
        remarks["labels"] = LABEL_USES[use]
    if settings["protocol"] == "paper":
        remarks["split"] = "the paper's split shuffles triplets: most test frames were seen in training (it leaks)"
    return remarks


def _json(figures: Figures) -> dict[str, Any]:
    return {name: estimate.to_json() for name, estimate in figures.items()}
