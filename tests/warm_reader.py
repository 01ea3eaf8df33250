"""Readers of recordings that are forked off one that has loaded everything.

An import starts a process that reads (``confinement.py``), and most imports of the tests take less time than that
process takes to start. Here it begins with what ``python -m dmotion_bench.storage.imports.confined_reader`` loads, and
with the libraries that recordings of each kind need. Processes that the tests start, and their workers, start theirs as
always.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import signal
import socket
import subprocess
import tempfile
from pathlib import Path
from typing import Final

from dmotion_bench.storage.imports.confinement import READER, Confinement
from dmotion_bench.storage.imports.options import ImportOptions

SERVER: Final = """
import os, socket, sys
import av, h5py, pyarrow.compute, pyarrow.parquet
from dmotion_bench.storage.imports.confined_reader import main
from dmotion_bench.storage.imports.sources import open_here

def read(pipes, folder):
    door.close()
    os.chdir(folder)
    for place, pipe in enumerate(pipes):
        os.dup2(pipe, place)
        os.close(pipe)
    main(open_here)

door = socket.socket(socket.AF_UNIX)
door.connect(sys.argv[1])
while True:
    told, pipes, *_ = socket.recv_fds(door, 4096, 2)
    if not told:
        break
    if pipes:
        answer = os.fork()
        if not answer:
            code = 1
            try:
                read(pipes, told)
                code = 0
            finally:
                os._exit(code)
        for pipe in pipes:
            os.close(pipe)
    else:
        answer = os.waitstatus_to_exitcode(os.waitpid(int.from_bytes(told), 0)[1])
    door.send(answer.to_bytes(8, signed=True))
"""
"""Given two pipes and a folder it forks a reader there and tells its number; given a number, how that reader ended."""

SERVERS: Final = set[int]()
"""Numbers of the processes that fork readers."""

start_cold = Confinement._start


class WarmReader:
    """What an import uses of a ``Popen``."""

    def __init__(self, door: socket.socket) -> None:
        requests, to_reader = os.pipe()
        from_reader, answers = os.pipe()
        socket.send_fds(door, [os.fsencode(Path.cwd())], [requests, answers])
        for pipe in (requests, answers):
            os.close(pipe)
        self.pid = int.from_bytes(door.recv(8), signed=True)
        self.stdin, self.stdout = os.fdopen(to_reader, "wb"), os.fdopen(from_reader, "rb")
        self.returncode: int | None = None
        self._door = door

    def kill(self) -> None:
        if self.returncode is None:
            os.kill(self.pid, signal.SIGKILL)

    def wait(self) -> int:
        if self.returncode is None:
            self._door.send(self.pid.to_bytes(8))
            self.returncode = int.from_bytes(self._door.recv(8), signed=True)
        return self.returncode


def start(confinement: Confinement, path: Path) -> subprocess.Popen[bytes] | WarmReader:
    """In place of ``Confinement._start``; other commands than the usual one are started."""
    if confinement._command is not READER:
        return start_cold(confinement, path)
    return WarmReader(_door(os.getpid()))


@functools.cache
def _door(_process: int) -> socket.socket:
    """The way to the server of this process: one that was forked off it has its own."""
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as entrance:
        place = f"{folder}/door"
        entrance.bind(place)
        entrance.listen()
        entrance.settimeout(60)
        server = start_cold(Confinement(ImportOptions(), (*READER[:3], "-c", SERVER, place)), Path(place))
        door, _ = entrance.accept()
    door.settimeout(None)
    SERVERS.add(server.pid)
    atexit.register(_close, door, server)
    return door


def _close(door: socket.socket, server: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(OSError):
        door.close()
    server.communicate()
