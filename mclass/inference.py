"""From measurements and a model to beliefs: the whole estimate without any file."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mclass.association import Group, associate
from mclass.drift import averaged, averaged_belief, sample_offsets, shifted
from mclass.evidence import Engine
from mclass.footprint import Grid, Pointing, covering_grid
from mclass.gridmap import grid_beliefs
from mclass.looks import Looks, object_looks
from mclass.model import PAPER, InferenceSettings, Model
from mclass.objects import ObjectFilter, known_position, pointed_cells
from mclass.observation import Recognition, paper_terms, robust_terms
from mclass.records import BoolArray, FloatArray, Frames, IntArray, LabelMeasurements
from mclass.results import BeliefBlock, ClassMaps, ObjectEstimate
from mclass.summary import Readout, summarise
from mclass.table import resolving_bins

_LITTLE_WORK = 3e6
"""So few numbers are added up faster than tables are built."""

UNEXPLAINED = "labels that no class returns together"


@dataclass(frozen=True)
class Problem:
    """Measurements ready for inference.

    Attributes:
        model: The whole model file.
        measurements: All that was read, explainable or not, in canonical order.
        used: Rows of ``measurements`` that some class can explain, (k,).
        looks: The measurements and, where silence counts, the frames.
        engine: Sums evidence of looks.
        grid: The cells, or None when no measurement points anywhere.
    """

    model: Model
    measurements: LabelMeasurements
    used: IntArray
    looks: Looks
    engine: Engine
    grid: Grid | None


def prepare(model: Model, measurements: LabelMeasurements) -> Problem:
    """Set up inference; a label set that no class can return takes part in nothing.

    Rows are brought into one order first, so that the order they come in matters to no bit.
    """
    measurements = measurements.in_canonical_order()
    settings, frames = model.inference, measurements.frames
    returned = _label_weights(PAPER, measurements) > 0.0
    used = np.arange(len(measurements))
    if not settings.probabilities:
        used = np.flatnonzero(_explainable(model, returned))
    directions = measurements.directions.copy()
    directions[np.setdiff1d(np.arange(len(measurements)), used)] = np.nan
    views = frames.view_directions if settings.silence else np.full((len(frames), 2), np.nan)
    owners = np.concatenate([measurements.frame_index, np.arange(len(frames))])
    poses = frames.poses_world_sensor[owners]
    pointing = Pointing(
        positions=poses[:, :2],
        headings=poses[:, 2],
        directions=np.concatenate([directions, views]),
        min_range=model.grid.min_range,
        max_range=model.grid.max_range,
        rays=model.grid.footprint == "ray",
    )
    covariances = _covariances(settings, frames)
    if covariances is not None:
        covariances = covariances[owners]
    looks = Looks(
        pointing, owners, frames.stamps_ns[owners], len(measurements), settings, covariances
    )
    if settings.probabilities:
        recognition = Recognition(settings.detection_probability, settings.false_alarm)
        terms = robust_terms(model.classes, recognition)
    else:
        terms = paper_terms(model.classes)
    term_weights = np.zeros((len(owners), len(terms)))
    term_weights[: len(measurements), : returned.shape[1]] = _label_weights(settings, measurements)
    term_weights[len(measurements) :, returned.shape[1] :] = 1.0
    engine = Engine(
        terms=terms,
        n_classes=len(model.classes.class_names),
        bins=resolving_bins(
            terms, model.grid.orientation_bins, model.grid.min_range, model.grid.max_range
        ),
        pointing=pointing,
        term_weights=term_weights,
        position_covariances=None if covariances is None else covariances[:, :2, :2],
        reported_bins=model.grid.orientation_bins,
    )
    if _work(engine, model.grid.cell_size) < _LITTLE_WORK:
        engine = replace(engine, direct=True)
    grid = _grid(model, pointing.select(np.arange(len(measurements))))
    return Problem(model, measurements, used, looks, engine, grid)


def _work(engine: Engine, cell_size: float) -> float:
    """How many numbers direct evaluation would add up, roughly and at most."""
    pointing = engine.pointing
    widths = pointing.widths[np.isfinite(pointing.directions).all(axis=1)]
    near, far = pointing.min_range, pointing.max_range
    cells = widths / 2.0 * (far**2 - near**2) / cell_size**2 + 2.0 * (far - near) / cell_size
    # Every look at an object is evaluated at every cell that any look at it points at.
    pairs = cells.sum() * (1 + len(widths))
    return float(pairs) * engine.n_classes * engine.bins


def _label_weights(settings: InferenceSettings, measurements: LabelMeasurements) -> FloatArray:
    """How much each label of each measurement counts, 0 if not returned, (n, labels)."""
    matrix = np.zeros((len(measurements), len(measurements.label_names)))
    owners = np.repeat(np.arange(len(measurements)), np.diff(measurements.label_offsets))
    weights = np.ones(len(owners))
    if settings.score_weights:
        scores, levels = np.array(settings.score_weights).T
        weights = np.interp(measurements.scores, scores, levels)
    matrix[owners, measurements.labels] = weights
    return matrix


def _covariances(settings: InferenceSettings, frames: Frames) -> FloatArray | None:
    """Covariance of the pose of every frame, drift included, (f, 3, 3); None if not wanted."""
    if not settings.pose_uncertainty or len(frames) == 0:
        return None
    if frames.covariances is None and settings.drift == 0.0:
        return None
    known = np.zeros((len(frames), 3, 3)) if frames.covariances is None else frames.covariances
    seconds = (frames.stamps_ns - frames.stamps_ns[0]) * 1e-9
    drift = (settings.drift**2 * seconds)[:, None, None] * np.diag([1.0, 1.0, 0.0])
    return np.asarray(known + drift)


def _explainable(model: Model, has_label: BoolArray) -> BoolArray:
    """Whether at least one class can return every label of a measurement, (n,)."""
    cannot = np.ones((len(model.classes.class_names), has_label.shape[1]), dtype=bool)
    for class_index, label in model.classes.likelihoods:
        cannot[class_index, label] = False
    return np.asarray((has_label @ cannot.T.astype(np.int64) == 0).any(axis=1))


def _grid(model: Model, pointing: Pointing) -> Grid | None:
    """The grid that the model names, or one that covers every footprint."""
    settings = model.grid
    if settings.origin is None or settings.size is None:
        return covering_grid(pointing, settings.cell_size)
    columns, rows = (max(1, round(length / settings.cell_size)) for length in settings.size)
    return Grid(settings.origin, settings.cell_size, rows, columns)


def estimate_objects(
    problem: Problem,
    *,
    history: bool = True,
    watch: Callable[[ObjectEstimate, Readout], None] | None = None,
) -> tuple[list[ObjectEstimate], list[BeliefBlock]]:
    """Follow every object with an id through its measurements.

    Args:
        problem: From `prepare`.
        history: An estimate after every measurement; else after each object's last alone,
            which takes a fraction of the time.
        watch: Called with every estimate and the belief that it sums up, object by object.

    Returns:
        An estimate after every update, in the order of the measurements; and each object's
        full belief at the end. An object that no measurement points at, and whose position
        is not known, has neither.
    """
    measurements, model = problem.measurements, problem.model
    updates: list[tuple[int, ObjectEstimate]] = []
    beliefs: list[BeliefBlock] = []
    variants = _trajectories(problem)
    for object_id, group in object_groups(problem):
        rows, shares = group.rows, group.shares
        position = model.objects.get(object_id)
        if position is not None:
            candidates = known_position(position, model.grid.cell_size)
        else:
            found = None
            if problem.grid is not None:
                found = pointed_cells(problem.grid, problem.looks.pointing, rows)
            if found is None:
                continue
            candidates = found
        trackers = [
            ObjectFilter(
                variant.engine,
                object_looks(variant.looks, rows, shares, known=candidates.known),
                candidates,
                model.classes.log_priors,
            )
            for variant in variants
        ]
        stamps, log_times = measurements.stamps_ns[rows], measurements.log_times_ns[rows]
        first = 0 if history else len(rows) - 1
        steps = (
            zip(*(tracker.steps() for tracker in trackers), strict=True)
            if history
            else [tuple(tracker.finish() for tracker in trackers)]
        )
        for step, readouts in enumerate(steps, start=first):
            row = int(rows[step])
            readout = averaged(readouts)
            estimate = summarise(
                readout,
                object_id=object_id,
                stamp_ns=int(stamps[step]),
                log_time_ns=int(log_times[step]),
                labels=measurements.label_names_of(row),
                measurements=step + 1,
                cell_size=model.grid.cell_size,
                known=candidates.known,
            )
            updates.append((row, estimate))
            if watch is not None:
                watch(estimate, readout)
        last = updates[-1][1]
        blocks = [tracker.belief(last) for tracker in trackers]
        beliefs.append(averaged_belief(blocks, [tracker.log_evidence for tracker in trackers]))
    updates.sort(key=lambda update: update[0])
    return [estimate for _, estimate in updates], beliefs


def _trajectories(problem: Problem) -> list[Problem]:
    """The problem as it stands or, where poses err together, for every sampled trajectory."""
    model, measurements = problem.model, problem.measurements
    settings = replace(model.inference, pose_uncertainty=True)
    covariances = _covariances(settings, measurements.frames)
    if model.inference.trajectory_samples == 0 or covariances is None:
        return [problem]
    exact = replace(model, inference=replace(model.inference, drift=0.0))
    offsets = sample_offsets(covariances, model.inference.trajectory_samples)
    return [prepare(exact, shifted(measurements, offset)) for offset in offsets]


def object_groups(problem: Problem) -> Iterator[tuple[str, Group]]:
    """The detections of each object: those with its id or, in a log without ids, its share."""
    measurements = problem.measurements
    owner = measurements.object_index[problem.used]
    for index, object_id in enumerate(measurements.object_ids):
        rows = problem.used[owner == index]
        if len(rows):
            yield object_id, Group(rows, np.ones(len(rows)))
    if problem.model.inference.association and problem.grid is not None and (owner < 0).all():
        located = np.isfinite(problem.looks.pointing.directions[problem.used]).all(axis=1)
        groups = associate(
            problem.engine,
            problem.looks,
            problem.grid,
            problem.model.classes.log_priors,
            problem.used[located],
        )
        for number, group in enumerate(groups, start=1):
            yield f"object-{number}", group


@dataclass(frozen=True)
class Cut:
    """A moment at which maps are written."""

    stamp_ns: int
    log_time_ns: int


def cuts_every(measurements: LabelMeasurements, period_ns: int | None) -> list[Cut]:
    """The end, and before it every ``period_ns`` after the first measurement."""
    stamps, log_times = measurements.stamps_ns, measurements.log_times_ns
    if len(stamps) == 0:
        return []
    counts = [len(stamps)]
    if period_ns is not None:
        moments = np.arange(stamps[0] + period_ns, stamps[-1], period_ns)
        counts = np.unique([*np.searchsorted(stamps, moments, side="right"), len(stamps)]).tolist()
    return [Cut(int(stamps[n - 1]), int(log_times[n - 1])) for n in counts]


class GridEstimate:
    """The grid's beliefs, streamed as blocks; the class maps grow beside them."""

    def __init__(self, problem: Problem, cuts: Sequence[Cut], threads: int = 1) -> None:
        self._problem = problem
        self._cuts = cuts
        self._threads = threads
        self._cells: list[list[IntArray]] = [[] for _ in cuts]
        self._classes: list[list[FloatArray]] = [[] for _ in cuts]

    def blocks(self) -> Iterator[BeliefBlock]:
        """Full beliefs, tile by tile, each at every cut."""
        problem = self._problem
        if problem.grid is None:
            return
        priors = problem.model.classes.log_priors
        stamps = [cut.stamp_ns for cut in self._cuts]
        for tile in grid_beliefs(
            problem.engine, problem.looks, problem.grid, priors, stamps, self._threads
        ):
            for index, (cut, belief) in enumerate(zip(self._cuts, tile, strict=True)):
                self._cells[index].append(belief.cells)
                self._classes[index].append(belief.posterior.log_class_probability)
                yield BeliefBlock(
                    object_id="",
                    grid=problem.grid,
                    stamp_ns=cut.stamp_ns,
                    log_time_ns=cut.log_time_ns,
                    block=belief.tile,
                    blocks=belief.tiles,
                    cells=belief.cells,
                    log_cell_mass=np.zeros(len(belief.cells)),
                    log_class_probability=belief.posterior.log_class_probability,
                    log_density=belief.posterior.log_density.astype(np.float32),
                    measurements=belief.measurements,
                )

    def maps(self) -> list[ClassMaps]:
        """The class maps of every cut, once all blocks have been taken."""
        problem = self._problem
        if problem.grid is None:
            return []
        result = []
        for cut, cells, classes in zip(self._cuts, self._cells, self._classes, strict=True):
            every = np.concatenate(cells) if cells else np.zeros(0, dtype=np.int64)
            if len(every) == 0:
                continue
            order = np.argsort(every)
            probabilities = np.exp(np.concatenate(classes)[order])
            result.append(
                ClassMaps(
                    grid=problem.grid,
                    stamp_ns=cut.stamp_ns,
                    log_time_ns=cut.log_time_ns,
                    cells=every[order],
                    class_probabilities=probabilities / probabilities.sum(axis=1, keepdims=True),
                    untouched=np.exp(problem.model.classes.log_priors),
                )
            )
        return result
