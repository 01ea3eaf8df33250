"""A case in a process of its own, forked from a parent that has everything loaded, within limits.

What the child may use: ``MEMORY`` more than when it began, ``CPU_S`` of a processor, ``WALL_S`` by the clock. A process
that it starts, such as the one that decodes video, may use ``MEMORY`` in all.
"""

from __future__ import annotations

import contextlib
import faulthandler
import gc
import json
import os
import re
import resource
import select
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tests.fuzz.case import Answer, Case, Fault, answer_of
from tests.fuzz.targets import Target

MEMORY = 1 << 30  # bytes that a case may add to the resident set
ADDRESSES = 6 << 30  # bytes of address space beyond what the parent has; a guard for this machine
CPU_S = 20
WALL_S = 600  # far beyond CPU_S: the machine may be busy
FAILED = 77
"""Exit code of a child in which the fuzzer itself is at fault."""


@dataclass
class Result:
    """What came of a case.

    Attributes:
        told, formats: What was spoilt, and the formats of the files.
        verdict: ``ok``, ``sentence`` (at least one), or ``fault``.
        faults: Kind, probe, where in dmbench, and details, of each.
        cpu_s, peak: What it took: processor seconds, bytes added to the resident set.
        slowest: The probe that took longest.
        loaded: Modules that were imported for it.
    """

    number: int
    target: str
    checksums: str
    told: list[str]
    verdict: str
    faults: list[dict[str, str]] = field(default_factory=list)
    answers: dict[str, Answer] = field(default_factory=dict)
    cpu_s: float = 0.0
    peak: int = 0
    greedy: str = ""
    formats: list[str] = field(default_factory=list)
    loaded: list[str] = field(default_factory=list)

    def to_json(self) -> dict[str, Any]:
        """As plain values, without what was loaded."""
        return {name: value for name, value in asdict(self).items() if name != "loaded"}


def run_case(case: Case, target: Target, reference: dict[str, Any], *, only_spoil: bool = False) -> Result:
    """Fork, run, wait, judge. With ``only_spoil`` the spoilt files are left in the case's folder, and nothing more."""
    case.folder.mkdir(parents=True, exist_ok=True)
    read, write = os.pipe()
    log = case.folder.with_suffix(".stderr")
    process = os.fork()
    if process == 0:
        os.close(read)
        _child(write, log, lambda send: _work(case, target, reference, send, only_spoil))
    os.close(write)
    lines, status, usage, hung = _wait(process, read)
    stderr = log.read_text(errors="replace") if log.exists() else ""
    log.unlink(missing_ok=True)
    if not only_spoil:
        shutil.rmtree(case.folder, ignore_errors=True)
    return _result(case, lines, status, usage, hung, stderr)


def _child(pipe: int, log: Path, work: Callable[[Callable[..., None]], None]) -> None:
    """Never returns."""
    code = FAILED
    try:
        handle = os.open(log, os.O_CREAT | os.O_WRONLY | os.O_TRUNC | os.O_APPEND, 0o600)
        null = os.open(os.devnull, os.O_RDONLY)
        for number, source in ((0, null), (1, handle), (2, handle)):
            os.dup2(source, number)
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)  # noqa: SIM115
        faulthandler.enable(sys.stderr)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

        def send(**said: Any) -> None:
            os.write(pipe, (json.dumps(said) + "\n").encode())

        work(send)
        code = 0
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(BaseException):
            sys.stderr.flush()
        os._exit(code)


def _work(case: Case, target: Target, reference: dict[str, Any], send: Callable[..., None], only_spoil: bool) -> None:
    before = set(sys.modules)
    spoilt = target.spoil(case)
    send(told=case.told, checksums=case.checksums, formats=sorted(case.formats))
    if only_spoil:
        return
    _limit()
    began = _memory("VmRSS")
    answers: dict[str, Answer] = {}
    peak = 0
    for probe in target.probes(case, spoilt):
        send(probe=probe.name, cpu=time.process_time())
        try:
            answers[probe.name] = answer_of(probe.ask)
        except Fault as fault:
            send(fault=fault.kind, where=_plain(fault.detail, case), detail=fault.detail, probe=probe.name)
        except Exception as error:  # what the fuzzer is for
            send(fault=type(error).__name__, where=_where(error), detail=_told(error), probe=probe.name)
        grown = max(_memory("VmHWM") - began, _largest_helper())
        if grown > peak:
            peak = grown
            send(peak=peak, probe=probe.name)
    send(probe="", cpu=time.process_time())
    send(answers={name: asdict(answer) for name, answer in answers.items()})
    send(loaded=[name for name in sys.modules if name not in before])
    if peak > MEMORY:
        return
    for kind, detail in target.judge(case, spoilt, answers, reference):
        send(fault=kind, where=_plain(detail, case), detail=detail, probe="content")


