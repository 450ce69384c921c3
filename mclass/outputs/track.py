"""Where the robot went, as an output tells it."""

from __future__ import annotations

import contextlib

from mclass.errors import LogError, UsageError
from mclass.logs.measurements import read_measurements
from mclass.logs.times import find_time_bound
from mclass.model import Model
from mclass.outputs.readback import OutputLog
from mclass.records import LabelMeasurements, PoseTrack

SENSOR = "sensor"
"""Child frame of a track that is the sensor's."""


def track_of(output: OutputLog, model: Model | None, measurements: LabelMeasurements) -> PoseTrack:
    """The log's own poses or, without them, those of the sensor at its frames.

    A map joined from several logs has no poses of its own, nor has an output that was written
    without the log.

    Args:
        output: Whose track.
        model: Its model; None if that cannot be read.
        measurements: Its measurements.
    """
    with contextlib.suppress(LogError, UsageError, ValueError):
        settings = output.recorded("settings")
        if model is not None and "input" in settings:
            first = output.reader.start_ns or 0
            start, end = (
                None if settings.get(key) is None else find_time_bound(str(settings[key]), first)
                for key in ("start", "end")
            )
            contents = read_measurements(output.reader, model, start, end)
            if contents.frame == output.frame and len(contents.track.stamps_ns):
                return contents.track
    frames = measurements.frames
    return PoseTrack(output.frame, SENSOR, frames.stamps_ns, frames.poses_world_sensor)
