"""What was measured: the way of the robot, and where detections point."""

from __future__ import annotations

import numpy as np
import rerun as rr

from mclass.geometry import opening_angles
from mclass.outputs.names import display_text
from mclass.records import FloatArray, IntArray
from mclass.viewing.contents import Contents
from mclass.viewing.entities import DETECTIONS, LABELS, LIFT, lifted, times

_TRACK_COLOR = (0x00, 0x72, 0xB2)
_RAY_COLOR = (0x00, 0x9E, 0x73)
_BEFORE_COLOR = (0xA8, 0xD8, 0xC8)
_MOST_RAYS = 40


def record_track(recording: rr.RecordingStream, contents: Contents, size: float) -> None:
    """The way as a line, and an arrow that moves along it."""
    track = contents.track
    if not len(track.stamps_ns):
        return
    places = lifted(track.poses_world_child[:, :2] - contents.origin, 2.0 * LIFT * size)
    line = rr.LineStrips3D([places], colors=[_TRACK_COLOR], radii=rr.Radius.ui_points(1.2))
    recording.log("world/track", line, static=True)
    headings = track.poses_world_child[:, 2]
    vectors = np.stack([np.cos(headings), np.sin(headings), np.zeros(len(headings))], axis=1)
    recording.log(
        "world/robot",
        rr.Arrows3D.from_fields(
            colors=[_TRACK_COLOR],
            radii=[0.06 * size],
            labels=[display_text(track.child_frame or "robot")],
            show_labels=False,
        ),
        static=True,
    )
    recording.send_columns(
        "world/robot",
        indexes=[times(track.stamps_ns)],
        columns=rr.Arrows3D.columns(origins=places, vectors=0.7 * size * vectors),
    )


def record_detections(recording: rr.RecordingStream, contents: Contents, size: float) -> None:
    """Where detections point: those of the present frame, and faintly those before it."""
    found = contents.measurements
    frames = found.frames
    count = len(frames)
    if not count:
        return
    outlines, located = _outlines(contents, 3.0 * LIFT * size)
    labels = [", ".join(map(display_text, found.label_names_of(row))) for row in range(len(found))]
    owners = [*map(display_text, found.object_ids), ""]
    rows_of_frame = np.bincount(found.frame_index[located], minlength=count)
    recording.log(
        f"{DETECTIONS}/now",
        rr.LineStrips3D.from_fields(
            colors=[_RAY_COLOR], radii=rr.Radius.ui_points(1.5), show_labels=False
        ),
        static=True,
    )
    recording.send_columns(
        f"{DETECTIONS}/now",
        indexes=[times(frames.stamps_ns)],
        columns=rr.LineStrips3D.columns(
            strips=outlines, labels=[labels[row] for row in located]
        ).partition(rows_of_frame),
    )
    if len(located):
        chosen = np.arange(len(located))
        if len(located) > _MOST_RAYS:
            chosen = np.linspace(0, len(located) - 1, _MOST_RAYS).round().astype(int)
        stamps, counts = np.unique(found.stamps_ns[located[chosen]], return_counts=True)
        recording.log(
            f"{DETECTIONS}/before",
            rr.LineStrips3D.from_fields(colors=[_BEFORE_COLOR], radii=rr.Radius.ui_points(0.6)),
            static=True,
        )
        recording.send_columns(
            f"{DETECTIONS}/before",
            indexes=[times(stamps)],
            columns=rr.LineStrips3D.columns(strips=[outlines[k] for k in chosen]).partition(counts),
        )
    if len(found):
        texts = [
            f"{owners[owner]}: {text}" if owners[owner] else text
            for owner, text in zip(found.object_index.tolist(), labels, strict=True)
        ]
        recording.send_columns(
            LABELS, indexes=[times(found.stamps_ns)], columns=rr.TextLog.columns(text=texts)
        )


def _outlines(contents: Contents, height: float) -> tuple[list[FloatArray], IntArray]:
    """A strip for each detection with a direction, and the rows of these.

    A ray is a line; a cone is its two edges with the sensor between them.
    """
    found = contents.measurements
    located = np.flatnonzero(np.isfinite(found.directions).all(axis=1))
    starts = found.frames.poses_world_sensor[found.frame_index[located], :2] - contents.origin
    right, width = found.directions[located, 0], opening_angles(found.directions[located])
    as_ray = (width == 0.0) | (contents.grid.footprint == "ray")
    edges = np.stack([right, right + width], axis=1)
    edges[as_ray] = (right + 0.5 * width)[as_ray, None]
    ends = starts[:, None] + contents.grid.max_range * np.stack(
        [np.cos(edges), np.sin(edges)], axis=-1
    )
    cones = lifted(np.stack([ends[:, 0], starts, ends[:, 1]], axis=1), height)
    return [strip[1:] if ray else strip for strip, ray in zip(cones, as_ray, strict=True)], located
