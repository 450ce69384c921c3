"""What a viewer shows of an output, as arrays; nothing here knows a viewer."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from mclass.config.model_file import parse_model
from mclass.errors import ConfigError, LogError
from mclass.inference import estimate_objects, prepare
from mclass.model import GridSettings, Model
from mclass.outputs.readback import OutputLog
from mclass.outputs.track import track_of
from mclass.progress import Progress, in_bytes, unheard
from mclass.records import FloatArray, LabelMeasurements, PoseTrack
from mclass.results import ClassMaps, ObjectEstimate
from mclass.summary import Readout, orientation_densities
from mclass.text.values import natural

BINS = 180
"""Angles at which orientation densities are shown."""

_MOST_MAPS = 200
_MOST_DENSITIES = 4000
_LEAST_DENSITIES = 20
_FAR = 5000.0
_ROUND = 1000.0


@dataclass(frozen=True)
class ObjectContents:
    """One object over time.

    Attributes:
        estimates: Oldest first, at least one.
        steps: Indices of the estimates that have a density, increasing, (k,).
        densities: P(class) p(orientation | class) after these [1/rad], bin b at
            2 pi b / `BINS`, (k, n, `BINS`).
    """

    estimates: tuple[ObjectEstimate, ...]
    steps: tuple[int, ...]
    densities: FloatArray

    @property
    def latest(self) -> ObjectEstimate:
        """The last estimate."""
        return self.estimates[-1]


@dataclass(frozen=True)
class Contents:
    """Everything that is shown.

    Attributes:
        name: Of the output's file.
        frame: World frame.
        class_names: Without the background.
        objects: By id.
        measurements: As used.
        track: Of the robot or the sensor.
        maps: Oldest first.
        grid: Settings of the model; the defaults if the model cannot be read.
        origin: What is subtracted from all positions [m], (2,); zeros near the world's origin.
        facts: On the output, by name.
        notes: What is not shown, and why.
    """

    name: str
    frame: str
    class_names: tuple[str, ...]
    objects: Mapping[str, ObjectContents]
    measurements: LabelMeasurements
    track: PoseTrack
    maps: tuple[ClassMaps, ...]
    grid: GridSettings
    origin: FloatArray
    facts: Mapping[str, str]
    notes: tuple[str, ...] = field(default=())


def gather(output: OutputLog, progress: Progress = unheard) -> Contents:
    """Read an output, and compute anew how each measurement moved the objects' orientations.

    Args:
        output: Written by `mclass.pipeline.estimate` or `infer`, or fused.
        progress: Told how far the work is.

    Raises:
        LogError: If a part of the results is lost.
    """
    output.reader.on_read = in_bytes(progress, "reading")
    notes: list[str] = []
    measurements, history = output.measurements(), output.history()
    model = None
    try:
        model = parse_model(output.model_text, output.model_name)
    except (ConfigError, LogError):
        notes.append("orientation densities are left out: the model cannot be read")
    steps = _density_steps(history)
    densities = {} if model is None else _densities(model, measurements, history, steps, progress)
    objects = {}
    for object_id, estimates in sorted(history.items(), key=lambda item: natural(item[0])):
        kept = tuple(s for s in steps[object_id] if (object_id, s) in densities)
        shape = (0, len(output.class_names), BINS)
        values = [densities[object_id, step] for step in kept]
        objects[object_id] = ObjectContents(
            estimates, kept, np.array(values) if values else np.zeros(shape)
        )
    maps = output.maps_over_time(_MOST_MAPS)
    track = track_of(output, model, measurements)
    return Contents(
        name=output.reader.path.name,
        frame=output.frame,
        class_names=output.class_names,
        objects=objects,
        measurements=measurements,
        track=track,
        maps=maps,
        grid=GridSettings() if model is None else model.grid,
        origin=_origin(objects, track, measurements, maps),
        facts=_facts(output),
        notes=tuple(notes),
    )


def _density_steps(history: Mapping[str, tuple[ObjectEstimate, ...]]) -> dict[str, list[int]]:
    """Which estimates of each object get a density: of many some, the last among them."""
    most = max(_LEAST_DENSITIES, _MOST_DENSITIES // max(len(history), 1))
    steps = {}
    for object_id, estimates in history.items():
        count, shown = len(estimates), min(len(estimates), most)
        steps[object_id] = [count - 1 - k * count // shown for k in reversed(range(shown))]
    return steps


def _densities(
    model: Model,
    measurements: LabelMeasurements,
    history: Mapping[str, tuple[ObjectEstimate, ...]],
    steps: Mapping[str, list[int]],
    progress: Progress,
) -> dict[tuple[str, int], FloatArray]:
    """P(class) p(orientation | class) by object id and index of its estimate, (n, `BINS`)."""
    wanted = {
        (object_id, history[object_id][step].measurements): step
        for object_id, kept in steps.items()
        for step in kept
    }
    found: dict[tuple[str, int], FloatArray] = {}
    total, done = sum(map(len, history.values())), itertools.count(1)

    def watch(estimate: ObjectEstimate, readout: Readout) -> None:
        progress("following objects", next(done), total, "measurements")
        step = wanted.get((estimate.object_id, estimate.measurements))
        if step is not None:
            classes = estimate.class_probabilities[1:, None]
            found[estimate.object_id, step] = classes * orientation_densities(readout, BINS)

    estimate_objects(prepare(model, measurements), watch=watch)
    return found


def _origin(
    objects: Mapping[str, ObjectContents],
    track: PoseTrack,
    measurements: LabelMeasurements,
    maps: tuple[ClassMaps, ...],
) -> FloatArray:
    """Round coordinates near everything, where these are far from the world's origin.

    Viewers compute in single precision, of which thousands of kilometres leave decimetres.
    """
    places = [track.poses_world_child[:, :2], measurements.frames.poses_world_sensor[:, :2]]
    places += [one.latest.position[None] for one in objects.values()]
    places += [np.array([shown.grid.origin]) for shown in maps]
    everything = np.concatenate(places)
    everything = everything[np.isfinite(everything).all(axis=1)]
    if not len(everything) or np.abs(everything).max() < _FAR:
        return np.zeros(2)
    return np.round(np.median(everything, axis=0) / _ROUND) * _ROUND


def _facts(output: OutputLog) -> dict[str, str]:
    """What the output says of itself."""
    facts = {"model": output.model_name, "frame": output.frame}
    facts["mclass version"] = output.metadata.get("version", "")
    account = output.recorded("account")
    facts["measurements used"] = str(account.get("used", ""))
    skipped = account.get("skipped")
    if isinstance(skipped, dict):
        facts |= {f"skipped: {reason}": str(count) for reason, count in skipped.items()}
    return {name: text for name, text in facts.items() if text}
