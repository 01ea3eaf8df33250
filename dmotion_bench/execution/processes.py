"""Several processes that train one model together: who is who, and how they are started and ended together.

``torchrun``, or ``--devices N --nodes M`` by the same part of torch (torch.distributed.elastic), starts the processes
and tells each its place in environment variables. Where one process ends too early, all of them end.
"""

from __future__ import annotations

import errno
import logging
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from multiprocessing import connection
from typing import Any, Final, NoReturn

from dmotion_bench.errors import RunError, UsageError
from dmotion_bench.interrupts import ENDING, interrupted_by
from dmotion_bench.wording import shown

LED: Final = "DMBENCH_LED"
"""Set in processes that ``lead`` has started: it, and not they, says that one of them was lost or interrupted."""
LOST: Final = 75
"""The exit code of a led process that lost the others (EX_TEMPFAIL of sysexits.h)."""
GRACE: Final = 30
"""Seconds that a process has to write its checkpoint after it was asked to end."""
INTERRUPTIONS: Final = frozenset(128 + number for number in (signal.SIGINT, *ENDING))
NO_ROOM: Final = (errno.ENOMEM, errno.EAGAIN)
"""Error numbers of a system that starts no more processes, for want of memory or by a limit."""
_LOOK_AGAIN: Final = 0.5  # [s]
_MAIN: Final = "from dmotion_bench.cli import main; main()"
_AGAIN: Final = "Run the same command again: it goes on from the last checkpoint."


@dataclass(frozen=True, kw_only=True)
class Place:
    """The place of this process among those that train together.

    Attributes:
        rank: Its number; the process of number 0 writes the files.
        world: How many there are on all machines.
        local_rank, local_world: The same among those of this machine.
    """

    rank: int = 0
    world: int = 1
    local_rank: int = 0
    local_world: int = 1

    @property
    def nodes(self) -> int:
        """How many machines."""
        return self.world // self.local_world


def place(environment: Mapping[str, str] = os.environ) -> Place:
    """The place that ``torchrun`` told this process; alone if it told none.

    Raises:
        UsageError: What it told cannot be.
    """
    names = {"rank": "RANK", "world": "WORLD_SIZE", "local_rank": "LOCAL_RANK", "local_world": "LOCAL_WORLD_SIZE"}
    if "WORLD_SIZE" not in environment:
        return Place()
    given = {field: environment.get(name, "") for field, name in names.items()}
    told = ", ".join(f"{names[field]}={shown(text)}" for field, text in given.items())
    if all(text.isascii() and text.isdecimal() and len(text) < 10 for text in given.values()):
        found = Place(**{field: int(text) for field, text in given.items()})
        ranks = 0 <= found.rank < found.world and 0 <= found.local_rank < found.local_world
        if ranks and found.world % found.local_world == 0:
            return found
    raise UsageError(
        f"the environment says that this is one of several processes, and not which: {told}. Start them with "
        "'--devices N --nodes M' or with torchrun, as many on each machine; or unset WORLD_SIZE for a single process."
    )


def is_led() -> bool:
    """Whether ``lead`` has started this process."""
    return os.environ.get(LED) not in (None, str(os.getpid()))


