"""All that a report shows, gathered from an output as plain JSON."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from mclass.classes import BACKGROUND
from mclass.config.model_file import parse_model
from mclass.errors import ConfigError, LogError
from mclass.logarithms import logsumexp
from mclass.model import GridSettings, Model
from mclass.outputs.colors import BACKGROUND_COLOR, CLASS_COLORS, hex_color
from mclass.outputs.readback import OutputLog
from mclass.outputs.track import track_of
from mclass.records import PoseTrack
from mclass.report.maps import CellFacts, pack_maps
from mclass.report.timeline import (
    Json,
    Steps,
    number,
    numbers,
    object_document,
    shown_name,
)
from mclass.results import BeliefBlock
from mclass.text.terminal import Terminal
from mclass.text.values import stamp_text

_MOST_MAPS = 60
_TRACK_POINTS = 2000
_SENTENCE_COLUMNS = 2000


def report_document(output: OutputLog) -> Json:
    """Everything that the page shows of an output.

    Args:
        output: Written by `mclass.pipeline.estimate` or `infer`, or fused.

    Raises:
        LogError: If a part of the results is lost.
    """
    measurements = output.measurements()
    steps = Steps(measurements)
    history = dict(sorted(output.history().items()))
    names = {object_id: index for index, object_id in enumerate(history)}
    densities: dict[str, Json] = {}
    facts = CellFacts()
    maps = output.maps_over_time(_MOST_MAPS)
    times = {(found.stamp_ns, found.log_time_ns) for found in maps}
    for block in output.beliefs():
        if block.object_id:
            densities[block.object_id] = _object_density(block)
        elif (block.stamp_ns, block.log_time_ns) in times:
            facts.add(block)
    model = _model(output)
    grid = GridSettings() if model is None else model.grid
    packed = pack_maps(maps, facts)
    if packed:
        stamps = np.array([int(stamp) for stamp in packed.pop("stamps_ns")])
        packed["seconds"] = numbers(steps.seconds(stamps), 3)
        packed["stamps"] = [stamp_text(stamp) for stamp in stamps.tolist()]
    objects = []
    for object_id, estimates in history.items():
        entry = object_document(estimates, steps.of(estimates))
        objects.append({**entry, "density": densities.get(object_id)})
    return {
        "file": shown_name(output.reader.path.name),
        "frame": shown_name(output.frame),
        "background": BACKGROUND,
        "background_color": hex_color(BACKGROUND_COLOR),
        "classes": [
            {"name": shown_name(name), "color": hex_color(CLASS_COLORS[index % len(CLASS_COLORS)])}
            for index, name in enumerate(output.class_names)
        ],
        "start": stamp_text(steps.start_ns),
        "steps": steps.document(names),
        "objects": objects,
        "track": _track_document(track_of(output, model, measurements), steps),
        "range": number(grid.max_range),
        "map": packed or None,
        # Last, as reading finds damage.
        "facts": _facts(output),
    }


def _model(output: OutputLog) -> Model | None:
    """The model, unless it is not one that this version can read."""
    with contextlib.suppress(ConfigError, LogError):
        return parse_model(output.model_text, output.model_name)
    return None


def _object_density(block: BeliefBlock) -> Json:
    """P(orientation | class) of an object, wherever it stands [1/rad], by class."""
    log_weight = block.log_cell_mass[:, None] + block.log_class_probability[:, 1:]
    log_total = logsumexp(log_weight, axis=0)
    with np.errstate(invalid="ignore"):
        share = np.exp(log_weight - log_total)
    density = np.einsum("kn,knb->nb", share, np.exp(block.log_density.astype(np.float64)))
    return {
        "measurements": int(block.measurements.max(initial=0)),
        "classes": [[number(value, 4) for value in row] for row in density.tolist()],
    }


def _track_document(track: PoseTrack, steps: Steps) -> Json:
    """Where the robot went; of a long way evenly chosen places."""
    count = len(track.stamps_ns)
    kept = np.linspace(0, count - 1, min(count, _TRACK_POINTS)).round().astype(int)
    poses = track.poses_world_child[kept]
    return {
        "name": shown_name(track.child_frame or "robot"),
        "seconds": numbers(steps.seconds(track.stamps_ns[kept]), 3),
        "x": numbers(poses[:, 0], 3),
        "y": numbers(poses[:, 1], 3),
    }


def _facts(output: OutputLog) -> Json:
    """What the results rest on, and what became of the input."""
    account, settings = output.recorded("account"), output.recorded("settings")

    def sentences(*groups: Any) -> list[str]:
        found = [text for group in groups if isinstance(group, list | tuple) for text in group]
        # The same loss can be met by the estimate and again by the report.
        return [_sentence(str(text)) for text in dict.fromkeys(found)]

    skipped = account.get("skipped", {})
    used = account.get("used")
    try:
        model_text = output.model_text
    except LogError:
        model_text = ""
    hashes = {"model_hash": "model", "input_hash": "input"}
    return {
        "used": used if isinstance(used, int) else None,
        "skipped": [
            [_sentence(str(reason)), int(count)]
            for reason, count in sorted(
                skipped.items() if isinstance(skipped, Mapping) else (), key=lambda item: -item[1]
            )
        ],
        "notes": sentences(account.get("notes")),
        "damage": sentences(account.get("damage"), output.reader.damage.losses),
        "model_name": _sentence(output.model_name),
        "model_text": model_text,
        "version": _sentence(output.metadata.get("version", "")),
        "encoding": _sentence(output.metadata.get("encoding", "")),
        "hashes": [
            [name, _sentence(output.metadata[key])]
            for key, name in hashes.items()
            if output.metadata.get(key)
        ],
        "settings": [
            [_sentence(str(key)), _sentence(value if isinstance(value, str) else json.dumps(value))]
            for key, value in settings.items()
            if value is not None
        ],
    }


def _sentence(text: str) -> str:
    """Foreign text as it is shown."""
    return Terminal().clean(text, _SENTENCE_COLUMNS)
