"""Which logs a batch works on, and what their outputs are called."""

from __future__ import annotations

import glob
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mclass.batch.record import LogResult
from mclass.errors import UsageError
from mclass.logs.stores import LISTED, Store
from mclass.places import Place, Url, place_of

_LOG_SUFFIX = ".mcap"
OUTPUT_SUFFIX = ".mclass.mcap"


@dataclass(frozen=True)
class Job:
    """One log to be done.

    Attributes:
        log: Where it is.
        folder: Where the output goes.
        entry: Its entry in the record, an earlier run's if there was one.
    """

    log: Place
    folder: Place
    entry: LogResult


def find_logs(sources: Sequence[str], folder: Place) -> list[Place]:
    """Logs named by paths, URLs, folders and patterns; each once, in a fixed order.

    Args:
        sources: A folder stands for all logs in it and below, except hidden files and what
            `mclass estimate` wrote. A pattern may hold ``*``, ``?``, ``[...]`` and ``**``.
            A file that is not there is kept: that it cannot be read is one log's failure.
        folder: The batch's own, in which nothing is looked for.

    Raises:
        UsageError: If a folder or pattern stands for no log at all.
        LogError: If a store fails.
    """
    own = os.path.realpath(folder) if isinstance(folder, Path) else ""
    logs: dict[str, Place] = {}
    for source in sources:
        place = place_of(source)
        if isinstance(place, Url):
            logs |= {url.address: url for url in _logs_at(place, folder)}
            continue
        if os.path.isdir(source):
            found, what = _logs_below(source, own), "holds no .mcap logs"
        elif glob.has_magic(source) and not os.path.exists(source):
            matches = sorted(glob.glob(source, recursive=True))
            found = [path for path in matches if not _is_below(path, own)]
            found = [
                log
                for path in found
                for log in (_logs_below(path, own) if os.path.isdir(path) else [path])
            ]
            what = "matches nothing"
        else:
            found, what = [source], ""
        if not found:
            raise UsageError(f"{source}: {what}")
        for path in found:
            logs.setdefault(os.path.abspath(path), Path(path))
    return list(logs.values())


def _logs_at(url: Url, folder: Place) -> list[Url]:
    """The log at a URL, or all in the folder there, or those that a pattern stands for."""
    if url.scheme not in LISTED:
        return [url]
    if glob.has_magic(url.address):
        found, what = Store(url).match(), "matches nothing"
    elif url.name.lower().endswith(_LOG_SUFFIX) and not url.address.endswith("/"):
        return [url]
    else:
        found, what = Store(url).find(), "holds no .mcap logs"
        found = [log for log in found if _is_log(log.name)]
    own = f"{folder.address.rstrip('/')}/" if isinstance(folder, Url) else None
    found = [log for log in found if own is None or not log.address.startswith(own)]
    if not found:
        raise UsageError(f"{url}: {what}")
    return found


def _is_log(name: str) -> bool:
    lower = name.lower()
    return (
        lower.endswith(_LOG_SUFFIX)
        and not lower.endswith(OUTPUT_SUFFIX)
        and not lower.startswith(".")
    )


def _logs_below(top: str, own: str) -> list[str]:
    """All logs in a folder and below, sorted."""
    logs = []
    for folder, folders, files in os.walk(top):
        folders[:] = sorted(
            name
            for name in folders
            if not name.startswith(".") and os.path.realpath(os.path.join(folder, name)) != own
        )
        if os.path.realpath(folder) == own:
            continue
        logs += [os.path.join(folder, name) for name in sorted(files) if _is_log(name)]
    return logs


def _is_below(path: str, own: str) -> bool:
    real = os.path.realpath(path)
    return real == own or real.startswith(own + os.sep)


def plan(
    logs: Iterable[Place], folder: Place, known: Sequence[LogResult], *, overwrite: bool
) -> list[Job]:
    """A job for every log, each with an output of its own and a blank entry.

    A log keeps the name it has in the record; a new one is named by its stem, with a number
    if another log has that name.

    Args:
        logs: Distinct logs.
        folder: Of the batch.
        known: The folder's record.
        overwrite: Whether files may be replaced that are not in the record.

    Raises:
        UsageError: If a file that is not in the record is in the way, or two web addresses
            differ in nothing that may be recorded.
        LogError: If a store fails.
    """
    names: Mapping[str, tuple[str, str]] = {
        entry.input: (entry.name, entry.output) for entry in known
    }
    taken = {entry.name.casefold() for entry in known}
    there = _names_in(folder)
    jobs: list[Job] = []
    places: set[str] = set()
    for log in logs:
        place = _relative(log, folder)
        if place in places:
            raise UsageError(f"{log}: two logs differ only behind the ?, which is not recorded")
        places.add(place)
        if place in names:
            name, output = names[place]
        else:
            name = _free_name(log.stem, taken)
            taken.add(name.casefold())
            output = name + OUTPUT_SUFFIX
            if output in there and not overwrite:
                raise UsageError(
                    f"{folder / output} is there and not from this batch. "
                    "Choose another folder, or add --overwrite."
                )
        jobs.append(Job(log, folder, LogResult(name, place, output)))
    return jobs


def _free_name(stem: str, taken: set[str]) -> str:
    number, name = 1, stem
    while name.casefold() in taken:
        number += 1
        name = f"{stem}-{number}"
    return name


def _names_in(folder: Place) -> set[str]:
    """What is in a folder."""
    if isinstance(folder, Url):
        return {found.name for found in Store(folder).children()}
    return set(os.listdir(folder)) if folder.is_dir() else set()


def _relative(log: Place, folder: Place) -> str:
    """The log seen from the folder: both can then be moved together."""
    if isinstance(log, Url):
        return str(log)
    if isinstance(folder, Url):
        return log.absolute().as_posix()
    try:
        return Path(os.path.relpath(os.path.abspath(log), os.path.abspath(folder))).as_posix()
    except ValueError:  # another drive
        return Path(os.path.abspath(log)).as_posix()
