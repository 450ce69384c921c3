"""The targets of fuzzing: what they start from, what once went wrong, and a short run of each."""

from __future__ import annotations

import importlib.util
import random
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from fuzz.seeds import seeds
from fuzz.targets import TARGETS

FOLDER = Path(__file__).parent / "fuzz"


def inputs(target: str) -> Iterator[bytes]:
    """Seeds, and the inputs that are kept."""
    yield from seeds(target)
    for path in sorted((FOLDER / "corpus" / target).glob("*")):
        yield path.read_bytes()


@pytest.mark.parametrize("target", TARGETS)
def test_known_inputs(target: str) -> None:
    found = list(inputs(target))
    assert len(found) >= 2
    for data in found:
        TARGETS[target](data)


@pytest.mark.parametrize("target", TARGETS)
def test_mutated_inputs(target: str) -> None:
    """A few changes at random, without any tool; the same ones each time."""
    rng = random.Random(f"mutations of {target}")
    found = [data for data in inputs(target) if data]
    for _ in range(60):
        data = bytearray(rng.choice(found))
        for _ in range(rng.randint(1, 4)):
            place, length = rng.randrange(len(data) + 1), rng.choice((1, 2, 8, 30))
            kind = rng.randrange(3)
            if kind == 0:
                data[place : place + 1] = bytes([rng.randrange(256)])
            elif kind == 1:
                del data[place : place + length]
            else:
                data[place:place] = data[place : place + length]
        TARGETS[target](bytes(data))


def test_the_command_knows_all_targets() -> None:
    names = (FOLDER / "run").read_text(encoding="utf-8").partition("NAMES = (")[2].partition(")")[0]
    assert {name.strip().strip('"') for name in names.split(",") if name.strip()} == set(TARGETS)


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("atheris") is None, reason="needs mclass[fuzz]")
@pytest.mark.parametrize("target", TARGETS)
def test_short_run(target: str, tmp_path: Path) -> None:
    words = [FOLDER / "run", target, "--runs", "2000", "--seed", "1", "--findings", tmp_path]
    done = subprocess.run(
        [sys.executable, *map(str, words)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "Done 2000 runs" in done.stderr
    assert list(tmp_path.iterdir()) == []
