"""What of a log could not be used: counted, and said in sentences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass
class _Loss:
    """All losses for one reason: where they begin, and how much they took."""

    offsets: set[int] = field(default_factory=set)
    chunks: int = 0
    bytes: int = 0
    messages: int = 0
    uncounted: bool = False


class Damage:
    """What was lost, growing while a log is read; the same loss met twice counts once.

    Losses set ``any``; remarks say what was wrong with the file without costing data
    (an index that had to be rebuilt).
    """

    def __init__(self) -> None:
        self._losses: dict[str, _Loss] = {}
        self._remarks: dict[str, set[int]] = {}

    def lose(
        self,
        reason: str,
        offset: int,
        *,
        chunks: int = 0,
        n_bytes: int = 0,
        messages: int | None = None,
    ) -> None:
        """Count one loss.

        Args:
            reason: Why, as the end of a sentence: "the checksum does not match".
            offset: Byte of the file where it begins; with ``reason`` it tells losses apart.
            chunks: How many chunks.
            n_bytes: How many bytes of the file.
            messages: How many messages; None when that cannot be known.
        """
        loss = self._losses.setdefault(reason, _Loss())
        if offset in loss.offsets:
            return
        loss.offsets.add(offset)
        loss.chunks += chunks
        loss.bytes += n_bytes
        loss.messages += messages or 0
        loss.uncounted = loss.uncounted or messages is None

    def remark(self, sentence: str, offset: int | None = None) -> None:
        """Note something wrong that cost no data, and at which byte of the file it is."""
        offsets = self._remarks.setdefault(sentence, set())
        if offset is not None:
            offsets.add(offset)

    @property
    def any(self) -> bool:
        """Whether anything was lost."""
        return bool(self._losses)

    @property
    def chunks(self) -> int:
        """Chunks lost, whole or in part."""
        return sum(loss.chunks for loss in self._losses.values())

    @property
    def bytes(self) -> int:
        """Bytes of the file that could not be used."""
        return sum(loss.bytes for loss in self._losses.values())

    @property
    def messages(self) -> int:
        """Messages known to be lost; more may be when ``messages_uncounted``."""
        return sum(loss.messages for loss in self._losses.values())

    @property
    def messages_uncounted(self) -> bool:
        """Whether some loss took messages that nothing counts."""
        return any(loss.uncounted for loss in self._losses.values())

    @property
    def losses(self) -> tuple[str, ...]:
        """What was lost, a sentence for each reason; empty exactly if not ``any``."""
        return tuple(_sentence(*item) for item in self._losses.items())

    @property
    def remarks(self) -> tuple[str, ...]:
        """What was wrong without costing data, in sentences."""
        return tuple(
            f"{sentence} ({_where(offsets)})" if offsets else sentence
            for sentence, offsets in self._remarks.items()
        )

    @property
    def sentences(self) -> tuple[str, ...]:
        """Losses, then remarks."""
        return (*self.losses, *self.remarks)


def undecoded(failures: Mapping[str, Mapping[str, int]]) -> tuple[str, ...]:
    """Messages that contradict their schema: a sentence for each topic and reason.

    Args:
        failures: Number of messages by topic and reason.
    """
    return tuple(
        f"lost {_count(count, 'message')} of {topic}: {reason}"
        for topic, reasons in failures.items()
        for reason, count in reasons.items()
    )


def _sentence(reason: str, loss: _Loss) -> str:
    parts = []
    if loss.chunks:
        parts.append(_count(loss.chunks, "chunk"))
    if loss.messages:
        at_least = "at least " if loss.uncounted else ""
        parts.append(at_least + _count(loss.messages, "message"))
    if loss.bytes:
        parts.append(_count(loss.bytes, "byte"))
    if not parts:
        parts.append("an unknown number of messages" if loss.uncounted else "no message")
    return f"lost {', '.join(parts)} {_where(loss.offsets)}: {reason}"


def _where(offsets: set[int]) -> str:
    first = min(offsets)
    return f"at byte {first}" if len(offsets) == 1 else f"from byte {first} on"


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}" + ("" if number == 1 else "s")
