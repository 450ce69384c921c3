"""The page: the template with a report's document in it, and how it is written."""

from __future__ import annotations

import base64
import hashlib
import json
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from mclass.logs.pending import PendingFile
from mclass.outputs.readback import OutputLog
from mclass.places import Place, Url
from mclass.progress import Progress, in_bytes, unheard
from mclass.report.document import report_document
from mclass.report.timeline import Json

SCRIPTS = ("format", "data", "state", "view", "map", "charts", "objects", "facts", "main")
"""In the order in which they use each other."""


@dataclass(frozen=True)
class Written:
    """What a report holds.

    Attributes:
        path: Of the page.
        size: In bytes.
        objects: How many.
        measurements: How many.
        maps: How many of the stored maps.
        damage: Sentences on parts of the output that could not be read.
    """

    path: Path
    size: int
    objects: int
    measurements: int
    maps: int
    damage: tuple[str, ...]


def default_page(out: Place) -> Path:
    """``OUT-stem.html`` beside the output; of a URL, in the working directory."""
    name = f"{out.stem}.html"
    return Path(name) if isinstance(out, Url) else out.with_name(name)


def write_report(
    out: Place,
    page: Path | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = unheard,
) -> Written:
    """Write an output as a page; the same output gives the same bytes.

    Args:
        out: Written by `mclass.pipeline.estimate`.
        page: Where to; beside the output when None.
        overwrite: Replace a page that is there.
        progress: Told how far the work is.

    Raises:
        LogError: If the output cannot be read, or the page cannot be written.
    """
    target = default_page(out) if page is None else page
    with OutputLog.open(out) as output:
        output.reader.on_read = in_bytes(progress, "reading")
        # Refused before any work is done.
        pending = PendingFile(target, overwrite=overwrite, source=output.reader.source)
        document = report_document(output)
        damage = output.reader.damage.losses
        progress("composing", 0, 0, "")
        data = page_html(document).encode("utf-8")
        try:
            pending.open()
            pending.write(data)
            pending.publish()
        finally:
            pending.discard()
    return Written(
        path=target,
        size=len(data),
        objects=len(document["objects"]),
        measurements=document["steps"]["total"],
        maps=len(document["map"]["seconds"]) if document["map"] else 0,
        damage=tuple(damage),
    )


def page_html(document: Json) -> str:
    """The page that shows a document."""
    style = _web("style.css")
    script = "\n".join(['"use strict";', *(_web(f"{name}.js") for name in SCRIPTS)])
    parts = {
        "policy": (
            f"default-src 'none'; script-src {_source_of(script)}; "
            f"style-src {_source_of(style)}; base-uri 'none'; form-action 'none'"
        ),
        "style": style,
        "script": script,
        "document": json_data(document),
    }
    # The template is cut once, so that nothing in a part is taken for a place of another.
    page = []
    for piece in _web("page.html").split("{{"):
        name, found, rest = piece.partition("}}")
        page.append(parts[name] + rest if found else piece)
    return "".join(page)


def json_data(document: Json) -> str:
    """JSON that can stand in a script element: no character of it begins a tag or comment."""
    text = json.dumps(document, allow_nan=False, separators=(",", ":"))
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _web(name: str) -> str:
    """Text of one file of the template."""
    return files("mclass.report").joinpath("web", name).read_text(encoding="utf-8")


def _source_of(text: str) -> str:
    """What a policy calls an element of exactly this text."""
    digest = base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
    return f"'sha256-{digest}'"
