"""Everything of a log that measurements are made of, read in as few passes as can be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mclass.errors import LogError
from mclass.logs import mounting, poses, sources
from mclass.logs.annotations import read_annotations
from mclass.logs.detections import (
    Detections,
    join_detections,
    no_detections,
    read_detections,
)
from mclass.logs.families import LABEL_NAME_FIELDS
from mclass.logs.input_tables import InputTables
from mclass.logs.labels import numbered_names
from mclass.logs.pose_sources import PoseSource
from mclass.logs.poses import Track
from mclass.logs.reader import LogReader
from mclass.logs.sensors import CameraTrack, Sensor, choose_camera, find_sensor, read_camera
from mclass.logs.sources import Sources
from mclass.logs.tables import Decoders
from mclass.model import Model, TransformSource
from mclass.records import IntArray, PoseTrack, Tally
from mclass.transforms import TransformTree

_DEFAULT_GAP_NS = 500_000_000


@dataclass(frozen=True)
class Inputs:
    """What was read.

    Attributes:
        sources: Channels by use.
        detections: Of all used channels, within the time bounds.
        stamps_ns: When each look was taken, by the clock of the track, (m,).
        track: The chosen poses.
        pose_source: Where they come from; None if there are none.
        cameras: Calibrations.
        sensors: For each distinct (topic, frame) of looks, and the looks that are its.
        numbered: Label names by number.
        notes: Choices in words.
        tally: Poses and transforms left out or mended, by reason.
        unreadable: Messages that could not be decoded, by topic and reason.
        encoding: For what is written beside.
        robot_frame: What the poses are of; empty if that is not known.
        read_channels: Ids of all channels that were read.
    """

    sources: Sources
    detections: Detections
    stamps_ns: IntArray
    track: Track
    pose_source: PoseSource | None
    cameras: tuple[CameraTrack, ...]
    sensors: tuple[tuple[Sensor, IntArray], ...]
    numbered: Mapping[str, str]
    notes: tuple[str, ...]
    tally: Tally
    unreadable: Mapping[str, Mapping[str, int]]
    encoding: Literal["ros2", "protobuf", "json"]
    robot_frame: str
    read_channels: frozenset[int]


class InputReader:
    """Reads the inputs of one log; what was read once is kept."""

    def __init__(
        self, reader: LogReader, model: Model | None, start_ns: int | None, end_ns: int | None
    ) -> None:
        self.reader = reader
        self.model = model
        decoders = Decoders(reader)
        self.sources = sources.find_sources(reader, decoders, model)
        self.max_gap_ns = model.log.max_gap_ns if model is not None else _DEFAULT_GAP_NS
        self.notes: list[str] = []
        self.tally = Tally()
        self._robot_frame = ""
        self.tables = InputTables(
            reader, decoders, self.sources, self.max_gap_ns, (start_ns, end_ns), self.tally
        )

    def read(self) -> Inputs:
        """Read all; a log without poses or detections gives empty ones."""
        first_rank = [s for s in self.sources.poses if s.rank == self.sources.poses[0].rank]
        self.tables.read_ahead(first_rank)
        detections = self._detections()
        cameras = self._cameras(by_log_time=False)
        track, source = self._choose_poses(detections, cameras)
        by_log_time = track.clock == "log"
        if by_log_time and source is not None:
            self.notes.append(
                f"{source.name} and detections are placed by log time, since one has no stamps"
            )
            cameras = self._cameras(by_log_time=True)
        stamps = _stamps(detections, by_log_time=by_log_time)
        if not by_log_time:
            missing = int((detections.stamps_ns == 0).sum())
            if missing:
                self.notes.append(f"{missing:,} detection messages without stamp: log time used")
        sensors = self._sensors(detections, stamps, track, cameras)
        self.notes.extend(note for sensor, _ in sensors for note in sensor.notes)
        return Inputs(
            sources=self.sources,
            detections=detections,
            stamps_ns=stamps,
            track=track,
            pose_source=source,
            cameras=cameras,
            sensors=sensors,
            numbered=self._numbered(),
            notes=tuple(dict.fromkeys(self.notes)),
            tally=self.tally,
            unreadable=self.tables.unreadable,
            encoding=self._encoding(source),
            robot_frame=self._robot_frame,
            read_channels=self.tables.read,
        )

    def _detections(self) -> Detections:
        """All detections, empty ones if the log has no channel of them."""
        parts = []
        for source in self.sources.detections:
            (table,) = self.tables.of({source.channel.id: source.paths}, self.tables.exact)
            if source.fields is None:
                parts.append(read_annotations(table))
            else:
                parts.append(read_detections(table, source.fields))
            self.tables.forget(source.channel.id)
            self.notes.append(f"detections: {source.channel.topic} ({source.kind})")
        for other in self.sources.other_detections:
            self.notes.append(
                f"detections on {other.channel.topic} ({other.kind}) are not used; "
                "name it as log.detections to use it"
            )
        none = np.zeros(0, np.int64), np.zeros(0, dtype=object)
        return (
            join_detections(parts) if parts else no_detections(none[1], none[0], none[0], none[1])
        )

    def _cameras(self, *, by_log_time: bool) -> tuple[CameraTrack, ...]:
        found = []
        settings = self.model.log.camera if self.model is not None else None
        rectified = settings is not None and settings.rectified
        for source in self.sources.cameras:
            table = self.tables.camera(source)
            track = read_camera(table, source, by_log_time=by_log_time, rectified=rectified)
            if track is not None:
                found.append(track)
        return tuple(found)

    def _choose_poses(
        self, detections: Detections, cameras: tuple[CameraTrack, ...]
    ) -> tuple[Track, PoseSource | None]:
        """The track by the rule of `sources`, rank by rank until one covers a detection."""
        candidates = self.sources.poses
        unstamped = bool(detections.n_looks) and not detections.stamps_ns.any()
        tried: list[tuple[int, Track, PoseSource]] = []
        for rank in sorted({source.rank for source in candidates}):
            for source in (s for s in candidates if s.rank == rank):
                track = self._track(source, detections, cameras, by_log_time=unstamped)
                if track.still and len(candidates) > 1:
                    # A robot with odometry moves: where it does not cover the detections, what
                    # never moves is a mounting, not the robot's place.
                    continue
                stamps = _stamps(detections, by_log_time=track.clock == "log")
                covered = int(track.covered(stamps, self.max_gap_ns).sum())
                tried.append((covered, track, source))
            needed = 1 if detections.n_looks else 0
            if any(covered >= needed and len(track) for covered, track, _ in tried):
                break
        # The first of equals is the best of its rank: sources come sorted by rank and name.
        usable = [entry for entry in tried if len(entry[1])]
        if not usable:
            if candidates:
                reasons = ", ".join(
                    f"{source.name}: {_counts(track.tally) or 'no poses'}"
                    for _, track, source in tried
                )
                raise LogError(
                    f"no pose can be used ({reasons}). Name another source as log.odometry.",
                    path=str(self.reader.path),
                )
            return Track(PoseTrack("", "", np.zeros(0, np.int64), np.zeros((0, 3))), _NO_TILT), None
        best = max(usable, key=lambda entry: (entry[0], -entry[2].rank, len(entry[1])))
        _, track, source = best
        self.notes.append(f"poses: {source.name} ({source.kind})")
        refused = []
        for _, other_track, other in tried:
            if other.rank < source.rank:
                why = _counts(other_track.tally) or "there are none"
                if len(other_track):
                    why = "none is near a detection in time"
                self.notes.append(f"poses of {other.name} cannot be used: {why}")
                refused.append(other.name)
        others = [s.name for s in candidates if s is not source and s.name not in refused]
        if others:
            self.notes.append(
                f"poses could also come from {', '.join(others)}; name one as log.odometry"
            )
        for reason, count in track.tally.counts.items():
            self.tally.add(reason, count)
        return track, source

    def _track(
        self,
        source: PoseSource,
        detections: Detections,
        cameras: tuple[CameraTrack, ...],
        *,
        by_log_time: bool,
    ) -> Track:
        """Poses of one source."""
        if source.channel is None:
            tree = self.tables.tree(moving=True)
            chain = source.transform or self._guess_chain(tree, detections, cameras)
            if chain is None:
                return Track(PoseTrack("", "", np.zeros(0, np.int64), np.zeros((0, 3))), _NO_TILT)
            if source.transform is not None and tree.path(chain.parent, chain.child) is None:
                raise LogError(
                    f"no transforms lead from {chain.parent!r} to {chain.child!r}. Frames present: "
                    f"{', '.join(sorted(tree.frames)[:40]) or 'none'}. Set log.odometry.tf.",
                    path=str(self.reader.path),
                )
            return poses.transform_track(tree, chain.parent, chain.child, self.max_gap_ns)
        window = self.tables.until if source.velocity else self.tables.around
        (table,) = self.tables.of({source.channel.id: source.paths}, window)
        if source.velocity is not None:
            return poses.read_velocity_track(table, source.velocity, self.max_gap_ns)
        if source.fields is None:
            raise AssertionError("a pose channel has fields")
        return poses.read_pose_track(table, source.fields, by_log_time=by_log_time)

    def _guess_chain(
        self, tree: TransformTree, detections: Detections, cameras: tuple[CameraTrack, ...]
    ) -> TransformSource | None:
        """World and robot frame for the frame of the detections."""
        for topic, frame in _topics_and_frames(detections):
            found = choose_camera(cameras, topic, frame)
            for name in (frame, found.frame if found else ""):
                chain = mounting.moving_frame(tree, name) if name in tree else None
                if chain is not None:
                    return TransformSource(*chain)
        return None

    def _sensors(
        self,
        detections: Detections,
        stamps: IntArray,
        track: Track,
        cameras: tuple[CameraTrack, ...],
    ) -> tuple[tuple[Sensor, IntArray], ...]:
        """The sensor of each topic and frame; moving transforms are read only when needed."""
        result = []
        boxed = np.zeros(detections.n_looks, bool)
        boxed[detections.look_index[detections.has_box]] = True
        pairs = list(zip(detections.topics.tolist(), detections.frame_names.tolist(), strict=True))
        codes = {pair: code for code, pair in enumerate(dict.fromkeys(pairs))}
        code = np.array([codes[pair] for pair in pairs], dtype=np.int64)
        boxed_topics = set(detections.topics[boxed].tolist())
        for (topic, frame), number in codes.items():
            looks = np.flatnonzero(code == number)
            for moving in (False, True):
                tree = self.tables.tree(moving=moving)
                robot = self._robot(tree, track, topic, frame, cameras)
                sensor = find_sensor(
                    topic,
                    frame,
                    stamps[looks],
                    (track.poses.frame, robot),
                    tree,
                    cameras,
                    self.model,
                    has_boxes=topic in boxed_topics,
                )
                self._robot_frame = robot
                if sensor.placed or not self.tables.has_moving_transforms:
                    break
            result.append((sensor, looks))
        return tuple(result)

    def _robot(
        self,
        tree: TransformTree,
        track: Track,
        topic: str,
        frame: str,
        cameras: tuple[CameraTrack, ...],
    ) -> str:
        """The frame that the poses are of; guessed from the tree if they do not say."""
        robot = track.poses.child_frame
        used = choose_camera(cameras, topic, frame)
        sensor_frame = used.frame if used is not None and used.frame else frame
        if robot in tree:
            return robot
        root = mounting.robot_frame(tree, sensor_frame, track.poses.frame)
        if robot and root in tree:
            self.notes.append(
                f"no transform leads to {robot}, whose poses these are; {root} is taken for it"
            )
        return root

    def _numbered(self) -> dict[str, str]:
        names: dict[str, str] = {}
        for channel in self.sources.label_names:
            for table in self.tables.of({channel.id: LABEL_NAME_FIELDS}, self.tables.until):
                names.update(numbered_names(table))
        return names

    def _encoding(self, source: PoseSource | None) -> Literal["ros2", "protobuf", "json"]:
        channels = [found.channel for found in self.sources.detections]
        if source is not None and source.channel is not None:
            channels.append(source.channel)
        elif source is not None:
            channels += [c for c in self.reader.channels if c.id in self.sources.transforms]
        encodings = {channel.message_encoding for channel in channels}
        if "cdr" in encodings:
            return "ros2"
        return "json" if encodings == {"json"} else "protobuf"


_NO_TILT = np.zeros((0, 4))


def _stamps(detections: Detections, *, by_log_time: bool) -> IntArray:
    """When looks were taken."""
    if by_log_time:
        return detections.log_times_ns
    return np.where(detections.stamps_ns != 0, detections.stamps_ns, detections.log_times_ns)


def _topics_and_frames(detections: Detections) -> list[tuple[str, str]]:
    pairs = zip(detections.topics.tolist(), detections.frame_names.tolist(), strict=True)
    return list(dict.fromkeys(pairs))


def _counts(tally: Tally) -> str:
    return ", ".join(f"{count:,} {reason}" for reason, count in tally.counts.items())
