"""Topics of a log, found or told of in an error message."""

from __future__ import annotations

from mclass.errors import LogError
from mclass.logs.channels import ChannelInfo
from mclass.logs.reader import LogReader


def own_prefix(reader: LogReader) -> str:
    """Beginning of the topics that an earlier run wrote into this log."""
    recorded = reader.metadata("mclass") if "mclass" in reader.metadata_names else None
    return (recorded or {}).get("prefix", "/mclass").rstrip("/") + "/"


def topics_present(reader: LogReader) -> str:
    """All topics for an error message."""
    topics = sorted({channel.topic for channel in reader.channels})
    shown = ", ".join(topics[:40]) or "none"
    return shown + (f" and {len(topics) - 40} more" if len(topics) > 40 else "")


def channels_of(reader: LogReader, topic: str, key: str) -> list[ChannelInfo]:
    """Channels of a topic that the model file names.

    Raises:
        LogError: If there is none.
    """
    found = [channel for channel in reader.channels if channel.topic == topic]
    if not found:
        raise LogError(
            f"no topic {topic}. Topics present: {topics_present(reader)}. Set log.{key}.",
            path=str(reader.path),
            topic=topic,
        )
    return found