def end_with(parent: int, sentinel: int | None = None) -> None:
    """End this process when its parent is gone: a killed parent cannot say so itself.

    Args:
        parent: The number of its process.
        sentinel: Of another process that it is not to outlive either (``multiprocessing``'s ``Process.sentinel``).
    """
    watched = [] if sentinel is None else [sentinel]

    def watch() -> None:
        while os.getppid() == parent and not connection.wait(watched, _LOOK_AGAIN):
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def lead(words: Sequence[str], devices: int, nodes: int) -> None:
    """Run a command of ``dmbench`` in several processes, and wait for their end.

    Of several machines, each runs this; the variables MASTER_ADDR, MASTER_PORT and NODE_RANK say where the first one
    can be reached, and which this is.

    Args:
        words: The command's arguments.
        devices: Processes of this machine.
        nodes: Machines.

    Raises:
        UsageError: The variables of several machines are not set.
        RunError: A process was killed, or lost those of another machine.
        KeyboardInterrupt: After all have written what they have to.
        SystemExit: A process failed and has said why.
    """
    from torch.distributed.elastic.multiprocessing import DefaultLogsSpecs, SignalException
    from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
    from torch.distributed.launcher.api import LaunchConfig, elastic_launch

    for name in logging.root.manager.loggerDict:
        if name.startswith("torch.distributed.elastic"):  # each has a level of its own
            logging.getLogger(name).setLevel(logging.CRITICAL)
    if nodes == 1:
        meeting: dict[str, Any] = {"rdzv_backend": "c10d", "rdzv_endpoint": "localhost:0", "local_addr": "localhost"}
        if sys.platform == "linux":
            os.environ.setdefault("GLOO_SOCKET_IFNAME", "lo")  # nobody outside need reach them
        ranks: dict[str, Any] = {}
    else:
        address, port, rank = _meeting_of_machines(nodes)
        meeting, ranks = {"rdzv_backend": "static", "rdzv_endpoint": f"{address}:{port}"}, {"rank": rank}
    os.environ[LED] = str(os.getpid())
    with tempfile.TemporaryDirectory(prefix="dmbench-processes-") as folder:
        config = LaunchConfig(
            min_nodes=nodes,
            max_nodes=nodes,
            nproc_per_node=devices,
            run_id="dmbench",
            max_restarts=0,
            rdzv_configs=ranks,
            logs_specs=DefaultLogsSpecs(log_dir=folder),
            shutdown_timeout=GRACE,
            **meeting,
        )
        try:
            elastic_launch(config, sys.executable)("-c", _MAIN, *words)
        except SignalException as error:
            raise interrupted_by(error.sigval) from None
        except ChildFailedError as error:
            codes = {rank: failure.exitcode for rank, failure in error.failures.items()}
            _say_why(codes, devices * nodes)


def _meeting_of_machines(nodes: int) -> tuple[str, int, int]:
    """Where the first machine is reached, and the number of this one."""
    names = ("MASTER_ADDR", "MASTER_PORT", "NODE_RANK")
    if missing := [name for name in names if not os.environ.get(name)]:
        raise UsageError(
            f"--nodes {nodes} needs the variables {', '.join(names)} on every machine (the address of the first one, a "
            f"free port of it, and the machine's own number from 0); missing here: {', '.join(missing)}."
        )
    address, port, rank = (os.environ[name] for name in names)
    if not (port.isdecimal() and 0 < int(port) < 2**16):
        raise UsageError(f"MASTER_PORT is {shown(port)}; it can be 1 to 65535.")
    if not (rank.isdecimal() and int(rank) < nodes):
        raise UsageError(f"NODE_RANK is {shown(rank)}; with --nodes {nodes} it can be 0 to {nodes - 1}.")
    return address, int(port), int(rank)


def _say_why(codes: Mapping[int, int], world: int) -> NoReturn:
    """Raise what the exit codes of the processes that failed tell; SIGTERM came to those that were still there."""
    if told := [code for code in codes.values() if code > 0 and code not in {LOST, *INTERRUPTIONS}]:
        raise SystemExit(min(told))
    if killed := {rank: -code for rank, code in codes.items() if code < 0 and code != -signal.SIGTERM}:
        rank, number = min(killed.items())
        name = signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"
        raise RunError(
            f"process {rank} of the {world} that train together was killed ({name}), perhaps for want of memory, and "
            f"all others were ended. {_AGAIN}"
        )
    if signals := [code - 128 for code in codes.values() if code in INTERRUPTIONS]:
        raise interrupted_by(signals[0])
    raise RunError(f"a process on another machine has ended, and all {world} that train together with it. {_AGAIN}")
