"""A recording to a viewer's window or into a file."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from uuid import uuid4

import rerun as rr

from mclass.errors import MclassError, UsageError
from mclass.logs.pending import PendingFile
from mclass.outputs.readback import OutputLog
from mclass.places import PlaceLike
from mclass.progress import Progress, unheard
from mclass.viewing.blueprint import blueprint
from mclass.viewing.contents import Contents, gather
from mclass.viewing.recording import record

_BLOCK = 1 << 24


@dataclass(frozen=True)
class Shown:
    """What a viewer was given.

    Attributes:
        contents: All of it.
        size: Of the file [byte]; 0 if there is none.
        damage: Sentences on parts of the output that could not be read.
    """

    contents: Contents
    size: int
    damage: tuple[str, ...]


def save_recording(
    out: PlaceLike, path: Path, *, overwrite: bool = False, progress: Progress = unheard
) -> Shown:
    """Write an output as a recording, complete or not at all.

    Args:
        out: Written by `mclass.pipeline.estimate`.
        path: Of the file, by custom ``.rrd``.
        overwrite: Replace a file that is there.
        progress: Told how far the work is.

    Raises:
        LogError: If the output cannot be read, or the file not be written.
    """
    with OutputLog.open(out) as output:
        # Refused before any work is done.
        pending = PendingFile(path, overwrite=overwrite, source=output.reader.source)
        contents = gather(output, progress)
        damage = tuple(output.reader.damage.losses)
        progress("recording", 0, 0, "")
        try:
            pending.open()
            with TemporaryDirectory() as folder:
                draft = Path(folder) / "draft.rrd"
                recording = _recording(contents)
                recording.save(draft)
                # Not as a default alone: that would leave the layout of an earlier recording.
                recording.send_blueprint(blueprint(contents))
                record(recording, contents)
                recording.disconnect()
                size = draft.stat().st_size
                with draft.open("rb") as file:
                    while block := file.read(_BLOCK):
                        pending.write(block)
            pending.publish()
        finally:
            pending.discard()
    return Shown(contents, size, damage)


def open_viewer(out: PlaceLike, *, progress: Progress = unheard) -> Shown:
    """Show an output in the viewer's window, which stays when the program ends.

    Args:
        out: Written by `mclass.pipeline.estimate`.
        progress: Told how far the work is.

    Raises:
        LogError: If the output cannot be read.
        UsageError: If there is no display.
        MclassError: If the viewer cannot be started.
    """
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise UsageError("no display to open a window on; write a file with --save FILE.rrd")
    with OutputLog.open(out) as output:
        contents = gather(output, progress)
        damage = tuple(output.reader.damage.losses)
    progress("recording", 0, 0, "")
    recording = _recording(contents)
    try:
        recording.spawn(hide_welcome_screen=True)
    except (OSError, RuntimeError) as error:
        raise MclassError(
            f"the viewer cannot be started: {error}. Write a file with --save FILE.rrd"
        ) from error
    recording.send_blueprint(blueprint(contents))
    record(recording, contents)
    recording.disconnect()
    return Shown(contents, 0, damage)


def _recording(contents: Contents) -> rr.RecordingStream:
    """An empty recording of its own, however many are open in a viewer."""
    recording = rr.RecordingStream("mclass", recording_id=uuid4())
    recording.send_recording_name(contents.name)
    return recording
