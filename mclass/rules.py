"""Rules that results must not fulfil: ``skipped > 5 %``, ``objects < 3``."""

from __future__ import annotations

import difflib
import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

from mclass.errors import UsageError

Kind: TypeAlias = Literal["count", "share", "number"]
"""How a metric takes ``%``: a count as its share of a whole, a share as it is, a number not."""

_OPERATORS: Mapping[str, Callable[[float, float], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    ">": operator.gt,
}
_RULE = re.compile(r"\s*([A-Za-z]\w*)\s*(<=|>=|==|!=|<|>)\s*(\S+?)\s*(%?)\s*", re.ASCII)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


@dataclass(frozen=True)
class Metric:
    """What a rule can be about.

    Attributes:
        kind: How it takes ``%``.
        meaning: In words, for help.
    """

    kind: Kind
    meaning: str


@dataclass(frozen=True)
class Quantity:
    """A metric's value.

    Attributes:
        value: None when there is nothing to measure.
        whole: What a count is a share of; None for others.
    """

    value: float | None
    whole: float | None = None


@dataclass(frozen=True)
class Rule:
    """A condition on which a result fails.

    Attributes:
        metric: Name of the metric.
        sign: Comparison: ``<``, ``<=``, ``>``, ``>=``, ``==`` or ``!=``.
        limit: What the metric is compared with; per cent are hundredths.
        percent: Whether the limit was given in per cent.
        of_whole: Whether the metric is a count to be taken as a share.
    """

    metric: str
    sign: str
    limit: float
    percent: bool
    of_whole: bool

    def __str__(self) -> str:
        return f"{self.metric} {self.sign} {self._text(self.limit)}"

    def miss(self, quantity: Quantity) -> str | None:
        """What is wrong with a value, in words; None if nothing is.

        A value that is not there, or is no number, fails: a check that checked nothing must
        not pass.
        """
        value = quantity.value
        if value is not None and self.of_whole:
            value = value / quantity.whole if quantity.whole else 0.0
        if value is None or math.isnan(value):
            return f"{self.metric} cannot be told (rule: {self})"
        if _OPERATORS[self.sign](value, self.limit):
            return f"{self.metric} is {self._text(value)} (rule: {self})"
        return None

    def _text(self, value: float) -> str:
        return f"{100.0 * value:.6g} %" if self.percent else f"{value:.6g}"


def parse_rule(text: str, metrics: Mapping[str, Metric]) -> Rule:
    """The rule in a text such as ``skipped > 5 %``.

    Args:
        text: Metric, comparison, number, and ``%`` if the number is in per cent.
        metrics: Those that can be asked for, by name.

    Raises:
        UsageError: If it is no rule, or not about a metric.
    """
    match = _RULE.fullmatch(text)
    if match is None:
        raise UsageError(
            f"rule {text!r}: not of the form METRIC COMPARISON NUMBER [%], such as "
            f"'{next(iter(metrics))} > 5'. Comparisons: {' '.join(_OPERATORS)}"
        )
    name, sign, number, percent = match.groups()
    if name not in metrics:
        close = difflib.get_close_matches(name, metrics, n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        raise UsageError(f"rule {text!r}: no metric {name!r}.{hint} Metrics: {', '.join(metrics)}")
    if not _NUMBER.fullmatch(number):
        raise UsageError(f"rule {text!r}: {number!r} is not a number. Give one, such as 5 or 0.5")
    kind = metrics[name].kind
    if percent and kind == "number":
        raise UsageError(f"rule {text!r}: {name} is not a share of anything. Leave out the %")
    limit = float(number) / (100.0 if percent else 1.0)
    if not math.isfinite(limit):
        raise UsageError(f"rule {text!r}: {number} is too large to be compared with anything")
    return Rule(name, sign, limit, bool(percent), bool(percent) and kind == "count")


def misses(rules: Iterable[Rule], quantities: Mapping[str, Quantity]) -> list[str]:
    """What is wrong by each of the rules, in words.

    Args:
        rules: All on metrics among the quantities.
        quantities: Values by metric.
    """
    found = (rule.miss(quantities[rule.metric]) for rule in rules)
    return [miss for miss in found if miss is not None]
