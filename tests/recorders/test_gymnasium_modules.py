"""Which modules the name of a Gymnasium environment may have imported, and what is said where that goes wrong."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

from dmotion_bench.errors import UsageError
from recorders.gymnasium_env import modules
from recorders.gymnasium_env.guest import unmade


def install(site: Path, package: str, needs: str, link: str) -> None:
    """What ``pip install -e`` leaves of a package of hatchling: metadata, and a file that names a folder."""
    about = f"{package}-1.0.dist-info"
    (site / about).mkdir(parents=True)
    (site / about / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\nRequires-Dist: {needs}\n"
    )
    (site / about / "RECORD").write_text(f"_{package}.pth,,\n{about}/METADATA,,\n{about}/RECORD,,\n")
    (site / about / "direct_url.json").write_text('{"dir_info": {"editable": true}, "url": "file:///somewhere"}')
    (site / f"_{package}.pth").write_text(f"# a link\nimport sys\n{link}\n")


@pytest.fixture
def linked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(modules, "packages_distributions", dict)  # it knows nothing of these, and takes seconds
    site = tmp_path / "site-packages"
    for package, needs in (("windy", "gymnasium>=1"), ("plain", "numpy")):
        (tmp_path / package / f"{package}_worlds").mkdir(parents=True)
        (tmp_path / package / f"{package}_worlds" / "__init__.py").write_text("HERE = True\n")
        install(site, package, needs, str(tmp_path / package) if package == "plain" else f"../{package}")
        monkeypatch.syspath_prepend(tmp_path / package)
    monkeypatch.syspath_prepend(site)
    importlib.invalidate_caches()
    return tmp_path


def test_a_module_of_a_package_that_is_installed_by_a_link_is_imported(linked: Path) -> None:
    assert modules.owners_of("windy_worlds.later", "gym:windy_worlds.later:A-v0") == ("windy",)
    assert modules.import_named("windy_worlds", "gym:windy_worlds:A-v0").HERE


def test_one_of_a_package_that_does_not_depend_on_gymnasium_is_not(linked: Path) -> None:
    with pytest.raises(UsageError, match=r"'plain_worlds', which .* is of the package 'plain', which does not"):
        modules.import_named("plain_worlds", "gym:plain_worlds:A-v0")
    for nowhere in ("windy_world", ""):
        with pytest.raises(UsageError, match="is in no installed package"):
            modules.import_named(nowhere, "gym:A-v0")


@pytest.mark.parametrize(
    ("said", "screenless"),
    [
        ("the mass is negligible", False),
        ("a wind was neglected", False),
        ("Cannot initialize a EGL device display", True),
        ("'NoneType' object has no attribute 'eglQueryString'", True),
        ("invalid value for environment variable MUJOCO_GL: egl", True),
        ("an OpenGL platform library has not been loaded", True),
        ("X11: The DISPLAY environment variable is missing", True),
    ],
)
def test_only_what_speaks_of_a_screen_is_taken_for_a_screen_that_lacks(said: str, screenless: bool) -> None:
    assert ("without a screen" in str(unmade("gym:A-v0", RuntimeError(said)))) == screenless
