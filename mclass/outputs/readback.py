"""Results read back from an output, whatever its encoding."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from types import TracebackType
from typing import Any

import numpy as np

from mclass.classes import BACKGROUND
from mclass.errors import LogError, UsageError
from mclass.logs.reader import LogReader
from mclass.outputs.channels import METADATA_NAME, MODEL_ATTACHMENT
from mclass.outputs.encoder import NANOSECONDS
from mclass.outputs.raster import PackedCells, unpack_cells
from mclass.outputs.stored import StoredMessages
from mclass.outputs.values import (
    belief_from,
    checked_grid,
    estimate_from,
    measurements_from,
)
from mclass.places import PlaceLike
from mclass.records import LabelMeasurements
from mclass.results import BeliefBlock, ClassMaps, ObjectEstimate

_NO_CHANNELS = "no /mclass channels: run `mclass estimate` first"


class OutputLog:
    """The results in one output.

    Attributes:
        reader: The log itself; its ``damage`` grows while results are read.
        metadata: The record that says how the output came about.
        frame: World frame of all results.
        class_names: Without the background.
        prefix: Of the topics.
    """

    def __init__(self, reader: LogReader) -> None:
        """Find the results in an open log, which stays the caller's to close.

        Raises:
            LogError: If it holds none.
        """
        self.reader = reader
        self._path = str(reader.path)
        metadata = reader.metadata(METADATA_NAME)
        if metadata is None:
            raise _no_results(reader)
        self.metadata = metadata
        try:
            self.frame = metadata["frame"]
            self.prefix = metadata["prefix"]
            names = json.loads(metadata["classes"])
            self.class_names = tuple(str(name) for name in names)
        except (KeyError, TypeError, ValueError) as error:
            raise LogError(
                f"the metadata record {METADATA_NAME!r} is not ours or broken ({error})",
                path=self._path,
            ) from error
        self._stored = StoredMessages(reader, self.prefix)
        if not self._stored.present:
            raise _no_results(reader)

    @classmethod
    def open(cls, path: PlaceLike) -> OutputLog:
        """Open an output; it is a context manager that closes it.

        Raises:
            LogError: If it cannot be read, or holds no results.
        """
        reader = LogReader.open(path)
        try:
            return cls(reader)
        except BaseException:
            reader.close()
            raise

    def __enter__(self) -> OutputLog:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.reader.close()

    @property
    def model_name(self) -> str:
        """Name of the model file."""
        return self.metadata.get("model", MODEL_ATTACHMENT)

    @property
    def model_text(self) -> str:
        """The model file.

        Raises:
            LogError: If it is not attached.
        """
        data = self.reader.attachment(MODEL_ATTACHMENT)
        if data is None:
            raise LogError(f"no attachment {MODEL_ATTACHMENT!r}", path=self._path)
        return data.decode("utf-8", "replace")

    def recorded(self, key: str) -> Mapping[str, Any]:
        """A JSON object of the metadata record; empty when missing or another version's."""
        try:
            found = json.loads(self.metadata.get(key, "{}"))
        except ValueError:
            return {}
        return found if isinstance(found, dict) else {}

    def objects(self) -> tuple[ObjectEstimate, ...]:
        """Latest estimate of every object; only the end of the log is read."""
        for start_ns in self._stored.starts():
            latest = None
            for _, latest in self._stored.payloads("objects", start_ns):  # noqa: B007
                pass
            if latest is not None:
                return self._estimates(self._stored.decode("objects", latest)["objects"])
        return ()

    def history(self, object_id: str | None = None) -> dict[str, tuple[ObjectEstimate, ...]]:
        """Every estimate by object id, oldest first.

        Args:
            object_id: The one object wanted; all when None.
        """
        history: dict[str, list[ObjectEstimate]] = {}
        seen: dict[str, tuple[int, ...]] = {}
        for _, payload in self._stored.payloads("objects"):
            # Every message repeats the objects that did not change.
            entries = [
                entry
                for entry in self._stored.decode("objects", payload)["objects"]
                if object_id in (None, entry["id"]) and seen.get(entry["id"]) != _version(entry)
            ]
            seen.update((entry["id"], _version(entry)) for entry in entries)
            for estimate in self._estimates(entries):
                history.setdefault(estimate.object_id, []).append(estimate)
        return {name: tuple(estimates) for name, estimates in history.items()}

    def maps(self) -> ClassMaps:
        """Latest class maps, as precise as float32; only the end of the log is read.

        Raises:
            LogError: If there are none.
        """
        for start_ns in self._stored.starts():
            latest = None
            for latest in self._stored.payloads("grid", start_ns):  # noqa: B007
                pass
            if latest is not None:
                log_time_ns, payload = latest
                return self._stored.checked(
                    _maps_from, self._stored.decode("grid", payload), self, log_time_ns
                )
        raise LogError("the output holds no class map", path=self._path)

    def maps_over_time(self, most: int) -> tuple[ClassMaps, ...]:
        """Class maps oldest first: all of them, or so many evenly chosen, the last among them.

        Args:
            most: How many at most, 1 or more.
        """
        count = sum(1 for _ in self._stored.payloads("grid"))
        # Counted from the last map backwards, so that this is always one of them.
        shown = min(most, count)
        chosen = {count - 1 - index * count // shown for index in range(shown)}
        return tuple(
            self._stored.checked(
                _maps_from, self._stored.decode("grid", payload), self, log_time_ns
            )
            for index, (log_time_ns, payload) in enumerate(self._stored.payloads("grid"))
            if index in chosen
        )

    def beliefs(self) -> Iterator[BeliefBlock]:
        """Every block of every belief, of the grid and of objects, in file order."""
        for _, payload in self._stored.payloads("belief"):
            yield self._stored.checked(
                belief_from, self._stored.decode("belief", payload), self.class_names
            )

    def belief(self, object_id: str = "") -> tuple[BeliefBlock, ...]:
        """All blocks of the latest belief, in order.

        Args:
            object_id: Of an object; empty for the grid.

        Raises:
            LogError: If there is none, or a block of it is missing.
        """
        return self._latest_belief(object_id, lambda block: block)

    def belief_at(self, x: float, y: float, object_id: str = "") -> BeliefBlock:
        """The latest belief of the one cell that holds a point.

        Args:
            x: In the world frame [m].
            y: In the world frame [m].
            object_id: Of an object; empty for the grid.

        Returns:
            A block of that cell alone; of no cell when nothing touched it.

        Raises:
            LogError: If there is no such belief.
            UsageError: If the point lies outside of its grid.
        """
        blocks = self._latest_belief(object_id, lambda block: _only_cell(block, x, y))
        return next((block for block in blocks if len(block.cells)), blocks[0])

    def measurements(self) -> LabelMeasurements:
        """The measurements that the estimate used, exactly.

        Raises:
            LogError: If there are none, or a part of them is missing.
        """
        blocks: dict[int, Mapping[str, Any]] = {}
        for _, payload in self._stored.payloads("measurements"):
            value = self._stored.decode("measurements", payload)
            blocks[value["block"]] = value
        if not blocks:
            raise LogError("the output holds no measurements", path=self._path)
        expected = blocks[max(blocks)]["blocks"]
        self._require_all(blocks.keys(), expected, "the measurements")
        return self._stored.checked(
            measurements_from, [blocks[number] for number in sorted(blocks)]
        )

    def _estimates(self, entries: Sequence[Mapping[str, Any]]) -> tuple[ObjectEstimate, ...]:
        return tuple(
            self._stored.checked(estimate_from, entry, self.class_names) for entry in entries
        )

    def _latest_belief(
        self, object_id: str, pick: Callable[[BeliefBlock], BeliefBlock]
    ) -> tuple[BeliefBlock, ...]:
        """What ``pick`` takes out of each block of the latest belief."""
        for start_ns in self._stored.starts():
            blocks: dict[int, BeliefBlock] = {}
            latest: tuple[int, int, int] | None = None
            for _, payload in self._stored.payloads("belief", start_ns):
                value = self._stored.decode("belief", payload)
                if value["object_id"] != object_id:
                    continue
                block = self._stored.checked(belief_from, value, self.class_names)
                # Blocks of several times can be interleaved.
                version = block.stamp_ns, block.log_time_ns, block.blocks
                if latest is None or version > latest:
                    blocks, latest = {}, version
                if version == latest:
                    blocks[block.block] = pick(block)
            if latest is not None:
                self._require_all(blocks.keys(), latest[-1], "the belief")
                return tuple(blocks[number] for number in sorted(blocks))
        what = f"object {object_id[:80]!r}" if object_id else "the grid"
        raise LogError(f"the output holds no belief of {what}", path=self._path)

    def _require_all(self, present: Collection[int], expected: int, what: str) -> None:
        missing = expected - len(present)
        if missing:
            raise LogError(f"{missing} of {expected} parts of {what} are lost", path=self._path)


def _no_results(reader: LogReader) -> LogError:
    lost = "; ".join(reader.damage.losses)
    damaged = f". Or they are lost, since the file is damaged: {lost}" if lost else ""
    return LogError(f"{_NO_CHANNELS}{damaged}", path=str(reader.path))


def _version(entry: Mapping[str, Any]) -> tuple[int, ...]:
    """What differs between two estimates of one object."""
    return entry["measurements"], entry["stamp_ns"], entry["log_time_ns"]


def _maps_from(value: Mapping[str, Any], output: OutputLog, log_time_ns: int) -> ClassMaps:
    """Class maps from Foxglove's grid, be it ROS or protobuf."""
    stamp = value["timestamp"]
    seconds = stamp["sec" if "sec" in stamp else "seconds"]
    nanoseconds = stamp["nanosec" if "nanosec" in stamp else "nanos"]
    columns, cell_stride = value["column_count"], value["cell_stride"]
    data = np.frombuffer(value["data"], np.uint8)
    if not columns or not cell_stride or len(data) % (columns * cell_stride):
        raise LogError(f"a grid of {len(data)} bytes cannot have {columns} columns")
    corner = value["pose"]["position"]
    grid = checked_grid(
        (corner["x"], corner["y"]),
        value["cell_size"]["x"],
        len(data) // (columns * cell_stride),
        columns,
    )
    fields = tuple((field["name"], field["offset"], field["type"]) for field in value["fields"])
    packed = PackedCells(fields, cell_stride, data.reshape(-1, cell_stride))
    return unpack_cells(
        packed,
        (BACKGROUND, *output.class_names),
        grid,
        seconds * NANOSECONDS + nanoseconds,
        log_time_ns,
    )


def _only_cell(block: BeliefBlock, x: float, y: float) -> BeliefBlock:
    """The block without all other cells; copied, so that the message can be forgotten."""
    grid = block.grid
    cell = grid.cell_at(x, y)
    if cell is None:
        low_x, low_y = grid.origin
        high_x = low_x + grid.columns * grid.cell_size
        high_y = low_y + grid.rows * grid.cell_size
        raise UsageError(
            f"({x:g}, {y:g}) m lies outside of the grid, which spans x {low_x:g} to {high_x:g} m "
            f"and y {low_y:g} to {high_y:g} m"
        )
    rows = np.flatnonzero(block.cells == cell)
    return replace(
        block,
        cells=block.cells[rows],
        log_cell_mass=block.log_cell_mass[rows],
        log_class_probability=block.log_class_probability[rows],
        log_density=block.log_density[rows],
        measurements=block.measurements[rows],
    )
