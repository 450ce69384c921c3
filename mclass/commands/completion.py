"""What the shell offers when the Tab key is pressed: files that fit, ids and names from them.

Whatever goes wrong here is passed over in silence: an error message would end up in the middle
of the command line that is being typed.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.shell_completion import CompletionItem

if TYPE_CHECKING:
    from mclass.outputs.readback import OutputLog

Completer = Callable[[click.Context, click.Parameter, str], list[CompletionItem]]

# Names that every shell takes as one word without quotes.
_PLAIN = re.compile(r"[\w./+@%-]+")


class FileType(click.Path):
    """A path; files of some kinds are offered, and others where there are none.

    Whether it can be read is said by the reader, with what to do.

    Args:
        suffixes: Of the files to offer.
        settings: For `click.Path`.
    """

    name = "path"

    def __init__(self, *suffixes: str, **settings: Any) -> None:
        super().__init__(path_type=Path, **settings)
        self._suffixes = suffixes

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """See `click.ParamType.shell_complete`."""
        if "://" in incomplete:
            return []
        if not self.file_okay:
            return [CompletionItem(incomplete, type="dir")]
        try:
            files, folders = _matches(incomplete, self._suffixes)
        except OSError:
            files, folders = [], False
        if files and not folders and all(map(_PLAIN.fullmatch, files)):
            return [CompletionItem(name) for name in files]
        # The shell's own completion goes on behind folders and quotes what needs quotes.
        return [CompletionItem(incomplete, type="dir" if folders and not files else "file")]


def _matches(incomplete: str, suffixes: Sequence[str]) -> tuple[list[str], bool]:
    """Files that begin so, as they would be typed, and whether folders do too."""
    head, start = os.path.split(incomplete)
    files, folders = [], False
    with os.scandir(head or ".") as entries:
        for entry in entries:
            if not entry.name.startswith(start) or (entry.name.startswith(".") and not start):
                continue
            if entry.is_dir():
                folders = True
            elif entry.name.endswith(tuple(suffixes)):
                files.append(os.path.join(head, entry.name))
    return sorted(files), folders


def object_ids(name: str) -> Completer:
    """Ids of the objects in the output that another parameter names."""
    return _from_outputs(name, lambda output: [one.object_id for one in output.objects()])


def world_frames(name: str) -> Completer:
    """World frames of the outputs that another parameter names."""
    return _from_outputs(name, lambda output: [output.frame])


def figures(names: Callable[[], Iterable[str]]) -> Completer:
    """Figures that a rule may be about."""
    return lambda ctx, param, incomplete: _offered(names, incomplete)


def _from_outputs(name: str, texts: Callable[[OutputLog], Iterable[str]]) -> Completer:
    def complete(ctx: click.Context, param: click.Parameter, typed: str) -> list[CompletionItem]:
        def read() -> Iterable[str]:
            from mclass.outputs.readback import OutputLog
            from mclass.text.values import natural

            # An option that still lacks its value leaves the arguments before it unnamed.
            value = ctx.params.get(name) or tuple(filter(os.path.isfile, ctx.args))
            found: dict[str, None] = {}
            for place in value if isinstance(value, tuple) else (value,):
                with OutputLog.open(place) as output:
                    found.update(dict.fromkeys(texts(output)))
            return sorted(found, key=natural)

        return _offered(read, typed)

    return complete


def _offered(texts: Callable[[], Iterable[str]], incomplete: str) -> list[CompletionItem]:
    """The texts that begin so, or none where they cannot be had."""
    try:
        found = list(texts())
    except Exception:
        return []
    # Control characters must not reach the terminal, nor line breaks the shell's parser.
    return [CompletionItem(t) for t in found if t.startswith(incomplete) and t.isprintable()]
