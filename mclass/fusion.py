"""Outputs of several logs or robots to one map.

Each output holds its measurements and frames exactly. They are joined in one world and
inferred anew, so that the belief is that of one log holding all of them: the prior counts
once, and looks from one place share one vote whichever log they are in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mclass.config import yaml_source
from mclass.config.checks import Value
from mclass.config.frames_file import load_frames
from mclass.config.model_file import parse_model
from mclass.config.yaml_source import Problems
from mclass.errors import UsageError
from mclass.findings import Estimate
from mclass.joining import Part, join
from mclass.model import Model
from mclass.outputs.channels import Encoding
from mclass.outputs.readback import OutputLog
from mclass.pipeline import ModelSource, infer, model_of
from mclass.places import Place, PlaceLike, place_of
from mclass.progress import Progress, unheard
from mclass.records import FloatArray, LabelMeasurements

_OUTPUT_SUFFIXES = (".mclass.mcap", ".mcap")


@dataclass(frozen=True)
class _Output:
    """What fusing needs of one output.

    Attributes:
        path: Of the output.
        name: Unique among the outputs.
        measurements: In its own world.
        frame: Name of that world.
        encoding: ``ros2``, ``protobuf`` or ``json``.
        inputs: Hashes of the logs that it comes from.
        model_text: Its model file.
        model_name: Name of that file.
        damage: What of the output was lost, in sentences.
    """

    path: Place
    name: str
    measurements: LabelMeasurements
    frame: str
    encoding: Encoding
    inputs: frozenset[str]
    model_text: str
    model_name: str
    damage: tuple[str, ...]


def fuse(
    outputs: Sequence[PlaceLike],
    output: PlaceLike | None = None,
    *,
    frames: Path | None = None,
    model: ModelSource | None = None,
    separate_ids: bool = False,
    frame: str | None = None,
    prefix: str = "/mclass",
    overwrite: bool = False,
    progress: Progress = unheard,
) -> Estimate:
    """Fuse outputs of `estimate`, or of this function.

    Args:
        outputs: At least one; their worlds must be the same unless ``frames`` relates them.
        output: Where to write a log of the results alone; None writes nothing.
        frames: YAML file with the pose of each output's world in the common one, as for
            `mclass.config.frames_file.load_frames`; outputs go by path, file name or stem.
        model: What to infer with; that of the outputs, which must then be the same, when None.
        separate_ids: Objects of different outputs are different even if their ids are equal;
            ids become ``NAME/ID``.
        frame: Name of the common world; by default the outputs' own or, with ``frames``, map.
        prefix: Of the topics.
        overwrite: Replace an existing output.
        progress: Told how far the work is.

    Raises:
        UsageError: If the outputs do not fit together.
        ConfigError: If the frames or the model are wrong.
        LogError: If an output cannot be read, or the map cannot be written.
    """
    if not outputs:
        raise UsageError("nothing to fuse: name at least one output")
    sources = _read([place_of(path) for path in outputs], progress)
    if output is not None:
        for source in sources:
            if _is_same(place_of(output), source.path):
                raise UsageError(f"{output} is fused itself, and never changed: choose another -o")
    _refuse_repeats(sources)
    chosen = _common_model(sources) if model is None else model_of(model)
    if separate_ids:
        chosen = replace(
            chosen,
            objects={
                f"{source.name}/{key}": place
                for source in sources
                for key, place in chosen.objects.items()
            },
        )
    inference = chosen.inference
    if inference.trajectory_samples and len(sources) > 1:
        raise UsageError(
            f"{chosen.name} draws trajectories (inference.trajectory_samples) of one log, but "
            "each of these has its own. Say with -c a model without them."
        )
    world = frame or _common_frame(sources, related=frames is not None)
    poses: list[FloatArray] = [np.zeros(3)] * len(sources)
    if frames is not None:
        aliases = [(str(source.path), source.path.name, _stem(source.path)) for source in sources]
        poses = load_frames(frames, [tuple(dict.fromkeys(names)) for names in aliases])
    uncertain = inference.pose_uncertainty or inference.trajectory_samples > 0
    drift = inference.drift if uncertain else 0.0
    parts = [
        Part(source.measurements, pose, source.name if separate_ids else "")
        for source, pose in zip(sources, poses, strict=True)
    ]
    encodings = {source.encoding for source in sources}
    found = infer(
        join(parts, chosen.classes.label_names, drift),
        _without_drift(chosen) if drift > 0.0 else chosen,
        output=output,
        frame=world,
        encoding=encodings.pop() if len(encodings) == 1 else "protobuf",
        prefix=prefix,
        overwrite=overwrite,
        settings={
            "fused": [
                {
                    "output": source.path.name,
                    "inputs": sorted(source.inputs),
                    "pose": pose.tolist(),
                }
                for source, pose in zip(sources, poses, strict=True)
            ],
            "separate_ids": separate_ids,
        },
        progress=progress,
    )
    damage = [f"{source.path.name}: {text}" for source in sources for text in source.damage]
    return replace(found, damage=tuple(damage))


def _is_same(one: Place, other: Place) -> bool:
    if isinstance(one, Path) and isinstance(other, Path):
        return one.exists() and one.samefile(other)
    return one == other


def _read(paths: Sequence[Place], progress: Progress) -> list[_Output]:
    names: list[str] = []
    sources = []
    for count, path in enumerate(paths):
        progress("reading", count, len(paths), "outputs")
        stem, number = _stem(path), 1
        name = stem
        while name in names:
            number += 1
            name = f"{stem}-{number}"
        names.append(name)
        with OutputLog.open(path) as log:
            encoding = log.metadata.get("encoding", "")
            if encoding not in ("ros2", "protobuf", "json"):
                raise UsageError(f"{path}: does not say how it is encoded; estimate it again")
            sources.append(
                _Output(
                    path=path,
                    name=name,
                    measurements=log.measurements(),
                    frame=log.frame,
                    encoding=encoding,  # type: ignore[arg-type]  # compared above
                    inputs=_inputs(log),
                    model_text=log.model_text,
                    model_name=log.model_name,
                    damage=log.reader.damage.losses,
                )
            )
    return sources


def _inputs(log: OutputLog) -> frozenset[str]:
    """Hashes of the logs that an output comes from; a map comes from several."""
    hashes = {log.metadata.get("input_hash", "")}
    try:
        for entry in log.recorded("settings").get("fused", ()):
            hashes.update(entry["inputs"])
    except (KeyError, TypeError):
        pass  # another version's settings; only this check is lost
    return frozenset(hashes - {""})


def _stem(path: Place) -> str:
    for suffix in _OUTPUT_SUFFIXES:
        if path.name.endswith(suffix) and path.name != suffix:
            return path.name.removesuffix(suffix)
    return path.name


def _refuse_repeats(sources: Sequence[_Output]) -> None:
    """The same evidence must not count twice."""
    for index, one in enumerate(sources):
        for other in sources[:index]:
            if one.inputs & other.inputs and _overlap(one.measurements, other.measurements):
                raise UsageError(
                    f"{other.path} and {one.path} hold measurements of the same log and time; "
                    "they would count twice. Leave one out."
                )


def _overlap(one: LabelMeasurements, other: LabelMeasurements) -> bool:
    a, b = one.frames.stamps_ns, other.frames.stamps_ns
    return bool(len(a) and len(b) and a[0] <= b[-1] and b[0] <= a[-1])


def _common_model(sources: Sequence[_Output]) -> Model:
    first = sources[0]
    for other in sources[1:]:
        if other.model_text != first.model_text:
            raise UsageError(
                f"{first.path} and {other.path} were estimated with different models "
                f"({first.model_name} and {other.model_name}). Say with -c which one to use."
            )
    return parse_model(first.model_text, first.model_name)


def _common_frame(sources: Sequence[_Output], *, related: bool) -> str:
    names = sorted({source.frame for source in sources})
    if related:
        return names[0] if names == ["map"] else "map"
    if len(names) > 1:
        raise UsageError(
            f"the outputs are in different worlds, {' and '.join(names)}: "
            "say with --frames how they lie to each other"
        )
    return names[0]


def _without_drift(model: Model) -> Model:
    """The model for measurements whose covariances hold the drift already.

    Each log drifts from its own beginning, which joined measurements no longer show. The
    text is changed too, as the map is read back with the one that is attached to it.
    """
    text = model.source.removeprefix("\ufeff")
    root = yaml_source.compose(text, Problems(model.name))
    section = Value(root, "", root.start_mark, Problems(model.name)).at("inference")
    node = section.at("drift").node
    start, stop = node.start_mark.index, node.end_mark.index
    changed = parse_model(f"{text[:start]}0{text[stop:]}", model.name)
    assert changed.inference.drift == 0.0
    return replace(changed, objects=model.objects)
