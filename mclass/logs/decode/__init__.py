"""From the messages of a log to columns of numbers and strings, whatever their encoding."""

from mclass.logs.decode.base import ABSENT, ChannelDecoder, Column, Columns, is_absent
from mclass.logs.decode.choice import decoder_for

__all__ = ["ABSENT", "ChannelDecoder", "Column", "Columns", "decoder_for", "is_absent"]