def _plain(detail: str, case: Case) -> str:
    """What faults of a kind are told apart by: the words without paths and numbers."""
    words = detail.strip().splitlines()[-1].replace(str(case.folder), "")
    return re.sub(r"\d+", "#", words)[:110]


def _limit() -> None:
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # the high-water mark of memory begins anew
    resource.setrlimit(resource.RLIMIT_AS, (_memory("VmSize") + ADDRESSES,) * 2)
    now = int(time.process_time())
    faulthandler.register(signal.SIGXCPU, chain=True)
    resource.setrlimit(resource.RLIMIT_CPU, (now + CPU_S, now + CPU_S + 5))


def _memory(name: str) -> int:
    """A line of ``/proc/self/status`` in bytes."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) * 1024
    return 0


def _largest_helper() -> int:
    """The most memory of a process that was started and has ended [bytes]; 0 if that is no more than was ours.

    The system begins to count with what the process had that started it.
    """
    most = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    return most if most > _memory("VmHWM") else 0


def _where(error: BaseException) -> str:
    """The innermost line of dmbench that an exception came through: what faults are told apart by."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "/tests/" not in frame.filename]
    named = [
        frame
        for frame in ours
        if any(part in frame.filename for part in ("/dmotion_bench/", "/leaderboard/", "/baselines/"))
    ]
    frame = (named or ours or frames)[-1]
    return f"{'/'.join(Path(frame.filename).parts[-2:])}:{frame.lineno} {frame.name}"


def _told(error: BaseException) -> str:
    text = "".join(traceback.format_exception(error, limit=-12))
    return text if len(text) < 6000 else f"{text[:3000]}\n ... \n{text[-2500:]}"


def _wait(process: int, read: int) -> tuple[list[dict[str, Any]], int, resource.struct_rusage, bool]:
    """What the child said, how it ended, what it took, and whether it had to be ended by the clock."""
    said, deadline, hung = bytearray(), time.monotonic() + WALL_S, False
    while True:
        ready, _, _ = select.select([read], [], [], max(deadline - time.monotonic(), 0))
        if not ready:
            os.kill(process, signal.SIGKILL if hung else signal.SIGABRT)
            hung, deadline = True, time.monotonic() + 5
            continue
        piece = os.read(read, 1 << 16)
        if not piece:
            break
        said += piece
    os.close(read)
    _, status, usage = os.wait4(process, 0)
    lines = []
    for line in bytes(said).split(b"\n"):
        with contextlib.suppress(ValueError):
            lines.append(json.loads(line))
    return lines, status, usage, hung


def _result(
    case: Case, lines: list[dict[str, Any]], status: int, usage: resource.struct_rusage, hung: bool, stderr: str
) -> Result:
    result = Result(case.number, case.target, "", [], "ok", cpu_s=usage.ru_utime + usage.ru_stime)
    at = "spoiling"
    for line in lines:
        result.told = line.get("told", result.told)
        result.checksums = line.get("checksums", result.checksums)
        result.loaded = line.get("loaded", result.loaded)
        result.formats = line.get("formats", result.formats)
        at = line.get("probe", at) or "judging"
        if "fault" in line:
            result.faults.append({name: line[name] for name in ("fault", "where", "detail", "probe")})
        if "peak" in line:
            result.peak, result.greedy = line["peak"], line["probe"]
        if "answers" in line:
            result.answers = {name: Answer(**answer) for name, answer in line["answers"].items()}

    def add(kind: str, detail: str) -> None:
        result.faults.append({"fault": kind, "where": at, "detail": detail[-3000:], "probe": at})

    if result.peak > MEMORY:
        add("memory", f"{result.peak >> 20} MiB, in {result.greedy}")
    if hung:
        add("hang", stderr or f"nothing for {WALL_S} s")
    elif os.WIFSIGNALED(status):
        name = signal.Signals(os.WTERMSIG(status)).name
        add("hang" if name in ("SIGXCPU", "SIGKILL") else f"crash {name}", stderr)
    elif os.WEXITSTATUS(status) == FAILED:
        add("the fuzzer's own", stderr)
    elif os.WEXITSTATUS(status):
        add("exit", f"the process left with {os.WEXITSTATUS(status)}: {stderr}")
    elif "Traceback (most recent call last)" in stderr:
        add("traceback in the background", stderr)
    if result.faults:
        result.verdict = "fault"
    elif any(answer.sentence is not None for answer in result.answers.values()):
        result.verdict = "sentence"
    return result


def prepare_forking() -> None:
    """What is loaded now is left alone by the garbage collector, so that children share it."""
    gc.collect()
    gc.freeze()
