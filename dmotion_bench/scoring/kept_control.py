"""Where control is kept: the journal of a run, or of a reference in the data set's cache, and the key it belongs to.

What was kept by earlier releases in other words is found, too, as long as the result would be the same.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.learning.runs.checkpoint import weights_hash
from dmotion_bench.planning.agents import known_actions
from dmotion_bench.planning.dynamics.model import arithmetic_on
from dmotion_bench.planning.journal import Extent, Journal
from dmotion_bench.planning.mpc import CONTROL_VERSION
from dmotion_bench.scoring.earlier_planning import LATER, NOT_SETTINGS, earlier_name, earlier_planning, without_later
from dmotion_bench.scoring.report import CONTROL_OF_CODE
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.workspace import cache_folder

if TYPE_CHECKING:
    from dmotion_bench.scoring.control import ControlScoring


def journal_of(
    path: Path | None,
    model: ForwardModel[Any] | str,
    dataset: ReadableDataset,
    scoring: ControlScoring,
    device: torch.device | None,
) -> Journal:
    """The journal of a control run; it also accepts results of this version in the words of earlier releases."""
    key = _key(model, dataset, scoring, device)
    extent = Extent(actions=known_actions(dataset.spec), tasks=len(dataset.tasks()), steps=scoring.steps)
    shares = [] if path is None else shares_of(path)
    journal = Journal(path, key, extent, earlier=_earlier_keys(key, scoring))
    for share in shares:
        journal.take_over(share)
    if path is not None and shares:
        journal.take_over(path)  # again: another process may have gathered the shares in it meanwhile
    return journal


def share_of(journal: Path, first: int) -> Path:
    """Where a share of a control run is kept: the tasks from number ``first`` on."""
    return journal.with_name(f"{journal.stem}-{first}{journal.suffix}")


def shares_of(journal: Path) -> list[Path]:
    """The shares of a control run that are there."""
    return sorted(path for path in journal.parent.glob(f"{journal.stem}-*{journal.suffix}") if path != journal)


def _key(
    model: ForwardModel[Any] | str, dataset: ReadableDataset, scoring: ControlScoring, device: torch.device | None
) -> dict[str, Any]:
    """Everything that decides the result of a task."""
    needs_pixels = None if isinstance(model, str) else model.needs_pixels
    arithmetic = {} if isinstance(model, str) else {"arithmetic": arithmetic_on(device or torch.device("cpu"))}
    return arithmetic | {
        "version": CONTROL_VERSION,
        "planning": scoring.planning(dataset, needs_pixels=needs_pixels),
        "dataset": dataset.fingerprint,
        "who": model if isinstance(model, str) else weights_hash(model.state_dict()),
        "device": "cpu" if device is None else device.type,
        "steps": scoring.steps,
        "seed": scoring.seed,
        "group": scoring.group,
    }


def kept_by_reference(name: str, dataset: ReadableDataset, scoring: ControlScoring) -> Path:
    """Where a reference's results are kept: in the file of an earlier key, if there is one, or in that of the key."""
    key = _key(name, dataset, scoring, None)
    earlier = (_place(name, dataset, one) for one in _earlier_keys(key, scoring))
    return next((path for path in earlier if path.is_file()), _place(name, dataset, key))


def _place(name: str, dataset: ReadableDataset, key: Mapping[str, Any]) -> Path:
    text = json.dumps(key, sort_keys=True)
    return cache_folder(dataset.path) / f"control-{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}.json"


def _earlier_keys(key: Mapping[str, Any], scoring: ControlScoring) -> list[dict[str, Any]]:
    """The keys by which earlier releases kept the same results.

    At first the version was a hash of the code; then a report said ``planner`` and ``cost`` (``earlier_planning``).
    The arithmetic in which a model imagines was not named.
    """
    found = []
    if "arithmetic" in key:
        key = {name: value for name, value in key.items() if name != "arithmetic"}
        found.append(key)
    plain, named = without_later(key["planning"]), str(key["planning"]["solver"]["name"])
    found += [] if plain is None else [dict(key) | {"planning": plain}]
    planning = None if plain is None and named in LATER else earlier_planning(key["planning"])
    if planning is None:
        return found
    found.append(dict(key) | {"planning": planning})
    if not scoring.objective_set:
        fields = {name: value for name, value in planning["planner"].items() if name not in NOT_SETTINGS}
        planner = f"{planning['planner']['class']}({', '.join(f'{name}={value!r}' for name, value in fields.items())})"
        cost = None if scoring.objective is None else earlier_name(scoring.objective)
        common = {name: value for name, value in key.items() if name not in ("version", "planning")}
        codes = [code for code, version in CONTROL_OF_CODE.items() if version == CONTROL_VERSION]
        found += [{"code": code, "planner": planner, "cost": cost} | common for code in codes]
    return found
