"""Rerun's programs: what they listen on, and what is said when they cannot start."""

from __future__ import annotations

import contextlib
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import rerun as rr
import rerun.blueprint as rrb
from browser import CHROMIUM, browsing

from dmotion_bench.errors import ViewerError
from dmotion_bench.interrupts import ended_like_ctrl_c
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing import viewer as programs
from dmotion_bench.viewing.dataset import dataset_scene
from dmotion_bench.viewing.live import recording_to
from dmotion_bench.viewing.page_server import PAGE
from dmotion_bench.viewing.scene import write_scene
from dmotion_bench.viewing.screenshot import BAR, camera, has_vulkan
from dmotion_bench.viewing.screenshot import main as take_picture
from dmotion_bench.viewing.viewer import WebViewer, open_live, require_display, serve_web


def listening(process: psutil.Process) -> set[str]:
    """The addresses that a process and its children listen on."""
    found: set[str] = set()
    for one in (process, *process.children(recursive=True)):
        with contextlib.suppress(psutil.NoSuchProcess):
            found |= {link.laddr.ip for link in one.net_connections("inet") if link.status == psutil.CONN_LISTEN}
    return found


def is_open(port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(1)
        return probe.connect_ex(("127.0.0.1", port)) == 0


def fetch(url: str, **headers: str) -> tuple[int, bytes, dict[str, str]]:
    """Status, content and headers."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=30) as answer:
            return answer.status, answer.read(), dict(answer.headers)
    except urllib.error.HTTPError as error:
        with error:
            return error.code, b"", dict(error.headers)


@pytest.fixture(scope="module")
def scene(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("viewer") / "scene.rrd"
    write_scene(dataset_scene(dataset, [0]), path)
    return path


@pytest.fixture(scope="module")
def web(scene: Path) -> Iterator[WebViewer]:
    with serve_web(scene) as viewer:
        yield viewer


def test_page_and_data_are_for_this_machine_alone(web: WebViewer) -> None:
    assert listening(psutil.Process(web.process.pid)) == {"127.0.0.1"}
    assert listening(psutil.Process()) <= {"127.0.0.1"}
    assert is_open(web.port)


def test_the_page_is_reruns_and_finds_the_data(web: WebViewer, scene: Path) -> None:
    status, page, headers = fetch(web.url)
    assert (status, headers["Content-Type"]) == (200, "text/html")
    assert b"rerun" in page.lower()
    (data,) = urllib.parse.parse_qs(urllib.parse.urlparse(web.url).query)["url"]
    assert data.startswith(f"http://127.0.0.1:{web.port}/")  # of the same origin
    assert fetch(data)[:2] == (200, scene.read_bytes())


def test_a_browser_is_told_to_let_the_page_talk_to_this_machine_alone(web: WebViewer) -> None:
    base = f"http://127.0.0.1:{web.port}"
    for path in PAGE:
        rules = dict(rule.split(" ", 1) for rule in fetch(base + path)[2]["Content-Security-Policy"].split("; "))
        assert (rules["default-src"], rules["connect-src"]) == ("'none'", "'self'")
        assert not [word for rule in rules.values() for word in rule.split() if "." in word or "*" in word]
    assert re.search(rb"<link[^>]*//", fetch(base)[1]) is None  # nor does the browser look up fonts beforehand
    assert fetch(f"{base}/re_viewer_bg.wasm")[2]["Content-Type"] == "application/wasm"  # else it is no program


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (apt install chromium)")
def test_in_a_browser_the_page_loads_the_data_and_asks_no_other_machine(web: WebViewer, tmp_path: Path) -> None:
    with browsing(tmp_path) as browser:
        browser.call("Page.navigate", url=web.url)
        end = time.monotonic() + 60
        while not any(urllib.parse.urlparse(address).path == "/scene.rrd" for address in browser.requests):
            assert time.monotonic() < end, browser.complaints
            browser.ask("1")
            time.sleep(0.1)
        hosts = {urllib.parse.urlparse(address).netloc for address in browser.requests}
    assert hosts == {f"127.0.0.1:{web.port}"}


def _can_trace() -> bool:
    """Whether system calls can be watched: some containers forbid it."""
    strace = shutil.which("strace")
    return (
        strace is not None and subprocess.run([strace, "-o", "/dev/null", "true"], capture_output=True).returncode == 0
    )


@pytest.mark.skipif(not _can_trace(), reason="no strace is installed (apt install strace), or it is forbidden")
def test_rerun_itself_asks_no_other_machine(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither for a newer version nor with statistics of its use."""
    trace, real = tmp_path / "trace", subprocess.Popen
    calls = ["strace", "-f", "-e", "trace=connect,sendto,sendmmsg", "-o", str(trace)]
    monkeypatch.setenv("ALL_PROXY", "http://10.1.2.3:80")
    monkeypatch.setattr(subprocess, "Popen", lambda command, **options: real([*calls, *command], **options))
    with serve_web(scene) as viewer:
        fetch(viewer.url)
        time.sleep(1)
    addresses = set(re.findall(r'inet_addr\("([^"]*)"\)', trace.read_text()))
    assert addresses <= {"127.0.0.1"}


def test_it_all_ends_with_the_block(scene: Path) -> None:
    with serve_web(scene) as viewer:
        processes = [psutil.Process(viewer.process.pid)]
        processes += processes[0].children(recursive=True)
    psutil.wait_procs(processes, timeout=60)
    assert not any(process.is_running() and process.status() != psutil.STATUS_ZOMBIE for process in processes)
    assert not is_open(viewer.port)


def test_ports_that_another_program_has_or_takes_meanwhile_are_left_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other, socket.create_server(("127.0.0.1", 0)) as another:
        taken, page = other.getsockname()[1], another.getsockname()[1]
        real = programs._free_port
        monkeypatch.setattr(programs, "_free_port", lambda wanted: taken if wanted == 12 else real(wanted))
        monkeypatch.setattr(programs, "LIVE_PORT", 12)
        monkeypatch.setattr(programs, "WEB_PORT", page)
        with open_live(web=True) as viewer:
            assert not {taken, page} & set(viewer.ports)
            assert viewer.page is not None
            assert fetch(viewer.page)[0] == 200


def test_what_ignores_a_request_to_end_is_ended(tmp_path: Path) -> None:
    stubborn = "import os, signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); time.sleep(60)"
    launcher = (
        f"import subprocess, sys; child = subprocess.Popen([sys.executable, '-c', {stubborn!r}]); "
        f"open({str(tmp_path / 'pid')!r}, 'w').write(str(child.pid)); child.wait()"
    )
    process = subprocess.Popen([sys.executable, "-c", launcher], start_new_session=True)
    end = time.monotonic() + 30
    while not (tmp_path / "pid").exists() or not (tmp_path / "pid").read_text():
        assert time.monotonic() < end
        time.sleep(0.01)
    child = psutil.Process(int((tmp_path / "pid").read_text()))
    time.sleep(0.3)  # until it ignores the signal
    programs._end(process)
    psutil.wait_procs([child], timeout=30)
    assert not child.is_running() or child.status() == psutil.STATUS_ZOMBIE


@pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="this system has no signals to threads")
def test_a_signal_ends_the_waiting_whatever_thread_receives_it() -> None:
    """A page is served by threads, and one that comes right before the system call wakes it no more than this one."""
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    missed = threading.Timer(20, process.kill)
    aside = threading.Timer(0.5, lambda: signal.pthread_kill(threading.get_ident(), signal.SIGTERM))
    missed.start()
    try:
        with ended_like_ctrl_c():
            aside.start()
            with pytest.raises(KeyboardInterrupt):
                programs.wait_for(process)
        assert process.poll() is None, "it was noticed only when the program had ended"
    finally:
        missed.cancel()
        process.kill()
        process.wait()


