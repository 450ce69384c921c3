"""How right, and how honest about it: majority vote, the plain paper and the robust filter.

    python tests/benchmarks/calibration.py [--logs 40] [--without-ids 12] [--rendered FOLDER]

Simulated drives past boxes, in several sets. The simulator is not the model: it recognises over
flat sectors or round lobes, cut off by distance, errs alike for as long as the view stays
alike, misses, flips labels, sees what is not there, and drifts. The model that inference gets
holds Gaussians; the plain paper is also told that there is an object, since by its background
constant there hardly ever is. Everything is computed in memory. With a folder of recorded
logs (``*_0.mcap`` with ``truth_0.json`` beside it) these make one more set. Some logs of each set
are also estimated with all ids withheld; ``--parts`` switches parts of the robust filter off.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.special import logsumexp

from mclass.config.model_file import load_model, parse_model
from mclass.evaluation.density import JointDensity, joint_density
from mclass.evaluation.scores import LogScore, score_log
from mclass.evaluation.summary import Figure, evaluate
from mclass.evaluation.truth import Truth, load_truth
from mclass.geometry import wrap_angle
from mclass.inference import estimate_objects, prepare
from mclass.logs.measurements import read_measurements
from mclass.logs.reader import LogReader
from mclass.model import PAPER, ROBUST, InferenceSettings, Model
from mclass.records import LabelMeasurements
from mclass.results import ObjectEstimate, OrientationMode
from mclass.simulation.scenario import (
    Camera,
    Correlation,
    Errors,
    LookAt,
    Odometry,
    Recogniser,
    Response,
    Scenario,
    SceneObject,
    Trajectory,
)
from mclass.simulation.world import Truth as WorldTruth
from mclass.simulation.world import simulate_measurements

BOXES = Path(__file__).parents[2] / "configs" / "boxes.yaml"
PROCESSES = 2


@dataclass(frozen=True)
class Method:
    """What is compared: settings of inference, None for the vote; and whether it sees ids."""

    settings: InferenceSettings | None
    ids: bool = True


VOTE, PLAIN, DEFAULT, WITHHELD = "majority vote", "plain paper", "robust", "robust, ids withheld"
METHODS: Mapping[str, Method] = {
    VOTE: Method(None),
    PLAIN: Method(PAPER),
    DEFAULT: Method(ROBUST),
    WITHHELD: Method(ROBUST, ids=False),
    "without weights": Method(replace(ROBUST, correlation=None)),
    "without silence": Method(replace(ROBUST, silence=False)),
    "without soft pointing": Method(replace(ROBUST, pointing_std=0.0)),
    "with pose covariance": Method(replace(ROBUST, pose_uncertainty=True)),
}
COMPARED = (VOTE, PLAIN, DEFAULT)
RESAMPLES = 2000

FRONT, LEFT, BACK = np.pi / 2.0, np.pi, -np.pi / 2.0
ROWS = ((0.9, 0.35, 0.15, 0.1), (1.5, 0.9, 0.25, 0.2), (2.3, 1.8, 0.4, 0.34), (3.2, 2.8, 0.5, 0.36))
"""Gaussians of one side: distance, variance across and along, share of the side's weight."""


ERRORS = Errors(miss=0.02, label_noise=0.02, clutter=0.05, clutter_with_id=0.3)
CORRELATION = Correlation(direction=np.radians(12.0), distance=0.3, independent=0.2)
ODOMETRY = Odometry(
    position_by_distance=0.02,
    heading_by_distance=np.radians(0.4),
    heading_by_turn=np.radians(0.6),
)


@dataclass(frozen=True)
class Setting:
    """One set of simulated drives.

    Attributes:
        response: A side's response given its direction and whether it is shared.
        rows: Gaussians of one side in the model, as `ROWS`.
        one_sided: Share of objects that are seen from one side only.
        errors: Of the detector.
        correlation: Of its errors.
        odometry: Its errors.
        near: Range below which recognition fades [m].
        far: Range beyond which it fades [m].
    """

    response: Callable[[float], Response]
    rows: Sequence[tuple[float, float, float, float]] = ROWS
    one_sided: float = 0.3
    errors: Errors = ERRORS
    correlation: Correlation = CORRELATION
    odometry: Odometry = ODOMETRY
    near: float = 0.7
    far: float = 3.0


def _flat(direction: float) -> Response:
    return Response(direction, half_width=np.radians(46))


