"""Strings cut out of one buffer, many at once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mclass.logs.decode import ragged

ALPHABET = st.sampled_from(b"ab\x00\xc3\xa9")
PIECES = st.lists(st.lists(ALPHABET, max_size=20).map(bytes), min_size=1, max_size=12)


def read(pieces: list[bytes]) -> list[str]:
    lengths = np.array([len(piece) for piece in pieces], dtype=np.int64)
    buffer = np.frombuffer(b"".join(pieces) or b"-", dtype=np.uint8)
    texts: list[str] = ragged.read_texts(buffer, np.cumsum(lengths) - lengths, lengths).tolist()
    return texts


@given(PIECES, st.randoms(use_true_random=False), st.sampled_from((1, 60)))
def test_texts_are_those_written(pieces: list[bytes], random: object, times: int) -> None:
    pieces = pieces * times
    random.shuffle(pieces)  # type: ignore[attr-defined]
    assert read(pieces) == [piece.decode("utf-8", "replace") for piece in pieces]


@pytest.mark.parametrize("factor", [0, 1])
def test_texts_whose_hashes_are_equal(factor: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ragged, "_HASH_FACTOR", np.uint64(factor))
    pieces = [b"a", b"a\x00", b"b", b"", b"a\x00\x00", b"abcdefgh", b"abcdefghi", b"x" * 65] * 40
    for some in (pieces, [piece for piece in pieces if len(piece) < 65]):
        assert read(some) == [piece.decode() for piece in some]


def test_equal_texts_are_one_object() -> None:
    texts = read([b"cup", b"jug", b"bottle"] * 100)
    assert len({id(text) for text in texts}) == 3