def test_a_live_viewer_is_for_this_machine_alone_and_may_end_before_the_work() -> None:
    with open_live(web=True) as viewer:
        assert listening(psutil.Process(viewer.process.pid)) == {"127.0.0.1"}
        assert viewer.page is not None
        status, _, headers = fetch(viewer.page)
        assert status == 200
        assert f"http://127.0.0.1:{viewer.ports[0]} " in headers["Content-Security-Policy"]
        with recording_to("work", rrb.Blueprint(), address=viewer.address) as recording:
            recording.log("a", rr.Scalars([1.0]))
            recording.flush(timeout_sec=30)
            programs._end(viewer.process)
            for value in range(10):
                recording.log("a", rr.Scalars([float(value)]))


def test_the_server_gives_the_page_and_the_scene_and_nothing_else(web: WebViewer, scene: Path) -> None:
    for path in ("/scene.rrd/..", f"/{scene}", "/../../etc/passwd", "/%2e%2e/scene.rrd", "/sw.js"):
        assert fetch(f"http://127.0.0.1:{web.port}{path}")[0] == 404


def test_other_pages_and_other_names_may_not_read_it(web: WebViewer) -> None:
    for path in ("/", "/scene.rrd"):
        url = f"http://127.0.0.1:{web.port}{path}"
        for origin in ("http://evil.example", "http://127.0.0.1:1", "null"):
            assert "Access-Control-Allow-Origin" not in fetch(url, Origin=origin)[2]
        assert fetch(url, Host=f"evil.example:{web.port}")[0] == 404  # a name that was bent to this address


def test_without_a_display_the_other_ways_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ViewerError, match=r"--web.*--save FILE.rrd"):
        require_display()
    monkeypatch.setenv("DISPLAY", ":0")
    require_display()


def test_a_program_that_does_not_start_says_why(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = subprocess.Popen

    def broken(_command: list[str], **options: object) -> subprocess.Popen[bytes]:
        return real([sys.executable, "-c", "raise SystemExit('no such thing')"], **options)  # type: ignore[call-overload]

    monkeypatch.setattr(subprocess, "Popen", broken)
    with pytest.raises(ViewerError, match="no such thing"), serve_web(scene):
        pass


@pytest.mark.slow
def test_a_picture_that_cannot_be_taken_costs_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["screenshot", "missing.rrd", "picture.png"])
    with pytest.raises(SystemExit, match=r"^dmbench: no file 'missing\.rrd' to take a picture of\.$"):
        take_picture()


@pytest.mark.skipif(not has_vulkan(), reason="no Vulkan driver: 'apt-get install mesa-vulkan-drivers'")
def test_rerun_draws_the_scene(scene: Path, tmp_path: Path) -> None:
    """The red and the blue square of the first page are seen in their own colours."""
    from PIL import Image

    picture = tmp_path / "picture.png"
    with camera(scene, 640, 400, settle=0) as viewer:
        viewer.take(picture, frame=1)
        with pytest.raises(ViewerError, match="no tab named 'Episode 7'; there are: Episode 0"):
            viewer.tab("Episode 7")
    with Image.open(picture) as opened:
        assert opened.size == (640, 400 - BAR)
        colors = {color: count for count, color in opened.convert("RGB").getcolors(640 * 400) or []}
    for thing in ((230, 30, 30), (40, 80, 255)):
        assert colors.get(thing, 0) > 100