def _narrow(direction: float) -> Response:
    return Response(direction, half_width=np.radians(38), peak=0.9, edge=0.15)


def _lobe(direction: float) -> Response:
    return Response(direction, half_width=np.radians(45), shape="von_mises", peak=0.9)


SETS: Mapping[str, Setting] = {
    "flat sectors": Setting(_flat),
    "round lobes": Setting(_lobe, rows=((1.4, 0.8, 0.8, 1.0),), near=0.5, far=3.5),
    "one side seen": Setting(_flat, one_sided=0.9),
    "long errors": Setting(
        _narrow,
        errors=Errors(
            miss=0.08, label_noise=0.05, clutter=0.05, clutter_with_id=0.3, wrong_id=0.02
        ),
        correlation=Correlation(direction=np.radians(25), distance=0.6, independent=0.1),
        far=2.6,
    ),
    "drift": Setting(
        _flat,
        odometry=Odometry(
            position_by_distance=0.04,
            heading_by_distance=np.radians(0.8),
            heading_by_turn=np.radians(1.2),
            heading_drift=np.radians(0.1),
        ),
    ),
}


def sides(n_classes: int) -> dict[tuple[str, str], tuple[float, ...]]:
    """From which directions each label is returned of each class, by (class, label).

    Two classes make a pair with the same front; an odd one out shows its label in front and
    on its left.
    """
    names = [f"c{k}" for k in range(n_classes)]
    table: dict[tuple[str, str], tuple[float, ...]] = {}
    for k, name in enumerate(names):
        partner = k ^ 1
        if partner < n_classes:
            table[name, name] = (FRONT, BACK)
            table[name, names[partner]] = (FRONT,)
        else:
            table[name, name] = (FRONT, LEFT)
    return table


@lru_cache
def model_of(n_classes: int, rows: tuple[tuple[float, float, float, float], ...]) -> Model:
    """The model file that somebody would write for these classes."""
    names = {FRONT: "front", LEFT: "left", BACK: "back"}
    lines = ["background: {likelihood: 0.01}", "viewpoints:"]
    for direction, name in names.items():
        axis = np.array([np.cos(direction), np.sin(direction)]).round()
        for i, (distance, across, along, _) in enumerate(rows):
            x, y = distance * axis
            xx, yy = (across, along) if axis[0] == 0.0 else (along, across)
            lines.append(f"  {name}{i}: {{position: [{x}, {y}], covariance: [{xx}, {yy}]}}")
    lines.append("classes:")
    table = sides(n_classes)
    for owner in dict.fromkeys(name for name, _ in table):
        lines += [f"  {owner}:", "    labels:"]
        for (name, label), directions in table.items():
            if name == owner:
                views = ", ".join(
                    f"{names[direction]}{i}: {0.5 * row[3]:.4f}"
                    for direction in directions
                    for i, row in enumerate(rows)
                )
                lines.append(
                    f"      {label}: {{probability: 0.9, clutter: 0.003, views: {{{views}}}}}"
                )
    lines.append("grid: {range: [0.4, 4.0]}")
    return parse_model("\n".join(lines), f"{n_classes} classes")


