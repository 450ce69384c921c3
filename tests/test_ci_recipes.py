"""The recipes for CI servers, run as the scripts that they are."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from mclass.batch.record import entry_line, read_results, results_text

ROOT = Path(__file__).parent.parent
RECIPES = ROOT / "configs" / "ci"


def github_steps() -> list[str]:
    recipe = yaml.safe_load((RECIPES / "github-actions.yml").read_text())
    return [step["run"] for step in recipe["jobs"]["logs"]["steps"] if "run" in step]


def gitlab_steps() -> list[str]:
    recipe: dict[str, Any] = yaml.safe_load((RECIPES / "gitlab-ci.yml").read_text())
    return list(recipe["logs"]["script"])


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """What the recipes expect around them; installing is noted, not done."""
    (tmp_path / "logs").mkdir()
    shutil.copy(ROOT / "sample_logs" / "cas_lab.mcap", tmp_path / "logs" / "one.mcap")
    model = (ROOT / "configs" / "cas_lab.yaml").read_text()
    (tmp_path / "boxes.yaml").write_text(model)
    (tmp_path / "baseline.json").write_text(results_text([]))
    tools = tmp_path / "tools"
    tools.mkdir()
    for name, script in (
        ("pip", 'echo "$@" >> installed.txt'),
        ("mclass", f'exec {sys.executable} -c "from mclass.commands.cli import main; main()" "$@"'),
    ):
        (tools / name).write_text(f"#!/bin/sh\n{script}\n")
        (tools / name).chmod(0o755)
    return tmp_path


def run(steps: list[str], repository: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PATH": f"{repository / 'tools'}:{os.environ['PATH']}"}
    return subprocess.run(
        ["bash", "-e", "-o", "pipefail", "-c", "\n".join(steps)],
        cwd=repository,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
@pytest.mark.parametrize("steps", [github_steps(), gitlab_steps()], ids=["github", "gitlab"])
def test_recipe_passes_and_fails_when_results_get_worse(steps: list[str], repository: Path) -> None:
    done = run(steps, repository)
    assert done.returncode == 0, done.stderr
    assert (repository / "installed.txt").read_text() == "install ./mclass\n"
    (entry,) = read_results(repository / "results" / "results.json")
    suite = ElementTree.parse(repository / "results.xml").getroot()[0]
    assert suite.get("tests") == "1"
    assert suite.get("failures") == "0"

    # One object more than there is now was found before: since then, one was lost.
    lost = {**entry.objects[0], "id": "lost"}
    before = results_text([entry_line(replace(entry, objects=(*entry.objects, lost)))])
    (repository / "baseline.json").write_text(before)
    again = run(steps, repository)
    assert again.returncode == 4
    assert "object 'lost' is missing" in again.stdout
    assert "kept" in again.stdout
    suite = ElementTree.parse(repository / "results.xml").getroot()[0]
    assert suite.get("failures") == "1"
