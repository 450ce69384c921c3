"""Which decoder reads a channel."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mclass.errors import LogError
from mclass.logs.decode.base import ChannelDecoder

if TYPE_CHECKING:
    from mclass.logs.channels import ChannelInfo


def decoder_for(channel: ChannelInfo) -> ChannelDecoder:
    """Decoder for a channel's encoding, by the schema that the log embeds.

    Raises:
        LogError: If the encoding is not known or the schema cannot be used.
    """
    # Imported when met: a log without protobuf channels need not load protobuf.
    encodings = (channel.message_encoding, channel.schema_encoding)
    try:
        if encodings in (("cdr", "ros2msg"), ("ros1", "ros1msg")):
            from mclass.logs.decode.ros import RosDecoder  # noqa: PLC0415

            return RosDecoder(channel)
        if encodings == ("protobuf", "protobuf"):
            from mclass.logs.decode.protobuf import ProtobufDecoder  # noqa: PLC0415

            return ProtobufDecoder(channel)
        if channel.message_encoding == "json":
            from mclass.logs.decode.json import JsonDecoder  # noqa: PLC0415

            return JsonDecoder(channel)
    except LogError as error:
        raise LogError(str(error), topic=channel.topic) from error
    raise LogError(
        f"messages encoded as {channel.message_encoding!r} with a schema "
        f"{channel.schema_name!r} in {channel.schema_encoding!r} cannot be decoded. Known: "
        "cdr with ros2msg, ros1 with ros1msg, protobuf, json.",
        topic=channel.topic,
    )
