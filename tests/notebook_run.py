"""Runs a notebook from top to bottom by a kernel of this interpreter, which is spoken to by files and by no port.

``python -m tests.notebook_run docs/notebooks/*.ipynb`` runs notebooks and keeps in their files what their cells gave.
"""

from __future__ import annotations

import copy
import json
import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SECONDS_OF_A_CELL = 600
"""On a busy machine; a cell takes less than a minute of computation."""


def run(notebook: Path, folder: Path, shorter: Mapping[str, str] | None = None) -> dict[str, Any]:
    """The notebook with what its cells gave; an exception in a cell is raised.

    Args:
        notebook: Its file, which stays as it is.
        folder: The working folder of the kernel.
        shorter: What stands in its cells, each once, and what is run in its place; None to run it as it is.
    """
    import nbformat
    from jupyter_client.kernelspec import KernelSpec
    from jupyter_client.manager import AsyncKernelManager
    from nbclient import NotebookClient

    class ThisInterpreter(AsyncKernelManager):
        """Starts this interpreter, whatever kernels are installed."""

        @property
        def kernel_spec(self) -> KernelSpec:
            return KernelSpec(argv=[sys.executable, "-m", "ipykernel_launcher", "-f", "{connection_file}"])

    content = nbformat.read(notebook, as_version=4)
    for text, instead in (shorter or {}).items():
        (cell,) = [cell for cell in content["cells"] if text in cell["source"]]
        cell["source"] = cell["source"].replace(text, instead)
    with tempfile.TemporaryDirectory() as sockets:
        manager = ThisInterpreter(transport="ipc", ip=f"{sockets}/kernel", connection_file=f"{sockets}/kernel.json")
        client = NotebookClient(
            content,
            km=manager,
            timeout=SECONDS_OF_A_CELL,
            resources={"metadata": {"path": str(folder)}},
            record_timing=False,
            coalesce_streams=True,  # what one cell prints may come in several pieces
        )
        client.execute()
    return _plain(json.loads(nbformat.writes(content)))


def _plain(content: dict[str, Any]) -> dict[str, Any]:
    """Without what says by which interpreter it was run."""
    plain = copy.deepcopy(content)
    plain["metadata"] = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    for cell in plain["cells"]:
        cell["metadata"] = {}
        for output in cell.get("outputs", ()):
            output.get("data", {}).pop("image/jpeg", None)  # the same picture once more
            if "image/png" in output.get("data", {}):
                output["data"]["text/plain"] = "<a picture>"  # without an address in memory
    return plain


def main(paths: list[str]) -> None:
    """Run the notebooks of some files and write them anew."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    for path in map(Path, paths):
        with tempfile.TemporaryDirectory() as folder:
            content = run(path, Path(folder))
        path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n")
        print(f"{path}: {path.stat().st_size:,} bytes")


if __name__ == "__main__":
    main(sys.argv[1:])
