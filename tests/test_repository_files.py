"""Files that other programs read: the workflow, hooks, issue templates, the Dockerfile, the citation."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
FORMS = [path for path in sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")) if path.name != "config.yml"]
INPUTS = {"checkboxes", "dropdown", "input", "textarea"}


def _yaml(path: str) -> dict[str, Any]:
    content: dict[str, Any] = yaml.safe_load((ROOT / path).read_text())
    return content


def _declared() -> set[str]:
    before = "Programming Language :: Python :: "
    return {text.removeprefix(before) for text in PROJECT["classifiers"] if text.startswith(before)}


def _commands(target: str) -> list[str]:
    """The lines of one of the Makefile's targets, without the folder of the programs."""
    found = re.search(rf"^{target}:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert found, target
    return [line.strip().removeprefix("$(BIN)/") for line in found[1].splitlines()]


def test_the_workflow_runs_what_continuous_integration_runs_on_every_declared_python() -> None:
    workflow = _yaml(".github/workflows/test.yml")
    assert workflow[True].keys() == {"push", "pull_request"}  # YAML 1.1 reads 'on' as true
    assert workflow["permissions"] == {"contents": "read"}
    test, smoke = workflow["jobs"]["test"], workflow["jobs"]["smoke"]
    assert test["steps"][-1] == {"run": "bash .ci/run"}
    assert test["steps"][1]["with"]["python-version"].split()[-1] == "3.11"
    assert set(test["steps"][1]["with"]["python-version"].split()) == _declared()
    assert set(smoke["strategy"]["matrix"]["python-version"]) == _declared()
    assert smoke["steps"][-1]["run"].startswith("make smoke")
    assert _commands("smoke")


def test_a_commit_is_checked_by_the_commands_of_make_check() -> None:
    (repository,) = _yaml(".pre-commit-config.yaml")["repos"]
    entries = [
        hook["entry"].removeprefix(".venv/bin/").removesuffix(" --force-exclude") for hook in repository["hooks"]
    ]
    commands = _commands("rules") + _commands("types")
    assert sorted(re.sub(r" --check| \.$", "", line) for line in commands) == sorted(
        re.sub(r" \.$", "", entry) for entry in entries[:4]
    )
    for entry in entries[4:]:
        assert (ROOT / entry.split()[-1]).is_file()


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_an_issue_form_has_what_github_asks_for(path: Path) -> None:
    form = yaml.safe_load(path.read_text())
    assert {"name", "description", "body"} <= form.keys()
    asked = [part for part in form["body"] if part["type"] in INPUTS]
    assert asked
    assert all(part["attributes"]["label"] for part in asked)
    assert len({part["id"] for part in asked}) == len(asked)
    assert all(part["attributes"]["value"] for part in form["body"] if part["type"] == "markdown")
    assert {part["type"] for part in form["body"]} <= INPUTS | {"markdown"}


def test_files_of_the_image_exist_and_are_not_kept_from_it() -> None:
    allowed = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert all((ROOT / name).exists() for name in allowed)
    copied = re.findall(r"^COPY (?!--from)(\S+) ", (ROOT / "Dockerfile").read_text(), re.MULTILINE)
    assert set(copied) <= allowed | {"."}
    needed = {"dmotion_bench", "recorders", "baselines", "leaderboard", PROJECT["readme"], "pyproject.toml"}
    assert needed | {"hatch_build.py", "LICENSE"} <= allowed


def test_the_citation_has_what_the_format_asks_for() -> None:
    citation = _yaml("CITATION.cff")
    assert citation["cff-version"] == "1.2.0"
    assert {"message", "title", "authors"} <= citation.keys()
    assert citation["license"] == PROJECT["license"]["text"]
    assert PROJECT["description"] in citation["title"] or citation["title"].startswith(PROJECT["name"])
    for reference in citation["references"]:
        assert {"type", "title", "authors"} <= reference.keys()


def test_every_extra_is_documented() -> None:
    table = re.findall(r"^\| (`.+?`) \|", (ROOT / "docs" / "installation.md").read_text(), re.MULTILINE)
    assert sorted(re.findall(r"`([\w-]+)`", " ".join(table))) == sorted(PROJECT["optional-dependencies"])
