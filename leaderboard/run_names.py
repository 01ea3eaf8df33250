"""What a run's name says of its settings; ``dmotion_bench.learning.start.default_path`` makes such names."""

from __future__ import annotations

import re

from leaderboard.entry import Entry


def without_seed(entry: Entry) -> str:
    """The run's name without its seed: the same for trainings that differ by the seed alone."""
    return re.sub(r"-s\d+$", "", entry.name)


def settings_of(entry: Entry) -> str:
    """The part after model, architecture, data set and budget, such as ``small, epochs 3``; else the whole name."""
    name, content = without_seed(entry), entry.content
    dataset = entry.trained_on or str(content["dataset"]["name"])
    prefixes = (f"{entry.model}-{dataset}", f"{entry.model}-{content['arch']}-{dataset}")
    known = next((one for one in prefixes if f"{name}-".startswith(f"{one}-")), None)
    if known is None:
        return name
    beyond, preset = name.removeprefix(known).strip("-"), str(content["preset"])
    named = f"{beyond}-".startswith(f"{preset}-")  # where the data set's name does not say it
    beyond = beyond.removeprefix(preset).strip("-") if named else beyond
    beyond = beyond.removeprefix(entry.labels.replace("%", "pct")).strip("-")
    words = re.sub(r"-(?=[a-z])", ", ", beyond.replace("_", " "))
    return ", ".join(part for part in (preset if named else "", words) if part)
