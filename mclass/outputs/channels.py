"""Results written as channels of a log."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import mclass
from mclass.footprint import Grid
from mclass.model import Model
from mclass.outputs.encoder import Encoder, Message, OutputContext, Schema
from mclass.outputs.layout import layout_for
from mclass.outputs.scene import arrow_length
from mclass.records import LabelMeasurements
from mclass.results import BeliefBlock, ClassMaps, ObjectEstimate

if TYPE_CHECKING:
    from mclass.logs.writer import LogWriter

Encoding: TypeAlias = Literal["ros2", "protobuf", "json"]

METADATA_NAME = "mclass"
MODEL_ATTACHMENT = "mclass.yaml"
LAYOUT_ATTACHMENT = "mclass_layout.json"

MOST_CHANNELS = 10_000
"""Beyond these no pose topics are added; a log of any kind can have 65,535 channels."""


class OutputChannels:
    """All channels of one estimate, in the encoding of its log.

    A ROS 2 log gets cdr channels, any other protobuf, with the objects in JSON in a JSON log.
    Channels of which every output has one are there even if they stay empty.

    Attributes:
        topics_left_out: Pose topics that were not written, there being too many objects; all
            that they would say is in the other channels.
    """

    def __init__(
        self,
        writer: LogWriter,
        encoding: Encoding,
        frame: str,
        model: Model,
        prefix: str = "/mclass",
    ) -> None:
        """Add the channels.

        Args:
            writer: Where to.
            encoding: Of the input log.
            frame: World frame of all results.
            model: The effective model.
            prefix: Of all topics, beginning with a slash.
        """
        self._writer = writer
        self._encoding = encoding
        self._model = model
        self._context = OutputContext(
            frame,
            model.classes.class_names,
            f"/{prefix.strip('/')}",
            arrow_length(model.grid.cell_size),
        )
        self._encoder = _encoder(self._context, encoding)
        self._latest: dict[str, ObjectEstimate] = {}
        self.topics_left_out: set[str] = set()
        self._grid: Grid | None = None
        self._channels: dict[str, int] = {}
        for topic, schema in self._encoder.channels.items():
            self._channel(topic, schema)

    def write_header(
        self,
        log_time_ns: int,
        *,
        input_hash: str = "",
        settings: Mapping[str, Any] | None = None,
        account: Mapping[str, Any] | None = None,
    ) -> None:
        """Say how the output came about: a metadata record, and the model file attached.

        Args:
            log_time_ns: Log time of the attachment [ns].
            input_hash: Of the input log; empty when not computed.
            settings: Whatever else the results depend on, as JSON can hold it.
            account: What became of the input, as JSON can hold it: detections ``used`` and
                ``skipped`` by reason, ``notes`` on what was chosen, sentences on ``damage``.
        """
        classes, source = self._model.classes, self._model.source.encode("utf-8", "replace")
        self._writer.add_metadata(
            METADATA_NAME,
            {
                "version": mclass.__version__,
                "model": self._model.name,
                "model_hash": self._model.hash,
                "input_hash": input_hash,
                "settings": json.dumps(settings or {}, sort_keys=True),
                "encoding": self._encoding,
                "frame": self._context.frame,
                "prefix": self._context.prefix,
                "classes": json.dumps(classes.class_names),
                "account": json.dumps(account or {}, sort_keys=True),
            },
        )
        self._writer.attach(MODEL_ATTACHMENT, "application/yaml", source, log_time_ns)

    def write_objects(
        self, estimates: Sequence[ObjectEstimate], log_time_ns: int, stamp_ns: int
    ) -> None:
        """Write all objects known after an update.

        Args:
            estimates: Latest estimate of each object; one that did not change since the last
                call should be the same instance, which costs next to nothing.
            log_time_ns: Log time of the measurement that caused the update [ns].
            stamp_ns: Its header stamp [ns].

        Raises:
            ModelError: If a number is NaN.
            LogError: If a value does not fit its message.
        """
        changed = [
            estimate
            for estimate in estimates
            if self._latest.get(estimate.object_id) is not estimate
        ]
        self._write(self._encoder.objects(estimates, changed, stamp_ns), log_time_ns)
        self._latest.update((estimate.object_id, estimate) for estimate in changed)

    def write_maps(self, maps: ClassMaps) -> None:
        """Write the class maps; raises as `write_objects`."""
        self._write(self._encoder.maps(maps), maps.log_time_ns)
        self._grid = maps.grid

    def write_belief(self, block: BeliefBlock) -> None:
        """Write one block of a belief; raises as `write_objects`.

        A belief that can be read back needs all its blocks, with one log time.
        """
        self._write(self._encoder.belief(block), block.log_time_ns)

    def write_measurements(
        self, measurements: LabelMeasurements, log_time_ns: int | None = None
    ) -> None:
        """Write the measurements that were used; raises as `write_objects`.

        Args:
            measurements: All of them.
            log_time_ns: Log time of the messages [ns]; the last frame's when None.
        """
        times = measurements.frames.log_times_ns
        if log_time_ns is None:
            log_time_ns = int(times.max()) if len(times) else 0
        self._write(self._encoder.measurements(measurements), log_time_ns)

    def write_layout(self, log_time_ns: int) -> None:
        """Attach a viewer layout for what was written; call it last."""
        layout = layout_for(
            self._context.frame,
            self._context.class_names,
            encoding=self._encoding,
            prefix=self._context.prefix,
            topics=tuple(self._channels),
            object_ids=tuple(self._latest),
            grid=self._grid,
        )
        data = json.dumps(layout, indent=2).encode("ascii")
        self._writer.attach(LAYOUT_ATTACHMENT, "application/json", data, log_time_ns)

    def _write(self, messages: Iterable[Message], log_time_ns: int) -> None:
        for message in messages:
            full = len(self._channels) >= MOST_CHANNELS
            if full and message.topic not in self._channels:
                self.topics_left_out.add(message.topic)
                continue
            channel = self._channel(message.topic, message.schema)
            self._writer.write(channel, log_time_ns, message.data)

    def _channel(self, topic: str, schema: Schema) -> int:
        if topic not in self._channels:
            self._channels[topic] = self._writer.add_channel(
                topic, schema.message_encoding, schema.name, schema.schema_encoding, schema.data
            )
        return self._channels[topic]


def _encoder(context: OutputContext, encoding: Encoding) -> Encoder:
    """Encoder of messages; loads what it needs only: protobuf takes long."""
    if encoding == "ros2":
        from mclass.outputs.ros_encoder import RosEncoder  # noqa: PLC0415

        return RosEncoder(context)
    from mclass.outputs.protobuf_encoder import ProtobufEncoder  # noqa: PLC0415

    return ProtobufEncoder(context, encoding == "json")
