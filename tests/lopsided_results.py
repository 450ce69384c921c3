"""Hand-made results without any symmetry, for the tests of texts and figures."""

from __future__ import annotations

import numpy as np

from mclass.footprint import Grid
from mclass.records import FloatArray
from mclass.results import CellReport, ClassMaps, ObjectEstimate, OrientationMode

STAMP_NS = 1_700_000_000_123_456_789
CLASS_NAMES = ("books", "parts")


def mode(angle_deg: float, mass: float, std_deg: float) -> OrientationMode:
    return OrientationMode(float(np.deg2rad(angle_deg)), mass, float(np.deg2rad(std_deg)))


def estimate(
    object_id: str = "o1",
    *,
    probabilities: tuple[float, ...] = (0.1506, 0.849382, 1.8e-5),
    class_index: int = 0,
    tie: tuple[int, ...] = (),
    position: tuple[float, float] = (4.0, -2.5),
    position_std: tuple[float, float] = (0.05, 0.061),
    modes: tuple[OrientationMode, ...] = (mode(257.75, 0.75, 9.125), mode(77.5, 0.25, 12.0)),
    measurements: int = 12,
    labels: tuple[str, ...] = ("books",),
    stamp_ns: int = STAMP_NS,
) -> ObjectEstimate:
    poses = np.array(
        [[*position, modes[0].orientation if modes else 0.0], [1.25, 7.5, np.deg2rad(30.0)]]
    )
    count = len(probabilities) - 1
    return ObjectEstimate(
        object_id=object_id,
        stamp_ns=stamp_ns,
        log_time_ns=stamp_ns + 50_000_000,
        labels=labels,
        measurements=measurements,
        class_probabilities=np.array(probabilities),
        class_index=class_index,
        tie=tie,
        position=np.array(position),
        position_std=np.array(position_std),
        class_poses=np.resize(poses, (count, 3)),
        modes=modes,
        joint_map=(count - 1, 1.25, 7.5, float(np.deg2rad(30.0))),
    )


def cell(
    *,
    density: FloatArray | None = None,
    probabilities: tuple[float, ...] = (0.125, 0.75, 0.125),
    modes: tuple[tuple[OrientationMode, ...], ...] = ((mode(90.0, 1.0, 26.0),), ()),
    measurements: int = 3,
    labels: tuple[str, ...] = ("books", "parts"),
    stamp_ns: int = STAMP_NS,
) -> CellReport:
    if density is None:
        # Eight bins: all of the first class between 45 and 180 degrees, the second flat.
        peaked = np.array([0.0, 1.0, 4.0, 2.0, 1.0, 0.0, 0.0, 0.0])
        density = np.stack([peaked / (peaked.sum() * np.pi / 4), np.full(8, 0.5 / np.pi)])
    return CellReport(
        grid=Grid(origin=(-1.0, 2.0), cell_size=0.5, rows=6, columns=9),
        row=3,
        column=7,
        center=np.array([2.75, 3.75]),
        class_probabilities=np.array(probabilities),
        density=density,
        modes=modes,
        measurements=measurements,
        stamp_ns=stamp_ns,
        labels=labels,
    )


def maps() -> ClassMaps:
    """A grid of 4 rows and 6 columns, three cells touched: two in row 1, one in row 2."""
    return ClassMaps(
        grid=Grid(origin=(-1.0, 2.0), cell_size=0.5, rows=4, columns=6),
        stamp_ns=STAMP_NS,
        log_time_ns=STAMP_NS,
        cells=np.array([7, 8, 16]),
        class_probabilities=np.array([[0.7, 0.2, 0.1], [0.5, 0.4, 0.1], [0.1, 0.0, 0.9]]),
        untouched=np.array([0.5, 0.25, 0.25]),
    )
