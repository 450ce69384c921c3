"""What `inspect log` says: what is in a log, what of it would be used, and why not the rest."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from mclass.text.documents import JsonObject
from mclass.text.terminal import Terminal, table, wrap
from mclass.text.values import count_text, list_text, seconds_text, stamp_text

if TYPE_CHECKING:  # Printing objects need not load what reads logs.
    from mclass.logs.survey import ChannelUse, Survey

_FIELD = 13
_LISTED_LABELS = 20


@dataclasses.dataclass(frozen=True)
class Verification:
    """What was looked at when every byte of a log was checked, and what came out.

    Attributes:
        bytes: Size of the file.
        chunks: Chunks and runs of messages without one.
        messages: In them.
        attachments: In the file.
        data_checksum: Whether the data section as a whole carries one; others may.
        problems: What is wrong, in sentences.
    """

    bytes: int
    chunks: int
    messages: int
    attachments: int
    data_checksum: bool
    problems: Sequence[str] = ()


@dataclasses.dataclass(frozen=True)
class LogFacts:
    """What a log says of itself.

    Attributes:
        path: As the user gave it.
        size: Bytes.
        profile: ``ros2``, often empty.
        library: What wrote it.
        start_ns: First log time, None in an empty log.
        end_ns: Last log time.
        damage: What was lost, in sentences.
        remarks: What was wrong without costing data, in sentences.
        verification: Of every byte, None unless that was asked for.
    """

    path: str
    size: int
    profile: str
    library: str
    start_ns: int | None
    end_ns: int | None
    damage: Sequence[str] = ()
    remarks: Sequence[str] = ()
    verification: Verification | None = None


def log_json(facts: LogFacts, survey: Survey) -> JsonObject:
    """The document of ``inspect log``; the survey's own names."""
    return {
        "log": facts.path,
        "size": facts.size,
        "profile": facts.profile,
        "library": facts.library,
        "start_ns": None if facts.start_ns is None else str(facts.start_ns),
        "end_ns": None if facts.end_ns is None else str(facts.end_ns),
        "damage": list(facts.damage),
        "remarks": list(facts.remarks),
        "verified": dataclasses.asdict(facts.verification) if facts.verification else None,
        **{
            name: value
            for name, value in dataclasses.asdict(dataclasses.replace(survey, course=None)).items()
            if name != "course"
        },
        "together": [
            {"labels": [first, second], "count": count} for first, second, count in survey.together
        ],
    }


def log_text(facts: LogFacts, survey: Survey, terminal: Terminal) -> str:
    """A log at a glance, then its channels: those used, and the others by reason."""
    lines = [
        *_field("log", f"{facts.path}, {facts.size:,} bytes", terminal),
        *_field("recorded", _recorded(facts), terminal),
    ]
    for sentence in _uses(survey):
        lines += _field("used", sentence, terminal)
    if survey.labels:
        lines += _field("labels", _labels(survey), terminal)
    if survey.together:
        lines += _field("together", _together(survey), terminal)
    if facts.verification is not None:
        lines += _field("verified", _verified(facts.verification), terminal)
    for sentence in (*survey.notes, *facts.remarks):
        lines += _field("note", sentence, terminal)
    for sentence in _left_out(survey):
        lines += _field("left out", sentence, terminal)
    warnings = [("damaged", sentence) for sentence in facts.damage]
    if survey.problem:
        warnings.append(("problem", f"estimate would fail: {survey.problem}"))
    for name, sentence in warnings:
        lines += [terminal.paint(line, "warning") for line in _field(name, sentence, terminal)]
    return "\n".join([*lines, "", *_channel_table(survey.channels, terminal)])


def _field(name: str, value: str, terminal: Terminal) -> list[str]:
    """One field, wrapped beside its name; values hold foreign text."""
    text = f"{name:{_FIELD}}{terminal.clean(value, 2000)}"
    return wrap(text, terminal, " " * _FIELD)


def _recorded(facts: LogFacts) -> str:
    """When and by what."""
    parts = ["no messages"]
    if facts.start_ns is not None and facts.end_ns is not None:
        parts = [
            stamp_text(facts.start_ns),
            f"{seconds_text(facts.end_ns - facts.start_ns)} s",
        ]
    if facts.profile:
        parts.append(f"profile {facts.profile}")
    if facts.library:
        parts.append(f"by {facts.library}")
    return ", ".join(parts)


