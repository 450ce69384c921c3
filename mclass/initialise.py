"""A first model file for a log."""

from __future__ import annotations

import os
from pathlib import Path

from mclass.config.find import MODEL_FILE_NAME
from mclass.config.template import TemplateFacts, model_template
from mclass.errors import UsageError
from mclass.logs.reader import LogReader
from mclass.logs.survey import Survey, survey
from mclass.model import FieldMapping, TransformSource
from mclass.places import Place
from mclass.progress import Progress, in_bytes, unheard


def template_for(log: Place, progress: Progress = unheard) -> str:
    """The commented model file that fits a log: its topics, its labels, its frames.

    Args:
        log: To look through.
        progress: Told how far the work is.

    Raises:
        LogError: If the log cannot be read.
    """
    with LogReader.open(log) as reader:
        reader.on_read = in_bytes(progress, "reading")
        found = survey(reader)
    sensor = found.sensors[0] if found.sensors else None
    return model_template(
        TemplateFacts(
            log_name=log.name,
            odometry=_pose_source(found),
            detections=tuple(FieldMapping(topic) for topic in found.detections),
            camera_info=sensor.camera_topic or None if sensor else None,
            has_camera=sensor is not None and sensor.calibrated and sensor.placed,
            frame=found.world_frame,
            sensor_frame=sensor.frame if sensor else "",
            label_counts=found.labels,
            label_names=found.label_names,
            together=found.together,
            notes=(*found.notes, *([found.problem] if found.problem else [])),
        )
    )


def _pose_source(found: Survey) -> FieldMapping | TransformSource | None:
    if found.transform is not None:
        return TransformSource(*found.transform)
    return FieldMapping(found.pose_topic) if found.pose_topic else None


def write_model_file(text: str, log: Place, output: Path | None, *, overwrite: bool) -> Path:
    """Write a model file where `estimate` finds it, unless told where.

    Raises:
        UsageError: If the file exists, or cannot be written.
    """
    beside = log.with_name(MODEL_FILE_NAME) if isinstance(log, Path) else Path(MODEL_FILE_NAME)
    path = beside if output is None else output
    flags = os.O_WRONLY | os.O_CREAT | (os.O_TRUNC if overwrite else os.O_EXCL)
    try:
        with os.fdopen(os.open(path, flags, 0o666), "w", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise UsageError(f"{path} exists; use --overwrite to replace it, or -o") from None
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}") from error
    return path