def scenario(setting: Setting, seed: int) -> Scenario:
    """A random drive past a random layout."""
    rng = np.random.default_rng([seed, 17])
    n_classes = int(rng.integers(2, 5))
    table = sides(n_classes)
    names = list(dict.fromkeys(name for name, _ in table))
    objects: list[SceneObject] = []
    stops: list[list[LookAt]] = []
    for index in range(int(rng.integers(3, 7))):
        place = rng.uniform(-3.0, 3.0, 2)
        while any(np.hypot(*(place - other.position)) < 1.7 for other in objects):
            place = rng.uniform(-3.5, 3.5, 2)
        name = names[int(rng.integers(n_classes))]
        key, wall = f"o{index}", bool(rng.random() < setting.one_sided)
        orientation = float(rng.uniform(0.0, 2.0 * np.pi))
        objects.append(SceneObject(key, name, (place[0], place[1]), orientation, against_wall=wall))
        # One of the sides on which there is something to see looks away from the wall.
        shown = table[name, name]
        outward = orientation + shown[int(rng.integers(len(shown)))] + rng.uniform(-0.6, 0.6)
        reach = np.radians(50.0) if wall else np.pi
        stops.append(
            [
                LookAt(
                    key,
                    direction=float(outward + rng.uniform(-reach, reach)),
                    distance=float(rng.uniform(0.9, 2.5)),
                    wait=float(rng.uniform(0.5, 4.0)),
                )
                for _ in range(int(rng.integers(2, 6)))
            ]
        )
    # Objects are visited one after the other, twice over.
    rounds = [rng.permutation(len(objects)) for _ in range(2)]
    halves = [[looks[: len(looks) // 2], looks[len(looks) // 2 :]] for looks in stops]
    ordered = [look for part, order in enumerate(rounds) for o in order for look in halves[o][part]]
    return Scenario(
        name=f"random drive {seed}",
        objects=tuple(objects),
        trajectory=Trajectory(tuple(ordered)),
        detector=Recogniser(
            responses={
                key: tuple(setting.response(direction) for direction in directions)
                for key, directions in table.items()
            },
            near=setting.near,
            far=setting.far,
            correlation=setting.correlation,
            errors=setting.errors,
        ),
        odometry=setting.odometry,
        camera=Camera(box_noise=4.0),
    )


def majority_vote(
    measurements: LabelMeasurements, class_names: Sequence[str], bins: int
) -> tuple[list[ObjectEstimate], dict[str, JointDensity]]:
    """Class by its label's share of all returned, one vote added to each; facing anywhere."""
    owners = np.repeat(measurements.object_index, np.diff(measurements.label_offsets))
    votes = [measurements.label_names.index(name) for name in class_names]
    estimates, densities = [], {}
    for index, key in enumerate(measurements.object_ids):
        rows = np.flatnonzero(measurements.object_index == index)
        if len(rows) == 0:
            continue
        counts = np.bincount(measurements.labels[owners == index], minlength=len(votes))[votes]
        shares = (counts + 1.0) / (counts.sum() + len(votes))
        tie = np.flatnonzero(counts == counts.max())
        estimates.append(
            ObjectEstimate(
                object_id=key,
                stamp_ns=0,
                log_time_ns=0,
                labels=(),
                measurements=len(rows),
                class_probabilities=np.array([0.0, *shares]),
                class_index=int(tie[0]),
                tie=tuple(tie.tolist()) if len(tie) > 1 else (),
                position=np.full(2, np.nan),
                position_std=np.full(2, np.nan),
                class_poses=np.zeros((len(votes), 3)),
                modes=(OrientationMode(0.0, 1.0, np.pi / np.sqrt(3.0)),),
                joint_map=(int(tie[0]), 0.0, 0.0, 0.0),
            )
        )
        flat = np.full((len(votes), bins), -np.log(2.0 * np.pi))
        with np.errstate(divide="ignore"):
            densities[key] = JointDensity(np.log([0.0, *shares]), flat)
    return estimates, densities


@dataclass(frozen=True)
class Result:
    """One method on one log: its score, seconds, and ids of objects whose class shows."""

    score: LogScore
    seconds: float
    telling: frozenset[str]


def scores_of(
    log: str,
    model: Model,
    measurements: LabelMeasurements,
    truth: Truth,
    telling: frozenset[str],
    methods: Sequence[str],
) -> dict[str, Result]:
    """Every method on one log; ``telling``: objects seen from more than a shared side."""
    result = {}
    names = model.classes.class_names
    nameless = replace(measurements, object_index=np.full(len(measurements), -1), object_ids=())
    for name in methods:
        method = METHODS[name]
        start = time.perf_counter()
        if method.settings is None:
            estimates, densities = majority_vote(measurements, names, model.grid.orientation_bins)
        else:
            given = measurements if method.ids else nameless
            told = _certain_of_objects(model) if method.settings is PAPER else model
            problem = prepare(replace(told, inference=method.settings), given)
            estimates, blocks = estimate_objects(problem, history=False)
            densities = {block.object_id: joint_density([block]) for block in blocks}
        seconds = time.perf_counter() - start
        match: Literal["id", "position"] = "id" if method.ids else "position"
        score = score_log(log, estimates, densities, names, truth, match=match)
        result[name] = Result(score, seconds, telling)
    return result


def _certain_of_objects(model: Model) -> Model:
    """The model without "nothing here", which wins by far over many densities multiplied.

    Unless no class could have returned all labels: then it is the only explanation left.
    """
    priors = model.classes.log_priors.copy()
    priors[0] = -1e6
    return replace(model, classes=replace(model.classes, log_priors=priors - logsumexp(priors)))


def simulated(task: tuple[str, int, Sequence[str]]) -> dict[str, Result]:
    """Every method on one simulated drive, given the set's name and a seed."""
    name, seed, methods = task
    setting = SETS[name]
    seed += 1000 * list(SETS).index(name)
    drive = scenario(setting, seed)
    measurements, world = simulate_measurements(drive, seed)
    classes = sorted({owner for owner, _ in drive.detector.responses})  # type: ignore[union-attr]
    model = model_of(len(classes), tuple(setting.rows))
    seen = [o for o in range(len(world.object_ids)) if np.sum(measurements.object_index == o) >= 3]
    truth = Truth(
        object_ids=tuple(world.object_ids[o] for o in seen),
        class_names=tuple(world.class_names[o] for o in seen),
        poses=world.poses[seen],
        symmetry=np.full(len(seen), 2),
    )
    telling = frozenset(
        world.object_ids[o] for o in seen if _shows_class(drive, measurements, world, o)
    )
    return scores_of(f"{name} {seed}", model, measurements, truth, telling, methods)


def _shows_class(
    drive: Scenario, measurements: LabelMeasurements, world: WorldTruth, index: int
) -> bool:
    """Whether at least three detections of an object are from a side that only its class has."""
    name = world.class_names[index]
    table = sides(len({owner for owner, _ in drive.detector.responses}))  # type: ignore[union-attr]
    shared = {d for (owner, label), ds in table.items() if owner == name != label for d in ds}
    own = np.array([d for d in table[name, name] if d not in shared])
    frames = measurements.frame_index[measurements.object_index == index]
    x, y, orientation = world.poses[index]
    offsets = world.poses_world_sensor[frames, :2] - (x, y)
    aspects = np.arctan2(offsets[:, 1], offsets[:, 0]) - orientation
    away = np.abs(wrap_angle(aspects[:, None] - own))
    return int(np.sum(away.min(axis=1) < np.radians(45.0))) >= 3


def recorded(task: tuple[Path, Path, Sequence[str]]) -> dict[str, Result]:
    """Every method on one recorded log, given its path and that of its truth."""
    log, truth_path, methods = task
    model = load_model(BOXES)
    truth = load_truth(truth_path)
    truth = replace(truth, symmetry=np.full(len(truth), 2))
    with LogReader.open(log) as reader:
        measurements = read_measurements(reader, model).measurements
    return scores_of(log.name, model, measurements, truth, frozenset(truth.object_ids), methods)


def recorded_tasks(folder: Path) -> Iterator[tuple[Path, Path]]:
    """Logs with their truth: the last number in the names is the same."""
    truths = {
        number.group(1): path
        for path in sorted(folder.glob("truth*.json"))
        if (number := re.search(r"(\d+)\D*$", path.stem))
    }
    for log in sorted(folder.glob("*.mcap")):
        number = re.search(r"(\d+)\D*$", log.stem)
        if number and number.group(1) in truths:
            yield log, truths[number.group(1)]


COLUMNS: Sequence[tuple[str, str, str]] = (
    ("class right", "class_accuracy", "{:.3f}"),
    ("φ off by", "orientation_error_deg", "{:.1f}°"),
    ("90 % within", "orientation_error_90_deg", "{:.0f}°"),
    ("mod 180°", "symmetric_error_deg", "{:.1f}°"),
    ("90 % within", "symmetric_error_90_deg", "{:.0f}°"),
    ("place", "position_error", "{:.2f} m"),
    ("−log p(c, φ)", "log_loss", "{:.2f}"),
    ("in 50 %", "coverage_50", "{:.2f}"),
    ("in 90 %", "coverage_90", "{:.2f}"),
    ("in 99 %", "coverage_99", "{:.2f}"),
    ("ECE", "calibration_error", "{:.3f}"),
    ("missed", "missed", "{:.0f}"),
)
Results = Sequence[Mapping[str, Result]]


def print_table(sets: Mapping[str, Results], methods: Sequence[str]) -> None:
    """Figures of every set, a method a line, as Markdown."""
    heads = [head for head, _, _ in COLUMNS]
    heads[1:1] = ["where it shows", "more than the vote"]
    print("| set | method | " + " | ".join(heads) + " | s/log |")
    print("|---|---|" + "---|" * (len(heads) + 1))
    for title, results in sets.items():
        objects = sum(len(log[DEFAULT].score.objects) for log in results)
        name = f"{title}: {len(results)} logs, {objects} objects"
        for method in methods:
            figures = evaluate([log[method].score for log in results]).figures
            cells = [_cell(figures[key], form) for _, key, form in COLUMNS]
            if METHODS[method].settings is None:
                cells[1:6] = ["–"] * 5
            cells[1:1] = [f"{_where_it_shows(results, method):.3f}", _gain(results, method)]
            seconds = np.mean([log[method].seconds for log in results])
            print(f"| {name} | {method} | " + " | ".join(cells) + f" | {seconds:.2f} |", flush=True)
            name = ""


def _where_it_shows(results: Results, method: str) -> float:
    """Class accuracy of objects that were seen from a side that only their class has."""
    found = [
        one.correct
        for log in results
        for one in log[method].score.objects
        if one.true_id in log[method].telling
    ]
    return float(np.mean(found)) if found else np.nan


def _gain(results: Results, method: str) -> str:
    """Class accuracy beyond the vote's on the same objects, in points, with a 95 % interval.

    Bootstrapped over logs.
    """
    if method == VOTE:
        return "–"
    sums = np.zeros((len(results), 2))
    for row, log in zip(sums, results, strict=True):
        votes = {one.true_id: one.correct for one in log[VOTE].score.objects}
        gains = [
            one.correct - votes[one.true_id]
            for one in log[method].score.objects
            if one.true_id in votes
        ]
        row[:] = sum(gains), len(gains)
    gain = 100.0 * sums[:, 0].sum() / sums[:, 1].sum()
    if len(results) < 2:
        return f"{gain:+.1f}"
    drawn = np.random.default_rng(0).integers(0, len(results), (RESAMPLES, len(results)))
    shares = 100.0 * sums[drawn, 0].sum(axis=1) / sums[drawn, 1].sum(axis=1)
    low, high = np.percentile(shares, (2.5, 97.5))
    return f"{gain:+.1f} ({low:+.1f} to {high:+.1f})"


def print_found_either_way(results: Results) -> None:
    """Class accuracy with ids and without, of the objects that are found without them, too."""
    pairs = []
    for log in results:
        alone = {one.true_id: one.correct for one in log[WITHHELD].score.objects}
        pairs += [
            (one.correct, alone[one.true_id])
            for one in log[DEFAULT].score.objects
            if one.true_id in alone
        ]
    with_ids, without = np.mean(pairs, axis=0)
    print(
        f"\nOf the {len(pairs)} objects found either way, {with_ids:.3f} are right with ids, "
        f"{without:.3f} without."
    )


def _cell(figure: Figure, form: str) -> str:
    return "–" if figure.value is None else form.format(figure.value)


def main() -> None:
    """Run all sets and print their tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--logs", type=int, default=40, help="simulated logs in each set")
    parser.add_argument("--sets", nargs="*", default=list(SETS), choices=list(SETS))
    parser.add_argument("--rendered", type=Path, help="folder of recorded logs with truth")
    parser.add_argument(
        "--without-ids", type=int, default=12, help="logs of each set inferred without ids, too"
    )
    parser.add_argument("--parts", action="store_true", help="switch parts off one by one, too")
    arguments = parser.parse_args()
    methods = [
        name for name in METHODS if name in COMPARED or (arguments.parts and name != WITHHELD)
    ]
    sets: dict[str, Results] = {}
    nameless: list[Mapping[str, Result]] = []
    with ProcessPoolExecutor(PROCESSES) as pool:
        for name in arguments.sets:
            tasks = [
                (name, seed, [*methods, WITHHELD] if seed < arguments.without_ids else methods)
                for seed in range(arguments.logs)
            ]
            results = list(pool.map(simulated, tasks))
            sets[name] = results
            nameless += [log for log in results if WITHHELD in log]
            print(f"{name}: done", file=sys.stderr, flush=True)
        if len(sets) > 1:
            sets["all simulated"] = [log for results in sets.values() for log in results]
        if arguments.rendered:
            logs = [(*task, [*methods, WITHHELD]) for task in recorded_tasks(arguments.rendered)]
            sets["rendered"] = list(pool.map(recorded, logs))
    print_table(sets, methods)
    if nameless:
        print("\nThe same logs with ids and with all ids withheld:\n")
        print_table({"all simulated": nameless}, [VOTE, DEFAULT, WITHHELD])
        print_found_either_way(nameless)
    if "rendered" in sets:
        print()
        print_table({"rendered": sets["rendered"]}, [VOTE, DEFAULT, WITHHELD])


if __name__ == "__main__":
    main()
