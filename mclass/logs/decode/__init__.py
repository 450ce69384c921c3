"""From the messages of a log to columns of numbers and strings, whatever their encoding."""

from mclass.logs.decode.base import ChannelDecoder, Column, Columns
from mclass.logs.decode.choice import decoder_for

__all__ = ["ChannelDecoder", "Column", "Columns", "decoder_for"]
