"""What a run's name says of its settings; ``dmotion_bench.learning.runs.start.default_path`` makes such names."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any, Final

from leaderboard.entry import Entry

_UNSAID: Final = re.compile(r"threads \d+|adaptation \w+")
"""What only changes rounding, and what a row says in words (``labels.use``)."""


def without_seed(entry: Entry) -> str:
    """The run's name without its seed: the same for trainings that differ by the seed alone."""
    return re.sub(r"-s\d+$", "", entry.name)


def training_data_of(entry: Entry) -> Mapping[str, Any]:
    """The name and the fingerprint of the data set that an entry's run was trained on."""
    scored_on = entry.content["dataset"]
    own: Mapping[str, Any] = scored_on.get("trained_on", scored_on)
    return own


def training_of(entry: Entry) -> tuple[str, ...]:
    """What decides a training but its seed: the same for all trainings of a row, on whatever data they were scored."""
    content, settings = entry.content, unusual_settings(entry)
    data = training_data_of(entry)["fingerprint"]
    told = entry.model, content["arch"], content["preset"], entry.labels, entry.label_use, data
    return *told, without_seed(entry) if settings is None else settings


def settings_of(entry: Entry) -> str:
    """The part after model, architecture, data set and budget, such as ``small, epochs 3``; else the whole name."""
    known = _after_budget(entry)
    return without_seed(entry) if known is None else ", ".join(part for part in known if part)


def unusual_settings(entry: Entry) -> str | None:
    """The same without the preset and without what a row need not say (``_UNSAID``); None for another name."""
    known = _after_budget(entry)
    if known is None:
        return None
    return ", ".join(part for part in known[1:] if not _UNSAID.fullmatch(part))


def _after_budget(entry: Entry) -> list[str] | None:
    """The preset, empty where the data set's name says it, and each setting; None for a name of another form."""
    name, content = without_seed(entry), entry.content
    dataset = entry.trained_on or str(content["dataset"]["name"])
    usual = f"{entry.environment}-{content['preset']}"  # of a data set that was given another name since
    prefixes = [
        f"{entry.model}-{between}{data}" for data in (dataset, usual) for between in ("", f"{content['arch']}-")
    ]
    known = next((one for one in prefixes if f"{name}-".startswith(f"{one}-")), None)
    if known is None:
        return None
    beyond, preset = name.removeprefix(known).strip("-"), str(content["preset"])
    named = f"{beyond}-".startswith(f"{preset}-")  # where the data set's name does not say it
    beyond = beyond.removeprefix(preset).strip("-") if named else beyond
    beyond = beyond.removeprefix(entry.labels.replace("%", "pct")).strip("-")
    words = re.split(r"-(?=[a-z])", beyond.replace("_", " ")) if beyond else []
    return [preset if named else "", *sorted(map(_alike, words))]


def _alike(setting: str) -> str:
    """A setting such as ``learning rate 1e-3`` with its value as everybody else's: 0.001, true, 5."""
    name, _, value = setting.rpartition(" ")
    try:
        number = float(value)
    except ValueError:
        return f"{name} {value.lower()}" if value.lower() in ("true", "false") else setting
    return f"{name} {number:g}" if math.isfinite(number) and float(f"{number:g}") == number else setting