def _uses(survey: Survey) -> Iterable[str]:
    """Detections, poses and sensors in use."""
    if survey.detections:
        yield (
            f"detections on {list_text(survey.detections)}: {survey.detection_count} in "
            f"{count_text(survey.looks, 'message')}, {count_text(survey.ids, 'object id')}"
        )
    if survey.pose_kind:
        source = f"{survey.pose_topic} ({survey.pose_kind})"
        if survey.transform is not None:
            source = f"transforms ({survey.transform[0]} to {survey.transform[1]})"
        yield (
            f"poses from {source}: {survey.pose_count} of "
            f"{survey.robot_frame or 'an unnamed frame'} in "
            f"{survey.world_frame or 'an unnamed frame'}, covering {survey.placed} of "
            f"{count_text(survey.looks, 'detection message')}"
        )
    for sensor in survey.sensors:
        name = sensor.frame or "an unnamed frame"
        what = "camera" if sensor.optical else "sensor"
        size = ""
        if sensor.image_size is not None:
            size = ", {} x {} pixels".format(*sensor.image_size)
        calibration = ""
        if sensor.optical:
            known = f"calibrated by {sensor.camera_topic or 'the model file'}"
            calibration = f", {known}" if sensor.calibrated else ", not calibrated"
        place = "place on the robot known" if sensor.placed else "place on the robot assumed"
        yield f"{what} {name} of {sensor.topic}{size}{calibration}, {place}"


def _labels(survey: Survey) -> str:
    """Labels with their counts; numbers with their names; those that the model lacks."""
    parts = []
    for label, count in list(survey.labels.items())[:_LISTED_LABELS]:
        name = f" ({survey.label_names[label]})" if label in survey.label_names else ""
        unknown = " (not in the model)" if label in survey.unknown_labels else ""
        parts.append(f"{label or repr('')}{name} {count}{unknown}")
    if len(survey.labels) > _LISTED_LABELS:
        parts.append(f"and {len(survey.labels) - _LISTED_LABELS} more")
    return ", ".join(parts)


def _together(survey: Survey) -> str:
    """Pairs of labels that were returned for one thing at one instant."""
    parts = [f"{a or repr('')} and {b or repr('')} {count}" for a, b, count in survey.together]
    rest = len(parts) - _LISTED_LABELS
    return ", ".join(parts[:_LISTED_LABELS]) + (f", and {rest} more pairs" if rest > 0 else "")


def _verified(done: Verification) -> str:
    """What was checked, and the result."""
    read = ", ".join(
        (
            f"{done.bytes:,} bytes",
            f"{done.messages:,} " + ("message" if done.messages == 1 else "messages"),
            f"in {count_text(done.chunks, 'chunk')}",
            count_text(done.attachments, "attachment"),
        )
    ).replace(", in", " in")
    checks = "checksums, message indexes and times"
    if not done.data_checksum:
        checks += " (the data section as a whole has no checksum)"
    if done.problems:
        return f"{read}; {checks}: {count_text(len(done.problems), 'problem')}, as said below"
    return f"{read}; {checks}: nothing is wrong"


def _left_out(survey: Survey) -> Iterable[str]:
    """Poses that cannot be used, by reason; messages that cannot are damage."""
    for reason, count in survey.pose_problems.items():
        yield f"{count} {reason}"


def _channel_table(channels: Sequence[ChannelUse], terminal: Terminal) -> list[str]:
    """Channels under the use, or the reason against it, that they share."""
    if not channels:
        return ["no channels"]
    groups: dict[str, list[Sequence[str]]] = {}
    for channel in sorted(channels, key=lambda channel: not channel.used):
        rows = groups.setdefault(_use(channel), [])
        count = "?" if channel.count is None else str(channel.count)
        rate = "" if channel.rate is None or channel.count == 1 else f"{channel.rate:.3g}"
        topic, schema = terminal.clean(channel.topic), terminal.clean(channel.schema)
        rows.append([f"  {topic}", count, rate, schema])
    rows = []
    for use, members in groups.items():
        rows.append(["\n".join(wrap(terminal.clean(use, 500), terminal, "    "))])
        rows += members
    headings = ["channels", "messages", "Hz", "type"]
    return table(headings, rows, "<>><", terminal, elastic=(0, 3))


def _use(channel: ChannelUse) -> str:
    """``used for detections (Detection2DArray)``, ``not used: not a type that is read``."""
    if channel.used:
        return f"used for {channel.role} ({channel.why})"
    return f"not used: {channel.why}"
