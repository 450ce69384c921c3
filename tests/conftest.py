"""Fixtures shared by the tests of the mathematics."""

from __future__ import annotations

import signal

import numpy as np
import pytest
from hypothesis import settings
from models import lopsided_model

from mclass.classes import ClassModel
from mclass.footprint import Grid

# The same examples in every run; `--hypothesis-profile=explore` looks for new ones.
settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("explore", max_examples=1000, deadline=None)
settings.load_profile("same")

# In the background, or under `nohup`, tests are started deaf to what interrupts the programs they
# start, too.
for number in (signal.SIGINT, getattr(signal, "SIGHUP", signal.SIGINT)):
    if signal.getsignal(number) == signal.SIG_IGN:
        signal.signal(number, signal.SIG_DFL)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240229)


@pytest.fixture
def small_grid() -> Grid:
    return Grid(origin=(-1.0, -2.0), cell_size=0.25, rows=12, columns=16)


@pytest.fixture
def lopsided() -> ClassModel:
    return lopsided_model()
