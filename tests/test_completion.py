"""What the shell offers when the Tab key is pressed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.shell_completion import ShellComplete
from sample_runs import SAMPLES, mclass

from mclass.commands.cli import main


def offered(*words: str) -> list[str]:
    """Completions of the last word; of files that the shell looks for itself, the kind."""
    *before, incomplete = words
    shell = ShellComplete(main, {}, "mclass", "_MCLASS_COMPLETE")
    found = shell.get_completions(list(before), incomplete)
    return [f"<{item.type}>" if item.type != "plain" else item.value for item in found]


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("completion") / "lab.mclass.mcap"
    mclass("estimate", SAMPLES / "cas_lab.mcap", "-o", out)
    return out


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("a.mcap", "b.mcap", "c.yaml", "d.yml", "e.json", ".hidden.mcap"):
        (tmp_path / name).touch()
    for name in ("logs/x.mcap", "logs/y z.mcap", "many/sub/z.mcap", "many/q.mcap"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_commands_and_options() -> None:
    assert {"estimate", "init", "check", "inspect"} <= set(offered(""))
    assert offered("inspect", "ce") == ["cell"]
    assert offered("estimate", "--in") == ["--in-place"]
    assert offered("check", "--format", "j") == ["json"]
    assert {"-q", "--quiet", "-v"} <= set(offered("check", "-"))


def test_files_that_fit(folder: Path) -> None:
    assert offered("estimate", "a") == ["a.mcap"]
    assert offered("estimate", "a.mcap", "-c", "c") == ["c.yaml"]
    assert offered("check", "d") == ["d.yml"]
    assert offered("evaluate", "a.mcap", "--truth", "e") == ["e.json"]
    assert offered("fuse", "a.mcap", "b") == ["b.mcap"]
    assert offered("batch", "b") == ["b.mcap"]
    assert offered("estimate", "logs/x") == ["logs/x.mcap"]
    assert offered("estimate", ".h") == [".hidden.mcap"]


def test_the_shell_goes_on_where_folders_or_quotes_are_needed(folder: Path) -> None:
    assert offered("estimate", "l") == ["<dir>"]
    assert offered("estimate", "") == ["<file>"]
    assert offered("estimate", "many/") == ["<file>"]
    assert offered("estimate", "logs/y") == ["<file>"]
    assert offered("estimate", "c") == ["<file>"]
    assert offered("estimate", "nowhere/x") == ["<file>"]
    assert offered("estimate", "s3://bucket/") == []


def test_ids_of_the_objects_in_the_output(output: Path) -> None:
    cell = ("inspect", "cell", str(output), "2.1", "-1.5", "--object")
    assert offered(*cell, "") == ["o1", "o2", "o3"]
    assert offered(*cell, "o2") == ["o2"]
    assert offered("inspect", "cell", "--object", "") == []


def test_frames_of_the_outputs(output: Path) -> None:
    assert offered("fuse", str(output), "-o", "map.mcap", "--frame", "") == ["odom"]


def test_figures_of_rules() -> None:
    assert offered("evaluate", "x.mcap", "--fail-on", "class") == ["class_accuracy"]
    assert "skipped" in offered("batch", "x.mcap", "--fail-on", "")


def test_what_goes_wrong_is_passed_over(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for out in ("a.mcap", "nothing.mcap", "logs"):
        assert offered("inspect", "cell", out, "1", "2", "--object", "") == []
        assert offered("fuse", out, "-o", "map.mcap", "--frame", "") == []
    printed = capsys.readouterr()
    assert printed.out == printed.err == ""


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_as_shells_ask_without_loading_much(shell: str, folder: Path) -> None:
    """Through the program itself: commands and files need neither numpy nor the readers."""
    code = (
        "import sys\n"
        "from mclass.commands.cli import main\n"
        "try:\n"
        "    main(prog_name='mclass')\n"
        "finally:\n"
        "    heavy = {'numpy', 'scipy', 'mcap', 'yaml', 'google.protobuf'} & set(sys.modules)\n"
        "    print(*heavy, file=sys.stderr)\n"
    )
    words = {"bash": "mclass estimate a", "zsh": "mclass estimate a", "fish": "mclass estimate a"}
    environment = {
        **os.environ,
        "_MCLASS_COMPLETE": f"{shell}_complete",
        "COMP_WORDS": words[shell],
        "COMP_CWORD": "a" if shell == "fish" else "2",
    }
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False
    )
    assert "a.mcap" in done.stdout
    assert done.stderr.strip() == ""


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_scripts_that_switch_it_on(shell: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", "from mclass.commands.cli import main; main(prog_name='mclass')"],
        capture_output=True,
        text=True,
        env={**os.environ, "_MCLASS_COMPLETE": f"{shell}_source"},
        check=False,
    )
    assert "_MCLASS_COMPLETE" in done.stdout
    assert f"{shell}_complete" in done.stdout
