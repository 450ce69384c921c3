"""The whole filter by brute force in float64: slow, plain, and sharing no code with the package.

Numbers are read out of the package's dataclasses, nothing else of it is used. The mathematics is
written the paper's way round, so that a shared mistake is unlikely: where the package turns the
sensor into the object's frame, this file turns the viewpoints and their covariances into the
world, X(phi, x) ∘ q and R Sigma Rᵀ, as in (10), (13), (25) and (26). Integrals over orientation
are sums over a fine regular grid, which for smooth periodic functions is as good as exact.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from mclass.classes import ClassModel
from mclass.footprint import Grid
from mclass.records import FloatArray, LabelMeasurements

TURN = 2.0 * math.pi


def rotation(angle: FloatArray | float) -> FloatArray:
    """R(angle), (1), shape (..., 2, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def wrapped(angle: float) -> float:
    """The same direction in (-pi, pi]."""
    return math.atan2(math.sin(angle), math.cos(angle))


def orientations(bins: int) -> FloatArray:
    """Bin b is at 2 pi b / bins."""
    return TURN * np.arange(bins) / bins


# --- Likelihood --------------------------------------------------------------------------------


def log_gaussian(offsets: FloatArray, covariances: FloatArray) -> FloatArray:
    """Log of (6) with its minus sign back: offsets (..., n), covariances (..., n, n)."""
    n = offsets.shape[-1]
    solved = np.linalg.solve(covariances, offsets[..., None])[..., 0]
    squared = np.sum(offsets * solved, axis=-1)
    log_determinant = np.linalg.slogdet(covariances)[1]
    return np.asarray(-0.5 * squared - 0.5 * n * math.log(TURN) - 0.5 * log_determinant)


def log_wrapped_gaussian(difference: float, variance: float) -> float:
    """Log of (7), with far more terms than needed."""
    reach = 20 + math.ceil(20.0 * math.sqrt(variance))
    exponents = [-((wrapped(difference) - TURN * k) ** 2) / (2.0 * variance)
                 for k in range(-reach, reach + 1)]  # fmt: skip
    return float(logsumexp(exponents)) - 0.5 * math.log(TURN * variance)


@dataclass(frozen=True)
class Sighting:
    """One label set, the pose it was seen from, and where it points.

    ``position_covariance`` is of the sensor's position in the world, (2, 2).
    """

    labels: tuple[int, ...]
    sensor_xy: FloatArray
    sensor_heading: float
    right: float = math.nan
    left: float = math.nan
    position_covariance: FloatArray | None = None


def sightings(
    measurements: LabelMeasurements, rows: Sequence[int] | None = None, covariances: bool = True
) -> list[Sighting]:
    """Rows of the columns one by one."""
    result = []
    frames = measurements.frames
    for row in range(len(measurements)) if rows is None else rows:
        frame = measurements.frame_index[row]
        x, y, heading = frames.poses_world_sensor[frame]
        start, end = measurements.label_offsets[row : row + 2]
        blur = None
        if covariances and frames.covariances is not None:
            blur = frames.covariances[frame][:2, :2]
        right, left = measurements.directions[row]
        labels = tuple(int(label) for label in measurements.labels[start:end])
        result.append(Sighting(labels, np.array([x, y]), heading, right, left, blur))
    return result


def log_label_likelihood(
    model: ClassModel,
    pair: tuple[int, int],
    sighting: Sighting,
    object_xy: FloatArray,
    phi: FloatArray | float,
) -> FloatArray:
    """Log p(label | class, phi, x), (10) and (13), seen from the sighting's pose.

    ``pair`` is (class index, label index); -inf for a label that the class never gives.
    ``phi`` may have any shape, the result has the same.
    """
    phi = np.asarray(phi, dtype=float)
    entry = model.likelihoods.get(pair)
    if entry is None:
        return np.full(phi.shape, -math.inf)
    sensor = sighting.sensor_xy
    turns = rotation(phi)
    azimuth = math.atan2(object_xy[1] - sensor[1], object_xy[0] - sensor[0])
    bearing = azimuth - sighting.sensor_heading
    terms = []
    mixture = entry.mixture
    for m in range(len(mixture.weights)):
        mean_world = turns @ mixture.means[m]
        covariance_world = turns @ mixture.covariances[m] @ np.swapaxes(turns, -1, -2)
        if sighting.position_covariance is not None:
            covariance_world = covariance_world + sighting.position_covariance
        # Subtracting positions first keeps every digit far from the world's origin.
        offset = (sensor - object_xy) - mean_world
        term = math.log(mixture.weights[m]) + log_gaussian(offset, covariance_world)
        if math.isfinite(mixture.bearing_variances[m]):
            term = term + log_wrapped_gaussian(
                bearing - mixture.bearing_means[m], float(mixture.bearing_variances[m])
            )
        terms.append(term)
    value = math.log(entry.probability) + logsumexp(np.array(terms), axis=0)
    if entry.clutter > 0.0:
        value = np.logaddexp(value, math.log(entry.clutter))
    return np.asarray(value)


def label_likelihood(
    model: ClassModel,
    pair: tuple[int, int],
    sighting: Sighting,
    object_xy: FloatArray,
    phi: FloatArray | float,
) -> FloatArray:
    """p(label | class, phi, x)."""
    return np.exp(log_label_likelihood(model, pair, sighting, object_xy, phi))


def log_set_likelihood(
    model: ClassModel, class_index: int, sighting: Sighting, object_xy: FloatArray, phi: FloatArray
) -> FloatArray:
    """(17): the labels of one set multiply."""
    total = np.zeros(np.shape(phi))
    for label in sorted(set(sighting.labels)):
        total = total + log_label_likelihood(model, (class_index, label), sighting, object_xy, phi)
    return total


def log_background_likelihood(model: ClassModel, sighting: Sighting) -> float:
    """(15), (27): a constant for each label."""
    return sum(float(model.background_log_likelihood[label]) for label in set(sighting.labels))


# --- Footprint ---------------------------------------------------------------------------------


def center_of(grid: Grid, cell: int) -> FloatArray:
    """Centre of a flat cell index."""
    row, column = cell // grid.columns, cell % grid.columns
    return np.array(
        [
            grid.origin[0] + (column + 0.5) * grid.cell_size,
            grid.origin[1] + (row + 0.5) * grid.cell_size,
        ]
    )


@dataclass(frozen=True)
class Reach:
    """How far a footprint goes [m], and whether it is the box's cone or the ray at its middle.

    ``slack`` [m, rad] moves every border outward, to tell cells that are in or out for certain.
    """

    min_range: float
    max_range: float
    kind: str = "cone"
    slack: float = 0.0


def in_cone(point: FloatArray, sighting: Sighting, reach: Reach) -> bool:
    """Whether a point lies between two directions and two ranges, borders included."""
    dx, dy = point - sighting.sensor_xy
    slack = reach.slack
    if not reach.min_range - slack <= math.hypot(dx, dy) <= reach.max_range + slack:
        return False
    width = (sighting.left - sighting.right) % TURN
    return (math.atan2(dy, dx) - sighting.right + slack) % TURN <= width + 2.0 * slack


def segment_crosses_box(
    start: FloatArray, end: FloatArray, low: FloatArray, high: FloatArray
) -> bool:
    """Whether a segment and a closed box share a point (the slab method)."""
    first, last = 0.0, 1.0
    for axis in range(2):
        step = float(end[axis] - start[axis])
        near, far = float(low[axis] - start[axis]), float(high[axis] - start[axis])
        if step == 0.0:
            if near > 0.0 or far < 0.0:
                return False
            continue
        enter, leave = sorted((near / step, far / step))
        first, last = max(first, enter), min(last, leave)
    return first <= last


def footprint_holds(grid: Grid, cell: int, sighting: Sighting, reach: Reach) -> bool:
    """Whether a cell is in a sighting's footprint; a cone without width is a ray."""
    if math.isnan(sighting.right) or math.isnan(sighting.left):
        return False
    width = (sighting.left - sighting.right) % TURN
    center = center_of(grid, cell)
    if reach.kind == "cone" and width > 0.0:
        return in_cone(center, sighting, reach)
    azimuth = sighting.right + 0.5 * width
    direction = np.array([math.cos(azimuth), math.sin(azimuth)])
    offset = center - sighting.sensor_xy
    half = 0.5 * grid.cell_size + reach.slack
    return segment_crosses_box(
        reach.min_range * direction, reach.max_range * direction, offset - half, offset + half
    )


# --- Belief ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mode:
    """A peak: its angle in [0, 2 pi), the mass between its two minima, and its std there."""

    angle: float
    mass: float
    std: float


@dataclass(frozen=True)
class Belief:
    """Belief over class and orientation at one place, normalised.

    ``log_background`` is log P(c0); ``log_classes`` (n, bins) is the log density
    [1/rad] over class and orientation together, so that P(c0) + sum(density) * 2 pi / bins = 1.
    ``log_evidence`` is the log of the normaliser (21).
    """

    log_background: float
    log_classes: FloatArray
    log_evidence: float

    @property
    def class_probabilities(self) -> FloatArray:
        """(22), background first."""
        bins = self.log_classes.shape[1]
        classes = np.exp(logsumexp(self.log_classes, axis=1)) * TURN / bins
        return np.concatenate([[math.exp(self.log_background)], classes])

    def density(self, class_index: int) -> FloatArray:
        """Orientation density given a class, integrates to 1 [1/rad]."""
        row = self.log_classes[class_index]
        return np.asarray(np.exp(row - logsumexp(row)) * len(row) / TURN)

    def modes(self, class_index: int) -> list[Mode]:
        """Modes given a class, heaviest first."""
        return modes_of(self.density(class_index))


def normalised(log_background: float, log_classes: FloatArray) -> Belief:
    """(20) from the logs of likelihood times prior."""
    step = TURN / log_classes.shape[1]
    log_evidence = float(
        np.logaddexp(log_background, float(logsumexp(log_classes)) + math.log(step))
    )
    return Belief(log_background - log_evidence, log_classes - log_evidence, log_evidence)


def log_joint(
    model: ClassModel, seen: Sequence[Sighting], object_xy: FloatArray, bins: int
) -> tuple[float, FloatArray]:
    """Log likelihood times prior at one place: of the background, and (n, bins) of the classes."""
    phi = orientations(bins)
    background = float(model.log_priors[0])
    background += sum(log_background_likelihood(model, sighting) for sighting in seen)
    classes = np.empty((len(model.class_names), bins))
    for k in range(len(model.class_names)):
        classes[k] = model.log_priors[1 + k] - math.log(TURN)
        for sighting in seen:
            classes[k] += log_set_likelihood(model, k, sighting, object_xy, phi)
    return background, classes


def belief_at(
    model: ClassModel, seen: Sequence[Sighting], object_xy: FloatArray, bins: int = 1440
) -> Belief:
    """Belief at a known position (section III.D)."""
    return normalised(*log_joint(model, seen, object_xy, bins))


def cell_belief(
    model: ClassModel,
    seen: Sequence[Sighting],
    grid: Grid,
    cell: int,
    reach: Reach,
    *,
    bins: int = 1440,
) -> Belief:
    """Belief of one cell (section IV): the sightings whose footprint holds it, x its centre."""
    holding = [s for s in seen if footprint_holds(grid, cell, s, reach)]
    return belief_at(model, holding, center_of(grid, cell), bins)


@dataclass(frozen=True)
class ObjectBelief:
    """Joint belief of one object over cells, classes and orientation, normalised.

    ``log_background`` (cells,) and ``log_classes`` (cells, n, bins) [1/rad].
    """

    cells: list[int]
    log_background: FloatArray
    log_classes: FloatArray

    @property
    def class_probabilities(self) -> FloatArray:
        """(22), background first."""
        step = TURN / self.log_classes.shape[2]
        classes = np.exp(logsumexp(self.log_classes, axis=(0, 2))) * step
        return np.concatenate([[math.exp(float(logsumexp(self.log_background)))], classes])

    @property
    def cell_masses(self) -> FloatArray:
        """P(cell), (cells,)."""
        step = TURN / self.log_classes.shape[2]
        classes = np.exp(logsumexp(self.log_classes, axis=(1, 2))) * step
        return np.asarray(np.exp(self.log_background) + classes)

    def cell_masses_given(self, class_index: int) -> FloatArray:
        """P(cell | class), (cells,)."""
        rows = logsumexp(self.log_classes[:, class_index], axis=1)
        return np.asarray(np.exp(rows - logsumexp(rows)))

    def density(self, class_index: int) -> FloatArray:
        """Orientation density given a class, over all cells [1/rad], (bins,)."""
        row = logsumexp(self.log_classes[:, class_index], axis=0)
        return np.asarray(np.exp(row - logsumexp(row)) * len(row) / TURN)

    def joint_map(self) -> tuple[int, int, float]:
        """(24): class, flat cell, orientation of the greatest density."""
        place, k, b = np.unravel_index(int(np.argmax(self.log_classes)), self.log_classes.shape)
        return int(k), self.cells[place], TURN * float(b) / self.log_classes.shape[2]


def object_belief(
    model: ClassModel,
    seen: Sequence[Sighting],
    grid: Grid,
    reach: Reach,
    *,
    outside_probability: float,
    bins: int = 360,
) -> ObjectBelief:
    """One object somewhere in the cells that enough of its sightings point at.

    Those are the cells with at least half as many footprints as the cell that has most. Every
    sighting counts in each of them; in a cell outside its footprint it is multiplied by
    ``outside_probability``, for the background as for the classes. A sighting without direction
    points nowhere and costs nothing.
    """
    holds = {
        cell: [footprint_holds(grid, cell, s, reach) for s in seen]
        for cell in range(grid.rows * grid.columns)
    }
    most = max(sum(row) for row in holds.values())
    cells = [cell for cell, row in holds.items() if 2 * sum(row) >= most > 0]
    backgrounds, classes = [], []
    for cell in cells:
        background, joint = log_joint(model, seen, center_of(grid, cell), bins)
        outside = sum(
            not held and not math.isnan(s.right) for held, s in zip(holds[cell], seen, strict=True)
        )
        factor = outside * math.log(outside_probability)
        backgrounds.append(background + factor)
        classes.append(joint + factor)
    log_background, log_classes = np.array(backgrounds), np.array(classes)
    total = np.logaddexp(logsumexp(log_background), logsumexp(log_classes) + math.log(TURN / bins))
    return ObjectBelief(cells, log_background - total, log_classes - total)


def modes_of(density: FloatArray) -> list[Mode]:
    """Peaks of a circular density, each with what lies between the minima beside it.

    A minimum's own bin counts half to either side. The angle is the top of the parabola
    through the three highest log values, the std is about the mean within the basin.
    """
    bins = len(density)
    step = TURN / bins
    before, after = np.roll(density, 1), np.roll(density, -1)
    minima = np.flatnonzero((density < before) & (density <= after))
    if len(minima) == 0:
        raise ValueError("a density without minima has no modes")
    modes = []
    for low, high in zip(minima, [*minima[1:], minima[0] + bins], strict=True):
        basin = np.arange(low, high + 1)
        masses = density[basin % bins] * step
        masses[[0, -1]] *= 0.5
        mass = float(masses.sum())
        mean = float((masses * basin).sum() / mass)
        std = math.sqrt(float((masses * (basin - mean) ** 2).sum() / mass)) * step
        top = int(basin[int(np.argmax(density[basin % bins]))])
        with np.errstate(divide="ignore"):
            left, center, right = np.log(density[[(top - 1) % bins, top % bins, (top + 1) % bins]])
        curvature = left - 2.0 * center + right
        shift = 0.0 if not math.isfinite(curvature) else 0.5 * (left - right) / curvature
        modes.append(Mode(float((top + shift) * step % TURN), mass, std))
    return sorted(modes, key=lambda mode: -mode.mass)
