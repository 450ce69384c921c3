"""What entities are called, and when and where they are placed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr

from mclass.classes import BACKGROUND
from mclass.outputs.names import TopicTokens
from mclass.records import FloatArray, IntArray
from mclass.viewing.contents import Contents

TIMELINE = "stamp"
MAP = "world/map"
DETECTIONS = "world/detections"
LABELS = "detections/labels"
ABOUT = "about"
EVERYTHING = "all"
"""Name of the map of all classes."""

LIFT = 0.02
"""How far each layer lies above the one below, in arrow lengths: layers in one plane flicker."""


@dataclass(frozen=True)
class Paths:
    """Names of entities that depend on names in the log.

    Attributes:
        objects: Path part by object id.
        classes: Path part of each class.
    """

    objects: Mapping[str, str]
    classes: tuple[str, ...]

    @classmethod
    def of(cls, contents: Contents) -> Paths:
        """Distinct parts for all names, which may be any text."""
        objects, classes = TopicTokens(), TopicTokens()
        # Taken, so that a class of this name becomes another.
        classes.token(EVERYTHING)
        classes.token(BACKGROUND)
        return cls(
            {object_id: objects.token(object_id) for object_id in contents.objects},
            tuple(
                classes.token(f"class {name}" if name == EVERYTHING else name)
                for name in contents.class_names
            ),
        )


def times(stamps_ns: IntArray | Sequence[int]) -> rr.TimeColumn:
    """The time line at some stamps [ns]."""
    stamps = np.asarray(stamps_ns, dtype=np.int64).astype("datetime64[ns]")
    return rr.TimeColumn(TIMELINE, timestamp=stamps)


def lifted(places: FloatArray, height: float) -> FloatArray:
    """Points of the ground plane at a height, (..., 2) to (..., 3)."""
    return np.concatenate([places, np.full((*places.shape[:-1], 1), height)], axis=-1)
