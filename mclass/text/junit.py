"""Results as JUnit XML, which CI servers show as tests."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from xml.etree import ElementTree

_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Characters that XML 1.0 cannot hold in any way."""


@dataclass(frozen=True)
class JunitCase:
    """One test.

    Attributes:
        name: Shown by the CI server.
        seconds: Time it took.
        failures: What was expected and did not hold, in words; empty when all did.
        error: Why there is no result to judge; empty when there is one.
        skipped: Why it was not run; empty when it was.
        output: Further text.
    """

    name: str
    seconds: float = 0.0
    failures: tuple[str, ...] = ()
    error: str = ""
    skipped: str = ""
    output: str = ""


def junit_xml(suite: str, cases: Iterable[JunitCase]) -> str:
    """A document of one suite; characters that XML cannot hold are replaced.

    Args:
        suite: Name of the suite.
        cases: Its tests.
    """
    tests = list(cases)
    counts = {
        "tests": len(tests),
        "failures": sum(bool(case.failures) and not case.error for case in tests),
        "errors": sum(bool(case.error) for case in tests),
        "skipped": sum(bool(case.skipped) for case in tests),
    }
    attributes = {
        "name": _clean(suite),
        **{key: str(count) for key, count in counts.items()},
        "time": f"{sum(case.seconds for case in tests):.3f}",
    }
    root = ElementTree.Element("testsuites", attributes)
    element = ElementTree.SubElement(root, "testsuite", attributes)
    for case in tests:
        _add(element, suite, case)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n'


def _add(suite: ElementTree.Element, suite_name: str, case: JunitCase) -> None:
    test = ElementTree.SubElement(
        suite,
        "testcase",
        {
            "classname": _clean(suite_name),
            "name": _clean(case.name),
            "time": f"{case.seconds:.3f}",
        },
    )
    if case.error:
        _say(test, "error", (case.error,))
    elif case.failures:
        _say(test, "failure", case.failures)
    elif case.skipped:
        ElementTree.SubElement(test, "skipped", {"message": _clean(case.skipped)})
    if case.output:
        ElementTree.SubElement(test, "system-out").text = _clean(case.output)


def _say(test: ElementTree.Element, tag: str, sentences: tuple[str, ...]) -> None:
    """The first sentence as the message, all of them as the text."""
    texts = [_clean(sentence) for sentence in sentences]
    element = ElementTree.SubElement(test, tag, {"message": texts[0].partition("\n")[0]})
    element.text = "\n".join(texts)


def _clean(text: str) -> str:
    return _NOT_XML.sub("\ufffd", text)
