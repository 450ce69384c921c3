"""The README, docs/, the help texts and the shipped files say what is so."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import documents
import pytest
import yaml
from mcap.reader import make_reader
from sample_runs import CONFIGS, ROOT, SAMPLE_NAMES, estimated, mclass

from mclass.commands.cli import main
from mclass.config.model_file import DEFAULT_PRESET, load_model, parse_model
from mclass.simulation.scenario_file import load_scenario

README = documents.README.read_text(encoding="utf-8")
TEXTS = {path.name: path.read_text(encoding="utf-8") for path in documents.DOCUMENTS}
ALL = "\n".join(TEXTS.values())
MODELS = sorted(CONFIGS.glob("*.yaml"))
SCENARIOS = sorted((CONFIGS / "scenarios").glob("*.yaml"))
MODEL_SCHEMA = json.loads((ROOT / "schemas" / "model.schema.json").read_text(encoding="utf-8"))


def every_command(name: str, command: click.Command) -> Iterator[tuple[str, click.Command]]:
    """Every command with its full name, groups included."""
    yield name, command
    if isinstance(command, click.Group):
        context = click.Context(command)
        for child in command.list_commands(context):
            found = command.get_command(context, child)
            assert found is not None
            yield from every_command(f"{name} {child}", found)


COMMANDS = dict(every_command("mclass", main))


class TestHelp:
    @pytest.mark.parametrize("name", COMMANDS)
    def test_has_examples_line_by_line(self, name: str) -> None:
        text = mclass(*name.split()[1:], "--help").stdout
        assert text == mclass(*name.split()[1:], "-h").stdout
        examples = re.findall(r"^    (mclass .*)", text.partition("Examples:\n")[2], re.MULTILINE)
        assert examples, "no examples, or they are run together"
        for example in examples:
            assert_can_be_typed(example.partition("   ")[0].split())
        if not isinstance(COMMANDS[name], click.Group):
            assert any(example.startswith(name) for example in examples)
        assert "\\b" not in text
        assert max(map(len, text.splitlines())) <= 80

    @pytest.mark.parametrize("name", COMMANDS)
    def test_every_option_is_explained(self, name: str) -> None:
        text = mclass(*name.split()[1:], "--help").stdout
        for parameter in COMMANDS[name].params:
            if isinstance(parameter, click.Option):
                assert parameter.help, f"{name}: {parameter.name} has no help"
                assert all(form in text for form in parameter.opts)

    @pytest.mark.parametrize("name", COMMANDS)
    def test_ends_with_exit_codes_and_related_commands(self, name: str) -> None:
        if isinstance(COMMANDS[name], click.Group):
            return
        _, _, text = mclass(*name.split()[1:], "--help").stdout.partition("Exit codes:\n")
        codes, _, related = text.partition("See also: ")
        told = [int(line.split()[0]) for line in codes.strip().splitlines()]
        assert {0, 1, 2, 130} <= set(told) <= {0, 1, 2, 3, 4, 130}
        forms = [form for parameter in COMMANDS[name].params for form in parameter.opts]
        assert (4 in told) == ("--fail-on" in forms)
        others = [other.strip() for other in " ".join(related.split()).split(",")]
        assert others
        assert name not in others
        assert set(others) <= set(COMMANDS)

    @pytest.mark.parametrize("columns", ["40", "60", "200"])
    def test_fits_any_terminal(self, columns: str, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("COLUMNS", columns)
        text = mclass("--help").stdout
        assert "..." not in text.replace("[ARGS]...", "")
        for name in COMMANDS:
            assert name.split()[-1] in text or " " in name.partition(" ")[2]

    @pytest.mark.parametrize("name", COMMANDS)
    def test_short_help_is_a_sentence(self, name: str) -> None:
        short = COMMANDS[name].get_short_help_str(limit=200)
        assert short.endswith(".")
        assert not short.endswith("...")


def assert_can_be_typed(words: list[str]) -> None:
    """A command line names a command, and only options that it has."""
    assert words[0] == "mclass"
    name = "mclass"
    for word in words[1:]:
        if f"{name} {word}" not in COMMANDS:
            break
        name = f"{name} {word}"
    forms = {form for parameter in COMMANDS[name].params for form in parameter.opts} | {
        "-h",
        "--help",
    }
    for word in words:
        if re.match(r"--?[a-zA-Z]", word):
            assert word in forms, f"{name} has no option {word}"


class TestDocuments:
    @pytest.mark.slow
    @pytest.mark.parametrize("name", [name for name in TEXTS if "```console" in TEXTS[name]])
    def test_examples_print_what_is_shown(self, name: str, tmp_path: Path) -> None:
        documents.lay_out(tmp_path)
        wrong, count = [], 0
        for command, shown, _ in documents.examples(TEXTS[name]):
            count += 1
            if command.startswith("mclass view") and importlib.util.find_spec("rerun") is None:
                continue  # It cannot be installed everywhere.
            printed = documents.run(command, tmp_path)
            if not documents.same_output(command, shown, printed):
                wrong.append(f"$ {command}\n--- shown\n{shown}--- printed\n{printed}")
        assert count > 3
        assert not wrong, "run `python tests/documents.py`\n\n" + "\n".join(wrong)

    def test_comparison_can_fail(self) -> None:
        shown = "P 0.4963  x 4.00 ± 0.10, 2.7e-20, 12 used\n"
        assert documents.same_output("mclass estimate", shown, shown)
        assert documents.same_output(
            "mclass estimate", shown, "P 0.4962 x 4.00 ± 0.10, 3.1e-21, 12 used\n"
        )
        assert not documents.same_output(
            "mclass estimate", shown, shown.replace("0.4963", "0.4965")
        )
        assert not documents.same_output("mclass estimate", shown, shown.replace("12", "13"))
        assert not documents.same_output("mclass estimate", shown, shown.replace("used", "left"))
        assert not documents.same_output("mclass estimate", shown, shown + "more\n")
        assert documents.same_output("mclass batch logs", shown, shown.replace("12", "13"))

    @pytest.mark.parametrize("name", [name for name in COMMANDS if name != "mclass"])
    def test_shows_every_command_with_output(self, name: str) -> None:
        if isinstance(COMMANDS[name], click.Group):
            return
        assert re.search(rf"^### {name} [A-Z]", README, re.MULTILINE)
        outputs = [
            out for command, out, _ in documents.examples(README) if command.startswith(name)
        ]
        assert any(outputs)

    def test_its_commands_can_be_typed(self) -> None:
        for line in re.findall(r"`(mclass [^`]*)`", ALL):
            assert_can_be_typed(line.split())

    def test_first_session_commands(self) -> None:
        first, second = (
            block.text for block in documents.blocks(README) if block.kind == "sh first-session"
        )
        assert "pip install" in first
        assert "mclass estimate sample_logs/" in first
        assert "'.[test]'" in second
        assert "pytest" in second
        for text in (first, second):
            subprocess.run(["bash", "-n", "-c", text], check=True)

    def test_every_fence_is_of_a_kind_that_is_tested(self) -> None:
        kinds = {block.kind for block in documents.blocks(ALL)}
        assert kinds == {"sh first-session", "console", "yaml", "python", "text"}

    def test_model_files_load(self) -> None:
        """Whole ones by themselves, sections in place of the first whole one's."""
        texts = [block.text for block in documents.blocks(ALL) if block.kind == "yaml"]
        whole = next(text for text in texts if "classes:" in text)
        assert f"| preset `{DEFAULT_PRESET}` |" in ALL
        assert sum("classes:" not in text for text in texts) > 1
        for text in texts:
            base = {} if "classes:" in text else yaml.safe_load(whole)
            merged = {**base, **yaml.safe_load(text)}
            parse_model(yaml.safe_dump(merged, allow_unicode=True), "a document")
        parse_model(whole, "README.md")

    def test_robust_preset_is_written_out(self) -> None:
        """The section that spells out the preset changes nothing but the last digits."""
        text = next(b.text for b in documents.blocks(ALL) if "probabilities: true" in b.text)
        base = (CONFIGS / "paper_toy.yaml").read_text(encoding="utf-8")
        base = base.replace("length_unit: dm", "length_unit: m")
        spelled = parse_model(base.replace("inference: {preset: paper}\n", text), "a").inference
        preset = parse_model(base.replace("preset: paper", "preset: robust"), "b").inference
        for key, value in vars(preset).items():
            assert getattr(spelled, key) == (
                pytest.approx(value, rel=0.02) if key != "preset" else value
            ), key
        keys = MODEL_SCHEMA["$defs"]["inference"]["properties"]
        assert set(yaml.safe_load(text)["inference"]) == set(keys)

    def test_names_every_model_key(self) -> None:
        keys = set(model_keys(MODEL_SCHEMA))
        assert {"length_unit", "min_score", "mount", "std_deg", "silence"} <= keys
        unnamed = {key for key in keys if not re.search(rf"`{key}`|\b{key}: ", ALL)}
        assert unnamed == set()

    def test_names_every_shipped_file(self) -> None:
        for path in CONFIGS.glob("*.*"):
            assert path.relative_to(ROOT).as_posix() in README
        for path in (ROOT / "docs").glob("*.png"):
            assert f"]({path.name})" in ALL or f"](docs/{path.name})" in README
        for path in documents.DOCUMENTS[1:]:
            assert f"](docs/{path.name})" in README

    @pytest.mark.parametrize("path", documents.DOCUMENTS, ids=lambda path: path.name)
    def test_links_lead_somewhere(self, path: Path) -> None:
        text = TEXTS[path.name]
        headings = {
            re.sub(r"[^\w\- ]", "", line).strip().lower().replace(" ", "-")
            for line in re.findall(r"^#+ (.*)", text, re.MULTILINE)
        }
        for target in re.findall(r"\]\(([^)]+)\)", text):
            if target.startswith("#"):
                assert target[1:] in headings
            else:
                assert (path.parent / target).exists(), target

    def test_pictures_are_modest(self) -> None:
        for path in (ROOT / "docs").glob("*.*"):
            assert path.stat().st_size < 300_000

    @pytest.mark.parametrize("name", SAMPLE_NAMES)
    def test_lists_every_channel_of_outputs(self, name: str, tmp_path: Path) -> None:
        table = README.partition("## Output")[2].partition("###")[0]
        with estimated(name, tmp_path).open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        new = [c for c in summary.channels.values() if c.topic.startswith("/mclass")]
        assert len(new) > 5
        for channel in new:
            topic = re.sub(r"(?<=/pose/).*", "<id>", channel.topic)
            topic = re.sub(r"(?<=/grid/).*", "<class>", topic)
            schema = summary.schemas[channel.schema_id].name.replace("/msg/", "/")
            assert f"`{topic}`" in table
            assert f"`{schema}`" in table or schema == "mclass_msgs/Estimates"

    @pytest.mark.parametrize("file", [*TEXTS, "CONTRIBUTING.md", "CHANGELOG.md"])
    def test_speaks_of_the_project_alone(self, file: str) -> None:
        text = TEXTS.get(file) or (ROOT / file).read_text(encoding="utf-8")
        assert not re.search(r"https?://|/work/|/home/|/root/|issue #?\d", text)
        assert max(map(len, text.splitlines())) <= 400

    def test_version_is_in_the_changelog(self) -> None:
        version = mclass("--version").stdout.split()[-1]
        changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
        assert re.search(rf"^## {re.escape(version)}\b", changes, re.MULTILINE)
        assert f'version = "{version}"' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def model_keys(node: Any) -> Iterator[str]:
    """The keys that the schema of model files names, at any depth."""
    for key, value in node.items() if isinstance(node, dict) else enumerate(node):
        if key == "properties":
            yield from value
        if isinstance(value, dict | list):
            yield from model_keys(value)


class TestShippedFiles:
    @pytest.mark.parametrize("path", MODELS, ids=lambda path: path.name)
    def test_models_load_and_can_be_looked_at(self, path: Path, tmp_path: Path) -> None:
        load_model(path)
        assert "is valid" in mclass("check", path).stdout
        picture = tmp_path / "model.svg"
        assert path.name in mclass("inspect", "model", path, "--plot", picture).stdout
        assert picture.stat().st_size > 1000

    @pytest.mark.parametrize(
        "path",
        [
            pytest.param(path, marks=[pytest.mark.slow] if path.stem == "office" else [])
            for path in SCENARIOS
        ],
        ids=lambda path: path.name,
    )
    def test_scenarios_run(self, path: Path, tmp_path: Path) -> None:
        log = tmp_path / "log.mcap"
        mclass("simulate", path, "-o", log)
        objects = mclass("estimate", log, "--format", "json").document["objects"]
        there = {thing.object_id for thing in load_scenario(path).objects}
        assert {entry["id"] for entry in objects} >= there
