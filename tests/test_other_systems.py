"""Every module can be imported where Python has no fcntl, resource or termios, and fewer signals: on Windows."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

POSIX_ONLY = ["fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"]
"""What the documentation of Python's library marks as not available on Windows, as far as anybody might import it."""

IMPORT_ALL = """
import builtins, importlib, os, pkgutil, signal, sys

OURS = ("dmotion_bench", "recorders", "baselines", "leaderboard")
POSIX_ONLY = set(sys.argv[1:])

def modules():
    for package in OURS:
        yield package
        for found in pkgutil.walk_packages([package], f"{package}."):
            if not found.name.endswith("__main__"):
                yield found.name

def import_all():
    count = 0
    for name in modules():
        importlib.import_module(name)
        count += 1
    return count

import_all()  # with whatever other packages take from this system
for name in [name for name in sys.modules if name.partition(".")[0] in OURS]:
    del sys.modules[name]
before = builtins.__import__

def on_windows(name, globals=None, locals=None, fromlist=(), level=0):
    importer = (globals or {}).get("__name__", "")
    if name in POSIX_ONLY and importer.partition(".")[0] in OURS:
        raise ModuleNotFoundError(f"{importer} imports {name}")
    return before(name, globals, locals, fromlist, level)

builtins.__import__ = on_windows
there = {"SIGABRT", "SIGFPE", "SIGILL", "SIGINT", "SIGSEGV", "SIGTERM"}
for name in [name for name in vars(signal) if name.startswith(("SIG", "ITIMER")) and name not in there]:
    if not name.startswith("SIG_"):
        delattr(signal, name)
signal.Signals = [number for number in signal.Signals if number.name in there]
for name in ("killpg", "fork", "getuid", "geteuid", "sched_getaffinity", "setsid", "O_NONBLOCK", "O_CLOEXEC"):
    delattr(os, name)
print(import_all())
"""


@pytest.mark.slow
def test_every_module_is_imported_without_what_windows_lacks() -> None:
    ended = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL, *POSIX_ONLY], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
    assert int(ended.stdout) > 200
