"""The tables of a log that measurements are made of: each channel read once, for its window."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypeAlias

from mclass.logs import mounting, poses
from mclass.logs.families import LABEL_NAME_FIELDS
from mclass.logs.pose_sources import PoseSource
from mclass.logs.reader import LogReader
from mclass.logs.sources import CameraSource, Sources
from mclass.logs.tables import Decoders, Table, read_tables
from mclass.records import Tally
from mclass.transforms import TransformTree

# Detections are logged after their stamp: poses are read from this much around them.
_MARGIN_NS = 10_000_000_000

Window: TypeAlias = tuple[int | None, int | None]
"""Earliest and latest log time [ns]."""


class InputTables:
    """Reads channels when they are asked for, and keeps them.

    Args:
        reader: The open log.
        decoders: Its decoders.
        sources: Channels by use.
        max_gap_ns: How far from a detection its poses may be.
        window: Of the detections.
        tally: Is told which transforms are left out.

    Attributes:
        exact: The window of the detections.
        around: That of poses and cameras.
        until: That of what holds from when it is said on.
    """

    def __init__(
        self,
        reader: LogReader,
        decoders: Decoders,
        sources: Sources,
        max_gap_ns: int,
        window: Window,
        tally: Tally,
    ) -> None:
        self._reader = reader
        self._decoders = decoders
        self._sources = sources
        self._tables: dict[int, Table] = {}
        self._failures: dict[int, Mapping[str, int]] = {}
        self._tree: TransformTree | None = None
        self._tally = tally
        start_ns, end_ns = window
        margin = _MARGIN_NS + max_gap_ns
        self.exact: Window = window
        self.around: Window = (
            None if start_ns is None else max(start_ns - margin, 0),
            None if end_ns is None else min(end_ns + margin, 2**63 - 1),
        )
        self.until: Window = (None, self.around[1])

    @property
    def read(self) -> frozenset[int]:
        """Ids of all channels that were read."""
        return frozenset(self._failures)

    @property
    def unreadable(self) -> dict[str, Mapping[str, int]]:
        """Messages that could not be decoded, by topic and reason."""
        topics = {channel.id: channel.topic for channel in self._reader.channels}
        return {topics[key]: failures for key, failures in self._failures.items() if failures}

    def of(self, wanted: Mapping[int, Iterable[str]], window: Window) -> list[Table]:
        """Tables of channels, each read once."""
        missing = {key: paths for key, paths in wanted.items() if key not in self._tables}
        if missing:
            condense = {
                source.fields.covariance: poses.planar_covariances
                for source in self._sources.poses
                if source.fields is not None and source.fields.covariance is not None
            }
            tables = read_tables(self._reader, self._decoders, missing, *window, condense=condense)
            self._tables.update(tables)
            self._failures.update({key: table.failures for key, table in tables.items()})
        return [self._tables[key] for key in wanted]

    def forget(self, channel_id: int) -> None:
        """Let go of a table that is not asked for again."""
        self._tables.pop(channel_id, None)

    def read_ahead(self, pose_sources: Iterable[PoseSource]) -> None:
        """Read what is surely needed, one pass for each time window."""
        exact = {s.channel.id: s.paths for s in self._sources.detections}
        around = {s.channel.id: s.paths for s in self._sources.cameras}
        until: dict[int, tuple[str, ...]] = {
            channel.id: LABEL_NAME_FIELDS for channel in self._sources.label_names
        }
        for source in pose_sources:
            if source.channel is not None:
                # Velocities are integrated from the start of the log, whatever part is used.
                (until if source.velocity else around)[source.channel.id] = source.paths
            else:
                around.update(self._moving_transforms())
        until.update(self._static_transforms())
        by_window: dict[Window, dict[int, tuple[str, ...]]] = {}
        for window, wanted in (
            (self.exact, exact),
            (self.around, around),
            (self.until, until),
        ):
            by_window.setdefault(window, {}).update(wanted)
        for window, wanted in by_window.items():
            self.of(wanted, window)

    def _static_transforms(self) -> dict[int, tuple[str, ...]]:
        return {
            channel.id: self._sources.transforms[channel.id]
            for channel in self._reader.channels
            if channel.id in self._sources.transforms and mounting.is_static_topic(channel.topic)
        }

    def _moving_transforms(self) -> dict[int, tuple[str, ...]]:
        static = self._static_transforms()
        return {key: paths for key, paths in self._sources.transforms.items() if key not in static}

    def tree(self, *, moving: bool) -> TransformTree:
        """The static links, or all of them."""
        static = self.of(self._static_transforms(), self.until)
        if not moving:
            return mounting.read_tree(static, Tally())
        if self._tree is None:
            tables = static + self.of(self._moving_transforms(), self.around)
            self._tree = mounting.read_tree(tables, self._tally)
        return self._tree

    def camera(self, source: CameraSource) -> Table:
        """Calibrations of one channel: around the detections, else of the whole log."""
        wanted = {source.channel.id: source.paths}
        (table,) = self.of(wanted, self.around)
        if not len(table) and self.around != (None, None):
            # Calibrations may be logged once, at the start.
            del self._tables[source.channel.id]
            (table,) = self.of(wanted, (None, None))
        return table

    @property
    def has_moving_transforms(self) -> bool:
        """Whether there are transforms that are not static."""
        return bool(self._moving_transforms())
