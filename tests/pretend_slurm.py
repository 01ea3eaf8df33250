"""Slurm's five commands as far as submitit speaks to them: jobs are processes of this machine, all at once."""

from __future__ import annotations

import itertools
import os
import sys
from pathlib import Path

import pytest

from dmotion_bench.execution import slurm_executor

_COMMANDS = {
    "sbatch": """
text = Path(sys.argv[1]).read_text()
job = int((state / "first-job").read_text()) + len(list(state.glob("script-*")))
(state / f"script-{job}").write_text(text)
array = re.search(r"--array=0-(\\d+)%", text)
for index in range(int(array[1]) + 1) if array else [None]:
    name = str(job) if index is None else f"{job}_{index}"
    alone = {"NTASKS": 1, "JOB_NUM_NODES": 1, "NODEID": 0, "PROCID": 0, "LOCALID": 0, "JOB_NODELIST": "here"}
    said = {"JOB_ID": job, **alone}
    if index is not None:
        said |= {"ARRAY_JOB_ID": job, "ARRAY_TASK_ID": index}
    env = os.environ | {f"SLURM_{key}": str(value) for key, value in said.items()}
    log = (state / f"log-{name}").open("w")
    child = subprocess.Popen(["bash", sys.argv[1]], env=env, stdout=log, stderr=log, start_new_session=True)
    (state / f"task-{name}").write_text(str(child.pid))
print(f"Submitted batch job {job}")
""",
    "srun": """
start = next(place for place, word in enumerate(sys.argv) if word.endswith("python") or "/python" in word)
job, array = os.environ["SLURM_JOB_ID"], os.environ.get("SLURM_ARRAY_TASK_ID", "")
for stream, option in ((1, "--output"), (2, "--error")):
    path = sys.argv[sys.argv.index(option) + 1]
    for sign, value in (("%A", job), ("%j", job), ("%a", array), ("%t", "0")):
        path = path.replace(sign, value)
    os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND), stream)
os.execv(sys.argv[start], sys.argv[start:])
""",
    "sacct": """
print("JobID|State|NodeList")
for task in sorted(state.glob("task-*")):
    try:
        gone = Path(f"/proc/{task.read_text()}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except FileNotFoundError:
        gone = True
    print(f"{task.name.removeprefix('task-')}|{'COMPLETED' if gone else 'RUNNING'}|here")
""",
    "squeue": """
for task in sorted(state.glob("task-*")):
    with contextlib.suppress(FileNotFoundError):
        if Path(f"/proc/{task.read_text()}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX":
            print(task.name.removeprefix("task-"))
""",
    "scancel": """
for job in sys.argv[1:]:
    for task in state.glob(f"task-{job}*"):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(int(task.read_text()), signal.SIGKILL)
""",
}

_FIRST_JOBS = itertools.count(1000, 1000)
"""One for each Slurm: submitit remembers what became of a number for as long as a process lives."""


def use_slurm(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put Slurm on the PATH; its disk shows at once what a job wrote, and is not waited for."""
    monkeypatch.setenv("PATH", f"{install_slurm(folder)}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setitem(slurm_executor._PATIENCE, "slurm", 1.0)
    monkeypatch.setitem(slurm_executor._ASK_AGAIN, "slurm", 1.0)


def install_slurm(folder: Path) -> Path:
    """Put the commands into ``folder``/bin, to be set before the PATH; the scripts that they are given stay beside."""
    (folder / "bin").mkdir(parents=True)
    (folder / "first-job").write_text(str(next(_FIRST_JOBS)))
    for name, body in _COMMANDS.items():
        head = f"#!{sys.executable}\nimport contextlib, os, re, signal, subprocess, sys\nfrom pathlib import Path\n"
        file = folder / "bin" / name
        file.write_text(f"{head}state = Path({str(folder)!r})\n{body}")
        file.chmod(0o755)
    return folder / "bin"


def first_job(folder: Path) -> int:
    """The number of the first job, or array of jobs, that is given to the Slurm in a folder."""
    return int((folder / "first-job").read_text())
