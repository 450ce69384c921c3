"""Which fields of a channel are used, and which those of a known type are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from mclass.logs import families
from mclass.logs.families import Alternatives, BoxFormat, DetectionFamily, PoseFamily
from mclass.logs.tables import level_of


@dataclass(frozen=True)
class BoxFields:
    """Four paths, or the one path of a list or array of four numbers; maybe a turn [rad]."""

    format: BoxFormat
    paths: tuple[str, ...]
    angle: str | None = None


@dataclass(frozen=True)
class DetectionFields:
    """Paths of one channel's detections; ``element`` is the level of one detection.

    ``label`` is None where messages name their own fields and none ever holds a label.
    """

    element: str
    label: str | None
    stamps: Alternatives = ()
    frames: Alternatives = ()
    score: str | None = None
    id: str | None = None
    box: BoxFields | None = None
    bearing: tuple[str, str] | None = None
    volume: tuple[str, ...] = ()

    @property
    def paths(self) -> tuple[str, ...]:
        """All of them."""
        single = [path for path in (self.label, self.score, self.id) if path is not None]
        box = self.box.paths if self.box else ()
        if self.box and self.box.angle:
            box = (*box, self.box.angle)
        return (*single, *self.stamps, *self.frames, *box, *(self.bearing or ()), *self.volume)


@dataclass(frozen=True)
class PoseFields:
    """Paths of one channel's poses: ``position`` has two or three, ``orientation`` one or four."""

    position: tuple[str, ...]
    orientation: tuple[str, ...] = ()
    stamp: str | None = None
    frame: str | None = None
    child: str | None = None
    covariance: str | None = None

    @property
    def paths(self) -> tuple[str, ...]:
        """All of them."""
        optional = (self.stamp, self.frame, self.child, self.covariance)
        return (*self.position, *self.orientation, *(p for p in optional if p is not None))


def family_detection_fields(
    family: DetectionFamily, paths: Mapping[str, str], *, silent: bool = False
) -> DetectionFields | None:
    """A known type's fields in the layout that the schema has.

    Without a field for labels there are None, or, if ``silent``, detections that have none.
    """
    label = families.first_present(family.label, paths)
    if label is None and not silent:
        return None
    angle = families.first_present(family.box_angle, paths)
    boxes = [BoxFields(kind, four, angle) for kind, four in family.boxes if _has(four, paths)]
    volume = _volume_paths(family.volume, paths) if family.volume else ()
    bearing = family.bearing if family.bearing and _has(family.bearing, paths) else None
    return DetectionFields(
        element=family.element,
        label=label,
        stamps=tuple(p for p in family.stamp if p in paths),
        frames=tuple(p for p in family.frame if p in paths),
        score=families.first_present(family.score, paths),
        id=families.first_present(family.id, paths),
        box=boxes[0] if boxes else None,
        bearing=bearing,
        volume=volume,
    )


def family_pose_fields(family: PoseFamily, paths: Mapping[str, str]) -> PoseFields | None:
    """A known pose type's fields; None if the schema lacks a position."""
    for position, orientation in zip(family.position, family.orientation, strict=True):
        places = tuple(f"{position}.{axis}" for axis in "xyz")
        turns = tuple(f"{orientation}.{axis}" for axis in "xyzw")
        if _has(places + turns, paths):
            return PoseFields(
                places,
                turns,
                families.first_present(family.stamp, paths),
                families.first_present(family.frame, paths),
                families.first_present(family.child, paths),
                families.first_present(family.covariance, paths),
            )
    return None


def element_level(label: str, box: BoxFields | None, identity: str | None) -> str:
    """What one detection is: what has a box, else an id, else a label (or a list of labels)."""
    if box is not None:
        return box_level(box)
    if identity is not None:
        return level_of(identity)
    return level_of(label.removesuffix("[]"))


def box_level(box: BoxFields) -> str:
    """The level at which there is one box each."""
    first = box.paths[0]
    return level_of(first.removesuffix("[]") if len(box.paths) == 1 else first)


def _has(wanted: Iterable[str], paths: Mapping[str, str]) -> bool:
    return all(path in paths for path in wanted)


def present(wanted: Iterable[str], paths: Mapping[str, str]) -> tuple[str, ...]:
    """Those of the wanted paths that there are."""
    return tuple(path for path in wanted if path in paths)


def _volume_paths(volume: tuple[str, str], paths: Mapping[str, str]) -> tuple[str, ...]:
    """Position, orientation and size of a 3-D box: ten paths, or none."""
    pose, size = volume
    wanted = (
        *(f"{pose}.position.{axis}" for axis in "xyz"),
        *(f"{pose}.orientation.{axis}" for axis in "xyzw"),
        *(f"{size}.{axis}" for axis in "xyz"),
    )
    return wanted if _has(wanted, paths) else ()
