"""``dmbench list``: the environments, models, columns, data sets and runs that commands can be given."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import typer

from dmotion_bench.cli.options import AsJson
from dmotion_bench.cli.stdout import print_json, say

if TYPE_CHECKING:
    from dmotion_bench.environment import RecordingPreset
    from dmotion_bench.specs import Preset

listing = typer.Typer(help="List environments, models, columns, data sets and runs.", no_args_is_help=True)


def register(app: typer.Typer) -> None:
    """Add the group of commands."""
    app.add_typer(listing, name="list")


def _show(key: str, rows: list[dict[str, object]], as_json: bool, nothing: str) -> None:
    if as_json:
        print_json({key: rows})
        return
    if not rows:
        say(nothing)
        return
    from dmotion_bench.cli.tables import show_rows

    show_rows(rows[0], ([str(value) for value in row.values()] for row in rows))


@listing.command()
def environments(as_json: AsJson = False) -> None:
    """List the environments, what they tell (the tier), their policies, and the factors that can vary in them."""
    from dmotion_bench.errors import DmbenchError
    from dmotion_bench.registry import environment_family, environment_names, family_names

    rows: list[dict[str, object]] = []
    for name in environment_names():
        try:
            rows.append(_environment(name, as_json))
        except DmbenchError as error:  # somebody else's environment; the others are to be listed
            row: dict[str, object] = {"environment": name, "tier": "?", "presets": "?"}
            row |= {"policies": list[str]() if as_json else "?", "--vary": dict[str, str]() if as_json else "?"}
            rows.append(row | {"what": f"cannot be used: {error}"} | ({"versions": {}} if as_json else {}))
    for name in family_names():
        family = environment_family(name)
        presets, nothing = _presets(family.recording), {} if as_json else "nothing"
        for member, what in family.worlds().items():
            row = {"environment": f"{name}:{member}", "tier": family.tier.value, "presets": presets}
            row |= {"policies": list(family.policies) if as_json else ", ".join(family.policies)}
            rows.append(row | {"--vary": nothing, "what": what} | ({"versions": {1: what}} if as_json else {}))
    if as_json:
        rows = [{"factors" if key == "--vary" else key: value for key, value in row.items()} for row in rows]
    _show("environments", rows, as_json, "none is installed.")
    if not as_json and rows:
        say("gym:ID records any Gymnasium environment that draws pictures; those above are known to work.")
        say("'dmbench list environments --json' tells what each factor means and which values it takes.")


def _environment(name: str, as_json: bool) -> dict[str, object]:
    """What is told of an environment."""
    from dmotion_bench.environment import Varied, tier_of
    from dmotion_bench.registry import environment_class, environment_versions

    kind = environment_class(name)
    summary = next(iter((kind.__doc__ or "").strip().splitlines()), "")
    factors: dict[str, str] = dict(kind.factors) if isinstance(kind, Varied) else {}
    policies = sorted(kind.policies, key=lambda policy: policy != kind.default_policy)
    row: dict[str, object] = {"environment": name, "tier": tier_of(kind).value, "presets": _presets(kind.recording)}
    row |= {"policies": policies if as_json else ", ".join(policies)}
    row |= {"--vary": factors if as_json else ", ".join(factors) or "nothing", "what": summary}
    return row | ({"versions": dict(environment_versions(name)) or {1: summary}} if as_json else {})


def _presets(recording: Mapping[Preset, RecordingPreset]) -> str:
    return ", ".join(f"{preset.value} {made.episodes} episodes" for preset, made in recording.items())


@listing.command()
def models(as_json: AsJson = False) -> None:
    """List the models that can be trained."""
    from dmotion_bench.execution.refusals import reason
    from dmotion_bench.registry import model_names

    rows: list[dict[str, object]] = []
    for name in model_names():
        try:
            values = _model(name)
        except Exception as error:  # somebody else's model; the others are to be listed
            values = ("?", "?", "?", f"cannot be used: {reason(error)}")
        rows.append(
            dict(zip(("model", "learns from", "parameters", "architectures", "paper"), (name, *values), strict=True))
        )
    _show("models", rows, as_json, "none is installed.")


def _model(name: str) -> tuple[str, ...]:
    from dmotion_bench.api.installed import model_facts

    facts = model_facts(name)
    return facts.learns_from, f"{facts.parameters / 1e6:.2f} M", ", ".join(facts.architectures), facts.paper


@listing.command()
def columns(as_json: AsJson = False) -> None:
    """List the columns of the table of control, each a frozen planner; the first is the headline."""
    from dmotion_bench.api import scoring

    rows: list[dict[str, object]] = [
        {
            "column": one.name,
            "protocol": one.protocol,
            "planner": " ".join([one.planner, *one.planner_set]),
            "objective": one.objective or one.for_objects,
            "actions": "continuous" if one.continuous else "all",
            "what": one.meaning,
        }
        for one in scoring.columns()
    ]
    _show("columns", rows, as_json, "there is none.")


@listing.command()
def datasets(as_json: AsJson = False) -> None:
    """List the data sets of the workspace."""
    from dmotion_bench.errors import DatasetError
    from dmotion_bench.storage.dataset import Dataset
    from dmotion_bench.workspace import Workspace

    workspace = Workspace.current()
    rows: list[dict[str, object]] = []
    for path in workspace.datasets():
        try:
            dataset = Dataset.open(path)
            state = f"{len(dataset)} episodes, {int(dataset.lengths.sum())} frames"
        except DatasetError as error:
            state = str(error)
        rows.append({"data set": str(path if as_json else workspace.short(path)), "state": state})
    _show("datasets", rows, as_json, f"none in {workspace.data}; record one with 'dmbench record grid_world'.")


@listing.command()
def runs(as_json: AsJson = False) -> None:
    """List the training runs of the workspace."""
    from dmotion_bench.errors import RunError
    from dmotion_bench.workspace import Workspace

    workspace = Workspace.current()
    rows: list[dict[str, object]] = []
    for path in workspace.all_runs():
        from dmotion_bench.api.runs import Run

        name = str(path if as_json else workspace.short(path))
        try:
            run = Run.open(path)
            done = f"trained, {run.result['steps']} steps" if run.result else "not finished"
            rows.append({"run": name, "model": run.spec.model, "labels": run.spec.labels, "state": done})
        except RunError as error:
            rows.append({"run": name, "model": "?", "labels": "?", "state": str(error)})
    _show("runs", rows, as_json, f"none in {workspace.runs}; train one with 'dmbench train dmotion'.")
