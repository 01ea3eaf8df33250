"""What models reach in the worlds, kept in ``docs/worlds.json``: ``python -m tests.worlds.models RUN ...`` adds runs.

A run is the folder of a training that ``dmbench score`` has scored.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, Final

from tests.worlds.page import FIGURES

KEPT: Final = ("mse", "ssim", "mse_true_motion")


def measured(report: dict[str, Any], spec: dict[str, Any]) -> dict[str, Any]:
    """What the page tells of a scored run."""
    figures, reference = report["figures"], report["reference"]["copy_last"]
    return {
        "gate_floor": spec["config"].get("gate_floor", 0.0),
        "preset": report["preset"],
        "dataset": report["dataset"]["name"],
        "fingerprint": report["dataset"]["fingerprint"],
        "weights": report["weights"],
        "labels": report["labels"]["total"],
        "triplets": report["training"]["triplets"],
        "figures": {
            name: {part: round(figures[name][part], 4) for part in ("mean", "low", "high", "n")}
            for name in KEPT
            if name in figures
        },
        "copy_last": {name: round(reference[name]["mean"], 4) for name in ("mse", "ssim")},
    }


def main(runs: list[Path]) -> None:
    """Put the runs' figures beside their worlds'."""
    found = json.loads(FIGURES.read_text())
    for run in runs:
        report = json.loads((run / "report" / "report.json").read_text())
        one = measured(report, json.loads((run / "run.json").read_text())["spec"])
        trained = found[report["dataset"]["environment"]].setdefault("models", {})
        trained.setdefault(report["model"], {})[f"gate_floor={one['gate_floor']:g}"] = one
    FIGURES.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main([Path(name) for name in sys.argv[1:]])
