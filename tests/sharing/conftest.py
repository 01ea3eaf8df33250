"""A workspace with a data set of noise and a run that was scored, and three kinds of places to publish them in."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from known_model import write_run
from noise_world import write_noise
from object_storage import Storage, object_storage

from dmotion_bench.storage import object_store
from dmotion_bench.workspace import Workspace


@dataclass
class Published:
    """A place, and what a test may do to the files in it.

    Attributes:
        address: As it is given to commands.
        files: Lists every file by its path below the place, with its content.
        put: Replaces a file.
        delete: Deletes one.
    """

    address: str
    files: Callable[[], dict[str, bytes]]
    put: Callable[[str, bytes], None]
    delete: Callable[[str], None]


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """Not to be changed."""
    workspace = Workspace(tmp_path_factory.mktemp("made"))
    dataset = write_noise(workspace.data / "noise")
    run = write_run(workspace.runs / "known", dataset, offset=0.25)
    run.metrics.write_text('{"step": 1}\n')
    (run.path / "report").mkdir()
    (run.path / "report" / "report.json").write_text(json.dumps({"run": "known"}))
    (run.path / "report" / "samples.parquet").write_bytes(b"samples of its steps")
    (run.path / "last.safetensors").write_bytes(b"nobody needs this")
    return workspace


@pytest.fixture
def workspace(made: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    """A copy to spoil, the current one."""
    copied = Workspace(tmp_path / "workspace")
    shutil.copytree(made.root, copied.root)
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(copied.root))
    return copied


@pytest.fixture
def outsider(tmp_path: Path) -> Workspace:
    """Empty."""
    (tmp_path / "outsider").mkdir()
    return Workspace(tmp_path / "outsider")


@pytest.fixture(scope="session")
def server() -> Iterator[Storage]:
    with object_storage() as storage:
        yield storage


@pytest.fixture
def storage(server: Storage, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Storage:
    """The S3 server, as ``as_found`` says."""
    return server.as_found(monkeypatch, request.node.name, patience_s=10.0)


@pytest.fixture
def folder(tmp_path: Path) -> Published:
    """A folder."""
    return _folder(tmp_path / "place", str(tmp_path / "place"))


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Published:
    """What answers to ``hf://`` is a file system of fsspec over a folder, as there is no network."""
    from fsspec.implementations.local import LocalFileSystem

    root = tmp_path / "hub"

    class Hub(LocalFileSystem):  # type: ignore[misc]
        protocol = "hf"
        cachable = False

        @classmethod
        def _strip_protocol(cls, path: str) -> str:
            return str(root / path.removeprefix("hf://")) if path.startswith("hf://") else path

    import fsspec.registry  # noqa: F401 (there now, and to be changed)

    monkeypatch.setitem(sys.modules["fsspec.registry"]._registry, "hf", Hub)
    monkeypatch.setattr(object_store, "PAUSES", (0.001,))
    monkeypatch.setattr(object_store, "_OPTIONS", {"hf": lambda: {"auto_mkdir": True}})
    return _folder(root / "datasets/who/what", "hf://datasets/who/what")


@pytest.fixture
def bucket(storage: Storage) -> Published:
    """An S3 bucket."""
    from s3fs import S3FileSystem

    def files() -> dict[str, bytes]:
        system = S3FileSystem(endpoint_url=storage.environment["AWS_ENDPOINT_URL"], skip_instance_cache=True)
        root = storage.address.removeprefix("s3://")
        return {name.removeprefix(f"{root}/"): system.cat_file(name) for name in system.find(root)}

    def put(name: str, content: bytes) -> None:
        system = S3FileSystem(endpoint_url=storage.environment["AWS_ENDPOINT_URL"], skip_instance_cache=True)
        system.pipe_file(f"{storage.address}/{name}", content)

    def delete(name: str) -> None:
        system = S3FileSystem(endpoint_url=storage.environment["AWS_ENDPOINT_URL"], skip_instance_cache=True)
        system.rm_file(f"{storage.address}/{name}")

    return Published(storage.address, files, put, delete)


@pytest.fixture(params=["folder", pytest.param("bucket", marks=pytest.mark.slow), "hub"])
def place(request: pytest.FixtureRequest) -> Published:
    """Each kind of place in turn."""
    found: Published = request.getfixturevalue(request.param)
    return found


def _folder(path: Path, address: str) -> Published:
    def files() -> dict[str, bytes]:
        return {one.relative_to(path).as_posix(): one.read_bytes() for one in path.rglob("*") if one.is_file()}

    def put(name: str, content: bytes) -> None:
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content)

    return Published(address, files, put, lambda name: (path / name).unlink())


@pytest.fixture(autouse=True)
def _no_leftovers(tmp_path: Path) -> Iterator[None]:
    yield
    assert not list(tmp_path.rglob("*.part"))
