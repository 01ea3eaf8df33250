"""``dmbench info``: versions, hardware and workspace, for bug reports."""

from __future__ import annotations

import os
import platform
from typing import Any

import typer

from dmotion_bench.cli.options import AsJson
from dmotion_bench.cli.stdout import print_json, say


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(info)


def info(as_json: AsJson = False) -> None:
    """Show versions, hardware and workspace, for bug reports."""
    import torch

    from dmotion_bench.api.installed import bf16_on_cpu
    from dmotion_bench.registry import environment_names, model_names
    from dmotion_bench.versions import versions
    from dmotion_bench.workspace import Workspace

    workspace = Workspace.current()
    gpus = [torch.cuda.get_device_name(number) for number in range(torch.cuda.device_count())]
    facts: dict[str, Any] = {
        "versions": versions(),
        "system": platform.platform(),
        "cpu": {
            "cores": os.cpu_count(),
            "instructions": torch.backends.cpu.get_cpu_capability(),
            "bf16": bf16_on_cpu(),
        },
        "gpus": gpus,
        "workspace": str(workspace.root.resolve()),
        "datasets": [path.name for path in workspace.datasets()],
        "runs": [path.name for path in workspace.all_runs()],
        "environments": environment_names(),
        "models": model_names(),
    }
    if as_json:
        print_json(facts)
        return
    for key, value in facts.items():
        if isinstance(value, dict):
            value = ", ".join(f"{name} {what}" for name, what in value.items())
        elif isinstance(value, list):
            value = ", ".join(value) or "none"
        say(f"{key:13s} {value}")
