"""The sections ``viewpoints``, ``classes`` and ``background`` to a ClassModel in metres."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml

from mclass.classes import ClassModel, LabelLikelihood
from mclass.config.checks import (
    Reader,
    Rejected,
    Value,
    angle,
    attempt,
    coordinate,
    entries,
    fields,
    number,
    several,
    text,
    unknown_name,
    vector,
)
from mclass.viewpoints import ViewpointMixture

DEFAULT_BACKGROUND_DENSITY = 0.1
"""Likelihood of any label where there is no object [1/m²]: the paper's 0.001 per dm² (27)."""

_MIN_VARIANCE, _MAX_VARIANCE = 1e-10, 1e12
_MAX_CONDITION = 1e8
_MIN_BEARING_VARIANCE, _MAX_BEARING_VARIANCE = 1e-8, 100.0

Matrix = tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Viewpoint:
    """One Gaussian of the file, in metres and radians; no bearing term: infinite variance."""

    position: tuple[float, float]
    covariance: Matrix
    bearing: tuple[float, float] = (0.0, math.inf)


@dataclass(frozen=True)
class _ObjectClass:
    prior: float
    labels: Mapping[str, LabelLikelihood | None]


def position(unit: float) -> Reader[tuple[Any, ...]]:
    """``[x, y]`` in units to metres."""
    return vector(coordinate(unit), "x", "y")


def read_label_names(classes: Value | None) -> list[str]:
    """Every label that some class can return, those that are class names first.

    Looks at names only, so that references to labels can be checked whatever else is wrong.
    """
    if classes is None:
        return []
    labels: dict[str, None] = {}
    for _, entry in classes.pairs():
        for key, section in entry.pairs():
            if key.value == "labels":
                labels.update(dict.fromkeys(label.value for label, _ in section.pairs()))
    names = dict.fromkeys(key.value for key, _ in classes.pairs())
    return [*(n for n in names if n in labels), *(n for n in labels if n not in names)]


def read_class_model(top: Mapping[str, Value], labels: Collection[str], unit: float) -> ClassModel:
    """All that says what the recogniser returns, from the sections of a file.

    Args:
        top: Sections by key.
        labels: Label names.
        unit: Metres in one ``length_unit``.

    Raises:
        Rejected: If anything in it is wrong; everything wrong in it has been recorded.
    """
    viewpoints: dict[str, Viewpoint | None] = {}
    for name, value in _some_entries(top.get("viewpoints")).items():
        viewpoints[name] = attempt(lambda child: _viewpoint(child, unit), value, None)
    classes: dict[str, _ObjectClass] = {}
    for name, value in _some_entries(top.get("classes")).items():
        if name == "background":
            problem = "this name stands for 'no object here'; give the class another one"
            value.problems.add(value.mark, value.key, problem)
        read = attempt(lambda child: _object_class(child, viewpoints, unit), value, None)
        classes[name] = read or _ObjectClass(1.0, {})
    prior, densities = attempt(
        lambda child: _background(child, labels, unit),
        top.get("background"),
        (1.0, [DEFAULT_BACKGROUND_DENSITY] * len(labels)),
    )
    priors = np.array([prior, *(entry.prior for entry in classes.values())])
    if classes and not np.any(priors[1:] > 0.0):
        top["classes"].fail("every class has prior 0; give at least one a positive prior")
    likelihoods: dict[tuple[int, int], LabelLikelihood] = {}
    label_indices = {name: index for index, name in enumerate(labels)}
    for c, entry in enumerate(classes.values()):
        for label, likelihood in entry.labels.items():
            if likelihood is not None:
                likelihoods[c, label_indices[label]] = likelihood
    if not likelihoods:
        raise Rejected
    with np.errstate(divide="ignore"):  # a prior of 0 is a log prior of -inf
        log_priors = np.log(priors / priors.sum())
    return ClassModel(
        class_names=tuple(classes),
        label_names=tuple(labels),
        log_priors=log_priors,
        background_log_likelihood=np.log(np.array(densities)),
        likelihoods=likelihoods,
    )


def _some_entries(value: Value | None) -> dict[str, Value]:
    """Entries of a section that must not be empty."""
    if value is not None and (value.is_empty or value.node.value == []):
        value.note("empty; at least one entry is needed")
    return attempt(entries, value, dict[str, Value]())


def _viewpoint(value: Value, unit: float) -> Viewpoint:
    readers = {
        "position": position(unit),
        "covariance": lambda child: _covariance(child, unit),
        "bearing": _bearing,
    }
    return Viewpoint(**fields(value, readers, required=("position", "covariance")))


def _covariance(value: Value, unit: float) -> Matrix:
    """A variance, [xx, yy], or a 2x2 matrix, in unit², to a positive definite one in m²."""
    read = number(scale=unit * unit)
    if not isinstance(value.node, yaml.SequenceNode):
        variance = read(value)
        (xx, xy), (yx, yy) = (variance, 0.0), (0.0, variance)
    else:
        rows = value.elements()
        if len(rows) != 2:
            value.fail(
                f"must be a variance, [xx, yy] or [[xx, xy], [xy, yy]], not {len(rows)} entries"
            )
        if all(isinstance(row.node, yaml.SequenceNode) for row in rows):
            (xx, xy), (yx, yy) = several(vector(read, "a number", "a number"), rows)
        else:
            xx, yy = several(read, rows)
            xy = yx = 0.0
    if abs(xy - yx) > 1e-9 * max(abs(xx), abs(yy)):
        given = f"{xy / unit**2:g} and {yx / unit**2:g}"
        value.fail(f"not symmetric: the entries off the diagonal are {given}; make them equal")
    middle, spread = (xx + yy) / 2.0, math.hypot((xx - yy) / 2.0, xy)
    smallest, largest = middle - spread, middle + spread
    if smallest <= 0.0:
        problem = f"not positive definite (smallest eigenvalue {smallest / unit**2:.6g})"
        value.fail(f"{problem}; check the signs, and that [xy]² is less than [xx] times [yy]")
    if largest > _MAX_CONDITION * smallest:
        ratio = f"the eigenvalues differ by a factor of {largest / smallest:.3g}"
        value.fail(f"nearly singular: {ratio}; at most {_MAX_CONDITION:g} is allowed")
    if smallest < _MIN_VARIANCE or largest > _MAX_VARIANCE:
        low, high = _MIN_VARIANCE / unit**2, _MAX_VARIANCE / unit**2
        value.fail(f"variances must be between {low:g} and {high:g} (length_unit²)")
    return (xx, xy), (xy, yy)


