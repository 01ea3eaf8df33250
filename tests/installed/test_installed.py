"""The wheel in an empty environment: one package, what it declares is enough, and every command works."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from hatch_build import MOVED, moved
from tests.installed.building import ROOT, build, build_wheel
from tests.installed.environment import from_here
from tests.installed.road import IMPORT_EVERYTHING, RUN, dmbench, follow, run

pytestmark = pytest.mark.slow

COMPILE = """
import ast, importlib.util, sys, warnings
from pathlib import Path

warnings.simplefilter("error")
standard = set(sys.argv[1].split(","))
for path in sorted(path for folder in sys.argv[2:] for path in Path(folder).rglob("*.py")):
    tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
    compile(tree, str(path), "exec")
    for node in ast.walk(tree):
        names = [one.name for one in node.names] if isinstance(node, ast.Import) else []
        names += [node.module] if isinstance(node, ast.ImportFrom) and node.module and not node.level else []
        for name in names:
            if name.partition(".")[0] in standard and importlib.util.find_spec(name) is None:
                sys.exit(f"{path}, line {node.lineno}: this Python has no {name}")
print(*sys.version_info[:2], sep=".")
"""
"""Compiles the modules of folders, and looks for each module of the standard library that they import."""


def _declared() -> list[str]:
    """The versions of Python that the project says it runs on."""
    said = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["classifiers"]
    return [found[1] for text in said if (found := re.fullmatch(r"Programming Language :: Python :: (3\.\d+)", text))]


def _interpreter(version: str) -> str | None:
    """An interpreter of this version, on the path or of pyenv, if there is one."""
    of_pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    places = [*map(str, sorted(of_pyenv.glob(f"{version}.*/bin"))), os.environ["PATH"]]
    return shutil.which(f"python{version}", path=os.pathsep.join(places))


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return build(tmp_path_factory.mktemp("built"))


@pytest.fixture(scope="module")
def python(built: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment with the wheel, where others have packages of our folders' names."""
    installed = from_here(tmp_path_factory.mktemp("environment") / "env", built[1])
    (site,) = (installed.parents[1] / "lib").glob("python*/site-packages")
    for name in ("baselines", "recorders", "leaderboard"):
        (site / name).mkdir()
        (site / name / "__init__.py").write_text(f"raise ImportError('this {name} is somebody else\\'s')\n")
    return installed


def test_the_wheel_is_one_package_with_every_file_of_the_four_folders(built: tuple[Path, Path]) -> None:
    with zipfile.ZipFile(built[1]) as wheel:
        names = [name for name in wheel.namelist() if ".dist-info/" not in name]
    core = "dmotion_bench"
    listing = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "--", core, *MOVED]
    tracked = subprocess.run(listing, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    expected = {path if path.startswith(core) else f"{core}/{path}" for path in tracked.split()}
    assert set(names) == expected


def test_the_image_is_given_all_that_the_wheel_is_made_of(built: tuple[Path, Path], tmp_path: Path) -> None:
    source, folder = tmp_path / "source", tmp_path / "built"
    source.mkdir()
    for name in re.findall(r"^!(.+)$", (ROOT / ".dockerignore").read_text(), re.MULTILINE):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copyfile
        copy(ROOT / name, source / name)
    assert build_wheel(source, folder).read_bytes() == built[1].read_bytes()


def test_the_road_leads_from_an_empty_folder_to_a_leaderboard(python: Path, tmp_path: Path) -> None:
    follow(python, tmp_path)
    assert {"data.rrd", "run.rrd", "play.rrd", "plan.rrd"} <= {path.name for path in tmp_path.iterdir()}
    assert RUN in (tmp_path / "site" / "index.html").read_text()
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert dmbench(python, tmp_path, "--version").split()[-1] == version


def test_every_module_is_imported_beside_packages_of_the_same_names(python: Path, tmp_path: Path) -> None:
    assert int(run([str(python), "-c", IMPORT_EVERYTHING], tmp_path)) > 200


def test_an_import_is_moved_and_keeps_its_line() -> None:
    source = '"""Text of baselines.layers."""\n\nif True:\n    from baselines.layers import (\n        a,\n    )\n'
    assert moved(source, "a.py") == source.replace("from baselines", "from dmotion_bench.baselines")
    assert moved("from leaderboard import page\n", "a.py") == "from dmotion_bench.leaderboard import page\n"
    assert moved("from recorders_of_mine import a\n", "a.py") == "from recorders_of_mine import a\n"


def test_an_import_that_cannot_be_moved_stops_the_build() -> None:
    with pytest.raises(ValueError, match=r"baselines/x.py, line 2: write 'from"):
        moved("import ast\nimport baselines.layers\n", "baselines/x.py")


@pytest.mark.parametrize("version", sorted({*_declared()} - {".".join(map(str, sys.version_info[:2]))}))
def test_every_other_declared_version_of_python_compiles_the_sources(version: str) -> None:
    interpreter = _interpreter(version)
    if interpreter is None:
        pytest.skip(f"no Python {version} here")
    standard = ",".join(sys.stdlib_module_names)
    words = [interpreter, "-B", "-c", COMPILE, standard, "dmotion_bench", *MOVED]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, version), done.stderr


def test_pybullet_is_asked_for_only_where_there_is_a_wheel_of_it() -> None:
    said = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    (marker,) = [Requirement(text).marker for text in said if text.startswith("pybullet")]
    assert marker is not None
    there = {"python_version": "3.11", "sys_platform": "linux", "platform_machine": "x86_64"}
    assert marker.evaluate(there)
    for other in ({"python_version": "3.12"}, {"platform_machine": "aarch64"}, {"sys_platform": "darwin"}):
        assert not marker.evaluate(there | other)
