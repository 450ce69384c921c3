"""Results as words and documents: pure functions from values to text and JSON."""

from mclass.text.cells import cell_text, history_text
from mclass.text.checks import check_json, check_text
from mclass.text.documents import cell_json, estimate_json, object_json, objects_json
from mclass.text.logs import LogFacts, log_json, log_text
from mclass.text.objects import objects_text
from mclass.text.reports import estimate_text
from mclass.text.terminal import Terminal

__all__ = [
    "LogFacts",
    "Terminal",
    "cell_json",
    "cell_text",
    "check_json",
    "check_text",
    "estimate_json",
    "estimate_text",
    "history_text",
    "log_json",
    "log_text",
    "object_json",
    "objects_json",
    "objects_text",
]
