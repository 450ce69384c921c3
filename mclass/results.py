"""What an estimate says, as plain values: what outputs write and commands print.

Metres, radians and nanoseconds; class axes without the background are (n,), with it first (1 + n,).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mclass.footprint import Grid
from mclass.records import FloatArray, IntArray

_FLAT_STD = 0.999 * np.pi / np.sqrt(3.0)
"""Of a density that is the same all around the circle, but for rounding [rad]."""


@dataclass(frozen=True)
class OrientationMode:
    """A peak of an orientation density: place [rad, 0..2 pi), mass within its class, std [rad]."""

    orientation: float
    mass: float
    std: float


@dataclass(frozen=True)
class ObjectEstimate:
    """One object after some measurement.

    Attributes:
        object_id: As the detector gave it.
        stamp_ns: Header stamp of the measurement that caused this estimate.
        log_time_ns: Its log time.
        labels: Label names of that measurement.
        measurements: How many measurements the object has had, this one included.
        class_probabilities: P(class), background first, (1 + n,).
        class_index: The class named: the greatest among the classes, never the background.
        tie: Class indices equally probable to 1e-6, empty when there is no tie.
        position: Of the object given the named class [m], (2,).
        position_std: [m], (2,); zeros for a known position.
        class_poses: Best position [m] and highest orientation mode [rad] given each class, (n, 3).
        modes: Orientation modes given the named class, heaviest first; masses sum to 1.
        joint_map: Paper eq. (24) to the letter: class index, x [m], y [m], orientation [rad].
    """

    object_id: str
    stamp_ns: int
    log_time_ns: int
    labels: tuple[str, ...]
    measurements: int
    class_probabilities: FloatArray
    class_index: int
    tie: tuple[int, ...]
    position: FloatArray
    position_std: FloatArray
    class_poses: FloatArray
    modes: tuple[OrientationMode, ...]
    joint_map: tuple[int, float, float, float]

    @property
    def unexplained(self) -> bool:
        """Whether no class can have returned its labels: each is ruled out by some of them."""
        return not self.class_probabilities[1:].any() and is_flat(self.modes)


def is_flat(modes: Sequence[OrientationMode]) -> bool:
    """Whether modes are those of a density that tells no orientation from another."""
    return not modes or (len(modes) == 1 and modes[0].std >= _FLAT_STD)


@dataclass(frozen=True)
class ClassMaps:
    """Class probabilities over the grid; only touched cells are listed.

    Attributes:
        grid: The cells' geometry.
        stamp_ns: Header stamp of the last measurement in the maps.
        log_time_ns: Its log time.
        cells: Flat indices of touched cells, increasing, (m,).
        class_probabilities: Background first, (m, 1 + n).
        untouched: Class probabilities of all other cells: the prior, (1 + n,).
    """

    grid: Grid
    stamp_ns: int
    log_time_ns: int
    cells: IntArray
    class_probabilities: FloatArray
    untouched: FloatArray


@dataclass(frozen=True)
class BeliefBlock:
    """Full belief of some cells: of the grid (``object_id`` empty) or of one object.

    Attributes:
        object_id: Empty for the grid.
        grid: Geometry of ``cells``; for an object at a known position one cell centred on it.
        stamp_ns: Header stamp of the last measurement.
        log_time_ns: Its log time.
        block: Number of this block, from 0.
        blocks: How many blocks make the belief.
        cells: Flat indices, increasing, (m,).
        log_cell_mass: Log probability that the object is in the cell; zeros for the grid, (m,).
        log_class_probability: Given the cell, background first, (m, 1 + n).
        log_density: Log orientation density given cell and class [1/rad], bin b centred
            at 2 pi b / bins, normalised so that its sum over the bins times their width is 1
            (class probabilities come from finer sums), (m, n, bins), float32.
        measurements: How many measurements touched each cell, (m,).
    """

    object_id: str
    grid: Grid
    stamp_ns: int
    log_time_ns: int
    block: int
    blocks: int
    cells: IntArray
    log_cell_mass: FloatArray
    log_class_probability: FloatArray
    log_density: npt.NDArray[np.float32]
    measurements: IntArray


@dataclass(frozen=True)
class CellReport:
    """One cell's belief, ready to print.

    Attributes:
        grid: The cell's grid.
        row: Of the cell.
        column: Of the cell.
        center: Of the cell [m], (2,).
        class_probabilities: Background first, (1 + n,).
        density: Orientation density given each class [1/rad], bin b centred at
            2 pi b / bins, integrates to 1, (n, bins).
        modes: Of each class, heaviest first.
        measurements: How many measurements touched the cell.
        stamp_ns: Of the last of them, 0 if none.
        labels: Of the last of them.
    """

    grid: Grid
    row: int
    column: int
    center: FloatArray
    class_probabilities: FloatArray
    density: FloatArray
    modes: tuple[tuple[OrientationMode, ...], ...]
    measurements: int
    stamp_ns: int
    labels: tuple[str, ...]
