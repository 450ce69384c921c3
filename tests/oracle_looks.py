"""The robust observation model by brute force: each label is a separate yes or no at every look."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from oracle import (
    TURN,
    Reach,
    Sighting,
    in_cone,
    label_likelihood,
    log_label_likelihood,
    orientations,
    sightings,
    wrapped,
)
from scipy.optimize import minimize

from mclass.classes import ClassModel
from mclass.records import FloatArray, LabelMeasurements


def peak_density(model: ClassModel, class_index: int) -> float:
    """s_k: the greatest p(label | class, viewpoint) over labels and viewpoints.

    Found by climbing from every viewpoint's mean, without trusting that a mixture peaks there.
    """
    best = -math.inf
    labels = [label for (k, label) in model.likelihoods if k == class_index]
    for label in labels:
        mixture = model.likelihoods[class_index, label].mixture

        def loss(view: FloatArray, label: int = label) -> float:
            bearing = view[2] if len(view) == 3 else 0.0
            sighting = Sighting((), view[:2], math.atan2(-view[1], -view[0]) - bearing)
            pair = (class_index, label)
            return -float(log_label_likelihood(model, pair, sighting, np.zeros(2), 0.0))

        for m in range(len(mixture.weights)):
            turned = np.isfinite(mixture.bearing_variances).any()
            start = np.array([*mixture.means[m], mixture.bearing_means[m]][: 3 if turned else 2])
            simplex = start + 0.1 * np.eye(len(start) + 1, len(start), -1)
            found = minimize(
                loss,
                start,
                method="Nelder-Mead",
                options={"xatol": 1e-5, "fatol": 1e-10, "initial_simplex": simplex},
            )
            best = max(best, -float(found.fun), -loss(start))
    return math.exp(best)


def look_log_probability(
    model: ClassModel,
    class_index: int | None,
    sighting: Sighting,
    object_xy: FloatArray,
    phi: FloatArray,
    *,
    detection_probability: float = 0.95,
    false_alarm: float = 0.01,
    peak: float | None = None,
) -> FloatArray:
    """Log P(look | class, viewpoint): each of the model's labels is a separate yes or no.

    ``class_index`` None is the background; an empty label set is a look that returned nothing;
    ``peak`` is `peak_density` if already known. Shape of ``phi``.
    """
    total = np.zeros(np.shape(phi))
    if class_index is not None and peak is None:
        peak = peak_density(model, class_index)
    for label in range(len(model.label_names)):
        if class_index is None or peak is None:
            probability = np.full(np.shape(phi), false_alarm)
        else:
            density = label_likelihood(model, (class_index, label), sighting, object_xy, phi)
            hit = detection_probability * density / peak
            probability = false_alarm + (1.0 - false_alarm) * hit
        probability = np.clip(probability, 1e-6, 1.0 - 1e-3)
        total += np.log(probability if label in sighting.labels else 1.0 - probability)
    return total


def look_weights(
    seen: Sequence[Sighting], object_xy: FloatArray, range_scale: float, direction_scale: float
) -> FloatArray:
    """How much each look counts beside its neighbours in range and direction, (looks,)."""
    offsets = [s.sensor_xy - object_xy for s in seen]
    ranges = [math.hypot(*offset) for offset in offsets]
    directions = [math.atan2(offset[1], offset[0]) for offset in offsets]
    weights = np.empty(len(seen))
    for i in range(len(seen)):
        crowd = 0.0
        for j in range(len(seen)):
            apart = (ranges[i] - ranges[j]) / range_scale
            turned = wrapped(directions[i] - directions[j]) / direction_scale
            crowd += math.exp(-0.5 * (apart**2 + turned**2))
        weights[i] = 1.0 / crowd
    return weights


@dataclass(frozen=True)
class Frame:
    """One image: where from, the borders of its view, what it returned and of which object (id)."""

    sensor_xy: FloatArray
    heading: float
    right: float
    left: float
    position_covariance: FloatArray | None
    returned: tuple[tuple[Sighting, int], ...]

    @property
    def silent(self) -> Sighting:
        """The frame as a look that returned nothing."""
        borders = self.right, self.left
        return Sighting((), self.sensor_xy, self.heading, *borders, self.position_covariance)


def frames_of(measurements: LabelMeasurements) -> list[Frame]:
    """The columns frame by frame."""
    seen = sightings(measurements)
    frames = measurements.frames
    result = []
    for f in range(len(frames)):
        rows = [row for row in range(len(seen)) if measurements.frame_index[row] == f]
        x, y, heading = frames.poses_world_sensor[f]
        right, left = frames.view_directions[f]
        returned = tuple((seen[row], int(measurements.object_index[row])) for row in rows)
        blur = None if frames.covariances is None else frames.covariances[f][:2, :2]
        result.append(Frame(np.array([x, y]), heading, right, left, blur, returned))
    return result


@dataclass(frozen=True)
class Robust:
    """Settings of the robust filter that matter here; lengths [m], angles [rad]."""

    near: float
    far: float
    widths: tuple[float, float]
    margin: float
    outside: float
    pointing_std: float


def off_axis(point: FloatArray, sighting: Sighting) -> float:
    """Angle between the direction to a point and the middle of a box."""
    dx, dy = point - sighting.sensor_xy
    middle = sighting.right + 0.5 * ((sighting.left - sighting.right) % TURN)
    return abs(wrapped(math.atan2(dy, dx) - middle))


def half_width(sighting: Sighting) -> float:
    """Half the opening of a box."""
    return 0.5 * ((sighting.left - sighting.right) % TURN)


def in_view(frame: Frame, point: FloatArray, settings: Robust) -> bool:
    """Whether a point is in the image, a margin inside its borders."""
    view = frame.silent
    if not in_cone(point, view, Reach(settings.near, settings.far)):
        return False
    distance = math.dist(point, frame.sensor_xy)
    border = math.asin(min(1.0, settings.margin / distance))
    return off_axis(point, view) <= half_width(view) - border


@dataclass(frozen=True)
class Look:
    """One look at a place: what was returned, and the weights of its labels and of the frame."""

    sighting: Sighting
    labels: float
    frame: float


def weighed(
    model: ClassModel,
    peaks: Sequence[float],
    looks: Sequence[Look],
    object_xy: FloatArray,
    bins: int,
) -> tuple[float, FloatArray]:
    """Log likelihood times prior of looks of which each counts so much, as `oracle.log_joint`.

    ``peaks`` holds the `peak_density` of every class.
    """
    phi = orientations(bins)

    def total(k: int | None) -> FloatArray:
        value = np.zeros(bins)
        for look in looks:
            peak = None if k is None else peaks[k]
            silent = replace(look.sighting, labels=())
            nothing = look_log_probability(model, k, silent, object_xy, phi, peak=peak)
            whole = look_log_probability(model, k, look.sighting, object_xy, phi, peak=peak)
            value += look.frame * nothing + look.labels * (whole - nothing)
        return value

    classes = np.array([total(k) for k in range(len(model.class_names))])
    priors = model.log_priors[1:, None] - math.log(TURN)
    return float(model.log_priors[0] + total(None)[0]), classes + priors


def looks_at_cell(frames: Sequence[Frame], point: FloatArray, settings: Robust) -> list[Look]:
    """A cell of the grid: every frame that had it in view, or in one of its boxes."""
    reach = Reach(settings.near, settings.far)
    held = [[s for s, _ in frame.returned if in_cone(point, s, reach)] for frame in frames]
    looked = [f for f, frame in enumerate(frames) if held[f] or in_view(frame, point, settings)]
    weights = look_weights([frames[f].silent for f in looked], point, *settings.widths)
    looks = []
    for weight, f in zip(weights, looked, strict=True):
        looks.append(Look(frames[f].silent, 0.0, weight))
        looks += [Look(sighting, weight, 0.0) for sighting in held[f]]
    return looks


def looks_at_object(
    frames: Sequence[Frame], key: int, point: FloatArray, settings: Robust, *, known: bool
) -> tuple[list[Look], float, int]:
    """An object at a place: its looks, the log of what pointing costs, and how often it is hit.

    A box that points elsewhere is of something else the more, the farther off it points: its
    labels count for less, and so does the frame unless the place was in view and free.
    """
    reach, floor = Reach(settings.near, settings.far), math.log(settings.outside)
    entries: list[tuple[Frame, Sighting, float, float, float]] = []
    hits = 0
    for frame in frames:
        own = [sighting for sighting, owner in frame.returned if owner == key]
        rivals = [sighting for sighting, owner in frame.returned if owner != key]
        free = in_view(frame, point, settings) and not any(
            off_axis(point, rival) <= half_width(rival) for rival in rivals
        )
        if not own:
            if free:
                entries.append((frame, frame.silent, 0.0, 0.0, 1.0))
            continue
        cost = 0.0
        if not in_cone(point, own[0], reach):
            distance = math.dist(point, frame.sensor_xy)
            cost = floor
            if settings.near <= distance <= settings.far:
                excess = off_axis(point, own[0]) - half_width(own[0])
                cost = max(floor, -0.5 * (excess / settings.pointing_std) ** 2)
        else:
            hits += 1
        belongs = (1.0 - settings.outside / math.exp(cost)) / (1.0 - settings.outside)
        if known:
            cost, belongs = 0.0, 1.0
        entries.append((frame, own[0], cost, belongs, 1.0 if free else belongs))
    weights = look_weights([frame.silent for frame, *_ in entries], point, *settings.widths)
    looks, log_outer = [], 0.0
    for weight, (_, sighting, cost, labels, whole) in zip(weights, entries, strict=True):
        looks.append(Look(sighting, weight * labels, weight * whole))
        log_outer += weight * cost
    return looks, log_outer, hits
