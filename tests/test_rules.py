"""Rules over results, and results as JUnit XML."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mclass.errors import UsageError
from mclass.rules import Metric, Quantity, misses, parse_rule
from mclass.text.junit import JunitCase, junit_xml

METRICS = {
    "skipped": Metric("count", "detections left out"),
    "accuracy": Metric("share", "right classes"),
    "entropy": Metric("number", "of the class, in nats"),
}


@pytest.mark.parametrize(
    ("text", "value", "whole", "fails"),
    [
        ("skipped > 5 %", 6.0, 100.0, True),
        ("skipped > 5 %", 5.0, 100.0, False),
        ("skipped >= 5%", 5.0, 100.0, True),
        ("skipped > 5", 6.0, 100.0, True),
        ("skipped>5", 5.0, 100.0, False),
        ("skipped > 5 %", 0.0, 0.0, False),
        ("accuracy < 90 %", 0.89, None, True),
        ("accuracy < 0.9", 0.91, None, False),
        ("entropy > .5", 0.6, None, True),
        ("entropy > 5e-1", 0.4, None, False),
        ("entropy == 0", 0.0, None, True),
        ("entropy != 0", 0.0, None, False),
        ("entropy <= -1", -1.0, None, True),
    ],
)
def test_rule_by_hand(text: str, value: float, whole: float | None, fails: bool) -> None:
    rule = parse_rule(text, METRICS)
    assert (rule.miss(Quantity(value, whole)) is not None) == fails


@pytest.mark.parametrize("value", [None, float("nan")])
def test_rule_on_what_cannot_be_told_fails(value: float | None) -> None:
    assert "cannot be told" in str(parse_rule("entropy > 9", METRICS).miss(Quantity(value)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not of the form"),
        ("skipped", "not of the form"),
        ("skipped > 5 % 6", "not of the form"),
        ("skipped => 5", "not of the form"),
        ("5 < skipped", "not of the form"),
        ("skiped > 5", "Did you mean 'skipped'"),
        ("__class__ > 5", "not of the form"),
        ("skipped > five", "'five' is not a number"),
        ("skipped > nan", "not a number"),
        ("skipped > inf", "not a number"),
        ("skipped > 0x10", "not a number"),
        ("skipped > 1_000", "not a number"),
        ("skipped > 1e999", "too large"),
        ("entropy > 5 %", "Leave out the %"),
    ],
)
def test_bad_rules_are_refused(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        parse_rule(text, METRICS)
    assert caught.value.exit_code == 2


@given(st.text())
def test_any_text_is_a_rule_or_refused(text: str) -> None:
    try:
        rule = parse_rule(text, METRICS)
    except UsageError:
        return
    assert parse_rule(str(rule), METRICS).metric == rule.metric


def test_misses_tell_value_and_rule() -> None:
    rules = [parse_rule("skipped > 5 %", METRICS), parse_rule("entropy > 1", METRICS)]
    found = misses(rules, {"skipped": Quantity(1.0, 8.0), "entropy": Quantity(0.5)})
    assert found == ["skipped is 12.5 % (rule: skipped > 5 %)"]


def test_junit_counts_and_names_every_case() -> None:
    text = junit_xml(
        "fleet",
        [
            JunitCase("a", 1.25),
            JunitCase("b", 0.5, failures=("too many skipped\nby far", "too few objects")),
            JunitCase("c", error="cut off", failures=("ignored",)),
            JunitCase("d", skipped="done before", output="text"),
        ],
    )
    root = ElementTree.fromstring(text)
    suite = root[0]
    assert root.tag == "testsuites"
    expected = {"tests": "4", "failures": "1", "errors": "1", "skipped": "1", "time": "1.750"}
    assert expected.items() <= suite.attrib.items()
    assert [case.get("name") for case in suite] == ["a", "b", "c", "d"]
    assert [[child.tag for child in case] for case in suite] == [
        [],
        ["failure"],
        ["error"],
        ["skipped", "system-out"],
    ]
    failure = suite[1][0]
    assert failure.get("message") == "too many skipped"
    assert failure.text == "too many skipped\nby far\ntoo few objects"


@given(st.text(), st.text())
def test_junit_can_hold_any_text(name: str, message: str) -> None:
    root = ElementTree.fromstring(junit_xml(name, [JunitCase(name, error=message)]))
    assert len(root[0]) == 1
