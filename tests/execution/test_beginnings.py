"""The server that worker processes are forks of leaves Ctrl-C to the command, and tells of no process that is late."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from dmbench_command import finish, start_dmbench

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere no server is started")

_LATE = """
import os
from multiprocessing import forkserver
from dmotion_bench.execution.local_executor import _context

_context(len)
told, tell = forkserver.connect_to_new_process([])
os.write(tell, {beginning!r})
os.close(tell)
forkserver.read_signed(told)  # its number
print(forkserver.read_signed(told))  # its exit code
"""
"""A process that is asked for, and whose command ends before it has said what is to be done."""


@pytest.mark.parametrize("beginning", [b"", b"\x80\x04\x95\x20"], ids=["nothing", "a part"])
def test_a_process_that_nobody_tells_what_to_do_says_nothing(beginning: bytes) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _LATE.format(beginning=beginning)], capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "1\n", "")


_HALF_ASKED = """
import socket
import time
import psutil
from multiprocessing import forkserver
from dmotion_bench.execution.local_executor import _context

context = _context(len)
server = psutil.Process(forkserver._forkserver._forkserver_pid)
with socket.socket(socket.AF_UNIX) as client:
    client.connect(forkserver._forkserver._forkserver_address)
until = time.monotonic() + 60
while server.status() != psutil.STATUS_ZOMBIE and time.monotonic() < until:
    time.sleep(0.01)
process = context.Process(target=int)  # as a program would that goes on
process.start()
process.join()
print(process.exitcode)
"""
"""A command that is interrupted between its call to the server and what it asks for."""


def test_a_server_that_is_called_and_asked_for_nothing_says_nothing() -> None:
    done = subprocess.run([sys.executable, "-c", _HALF_ASKED], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "0\n", "")


_OTHERS = """
import signal
from multiprocessing import get_context
from dmotion_bench.execution.local_executor import _context

_context(len)
process = get_context("forkserver").Process(target=signal.raise_signal, args=(signal.SIGINT,))
process.start()
process.join()
print(process.exitcode)
"""
"""Another library's process, which the same server starts."""


def test_processes_of_others_heed_ctrl_c() -> None:
    done = subprocess.run([sys.executable, "-c", _OTHERS], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, "1\n"), done.stderr
    assert "KeyboardInterrupt" in done.stderr


@pytest.mark.slow
def test_ctrl_c_in_a_terminal_while_the_server_loads_is_one_sentence(tmp_path: Path) -> None:
    """A terminal sends it to the command and to all that it has started."""
    (tmp_path / "none.json").write_text("{")
    words = ("leaderboard", "check", str(tmp_path), "--workers", "2")
    process = start_dmbench(words, tmp_path, start_new_session=True)
    deadline = time.monotonic() + 60
    while not (servers := _servers(process)):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.005)
    os.killpg(process.pid, signal.SIGINT)
    outcome = finish(process)
    assert outcome.code == 130
    assert "interrupted after 0 of 1 entries" in outcome.sentence()
    assert not psutil.wait_procs(servers, timeout=120)[1]  # it loads to its end


def _servers(process: subprocess.Popen[str]) -> list[psutil.Process]:
    """The server of the command, when it loads numpy, torch and what the jobs need, which takes seconds."""
    children = psutil.Process(process.pid).children()
    servers = [child for child in children if any("forkserver" in word for word in child.cmdline())]
    return [server for server in servers if server.memory_info().rss > 32 * 2**20]