def _bearing(value: Value) -> tuple[float, float]:
    """Mean [rad] and variance [rad²], also given as ``mean_deg`` and ``std_deg``."""
    low, high = _MIN_BEARING_VARIANCE, _MAX_BEARING_VARIANCE
    degree = math.radians(1.0)
    readers = {
        "mean": angle(),
        "variance": number(minimum=low, maximum=high),
        "mean_deg": angle(degree),
        "std_deg": number(minimum=math.sqrt(low), maximum=math.sqrt(high), scale=degree),
    }
    found = fields(value, readers, apart=(("mean", "mean_deg"), ("variance", "std_deg")))
    if not {"variance", "std_deg"} & found.keys():
        value.fail("needs variance (rad²) or std_deg")
    variance = found["variance"] if "variance" in found else found["std_deg"] ** 2
    return found.get("mean", found.get("mean_deg", 0.0)), variance


def _object_class(
    value: Value, viewpoints: Mapping[str, Viewpoint | None], unit: float
) -> _ObjectClass:
    def labels(child: Value) -> dict[str, LabelLikelihood | None]:
        read = {
            name: attempt(lambda entry: _label(entry, viewpoints, unit), entry, None)
            for name, entry in _some_entries(child).items()
        }
        if not any(read.values()) and not child.problems.found:
            child.fail("no label can be returned; give at least one a probability above 0")
        return read

    found = fields(value, {"prior": number(minimum=0.0), "labels": labels}, required=("labels",))
    return _ObjectClass(found.get("prior", 1.0), found["labels"])


def _label(
    value: Value, viewpoints: Mapping[str, Viewpoint | None], unit: float
) -> LabelLikelihood | None:
    """One label of one class; None for a label of probability 0, which cannot be returned."""
    readers = {
        "probability": number(minimum=0.0, maximum=1.0),
        "views": lambda child: _views(child, viewpoints),
        "covariance": lambda child: _covariance(child, unit),
        "clutter": number(minimum=0.0, scale=unit**-2),
    }
    found = fields(value, readers, required=("probability", "views"))
    clutter = found.get("clutter", 0.0)
    if found["probability"] == 0.0:
        if clutter > 0.0:
            value.at("probability").fail("must be above 0 beside clutter; a tiny one will do")
        return None
    seen_from = [viewpoints[name] for name in found["views"]]
    if None in seen_from:
        raise Rejected  # that viewpoint's own fault has been recorded
    known = [view for view in seen_from if view is not None]
    bearings = np.array([view.bearing for view in known])
    mixture = ViewpointMixture(
        weights=np.array(list(found["views"].values())),
        means=np.array([view.position for view in known]),
        covariances=np.array([found.get("covariance", view.covariance) for view in known]),
        bearing_means=bearings[:, 0],
        bearing_variances=bearings[:, 1],
    )
    return LabelLikelihood(found["probability"], mixture, clutter)


def _views(value: Value, viewpoints: Mapping[str, Viewpoint | None]) -> dict[str, float]:
    """Weights by viewpoint name; a plain list of names shares a weight of 1."""
    if isinstance(value.node, yaml.SequenceNode):
        elements = value.elements()
        names = several(text, elements)
        weights = dict.fromkeys(names, 1.0 / max(len(names), 1))
        if len(weights) < len(names):
            value.fail("names a viewpoint twice; remove one")
        given = dict(zip(names, elements, strict=True))
    else:
        given = entries(value)
        weights = {
            name: attempt(number(above=0.0), child, math.nan) for name, child in given.items()
        }
    for name, child in given.items():
        if name not in viewpoints:
            child.problems.add(child.mark, child.key, unknown_name(name, "viewpoint", viewpoints))
    if not weights:
        value.fail("names no viewpoint; name at least one, or remove the label")
    return weights


def _background(value: Value, labels: Collection[str], unit: float) -> tuple[float, list[float]]:
    """Prior of the background, and the density [1/m²] of each label in it."""
    density = number(above=0.0, scale=unit**-2)

    def likelihood(child: Value) -> list[float]:
        if not isinstance(child.node, yaml.MappingNode):
            return [density(child)] * len(labels)
        given = entries(child)
        for name, entry in given.items():
            if name not in labels:
                entry.problems.add(entry.mark, entry.key, unknown_name(name, "label", labels))
        known = dict(zip(given, several(density, given.values()), strict=True))
        return [known.get(name, DEFAULT_BACKGROUND_DENSITY) for name in labels]

    found = fields(value, {"prior": number(minimum=0.0), "likelihood": likelihood})
    default = [DEFAULT_BACKGROUND_DENSITY] * len(labels)
    return found.get("prior", 1.0), found.get("likelihood", default)
