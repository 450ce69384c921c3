"""What `inspect model` says: what each class returns, and from where."""

from __future__ import annotations

import numpy as np

from mclass.classes import LabelLikelihood
from mclass.model import LENGTH_UNITS, Model
from mclass.text.documents import JsonObject
from mclass.text.terminal import Terminal, table


def model_json(model: Model) -> JsonObject:
    """The likelihoods in metres: every viewpoint of every class and label."""
    classes = model.classes
    return {
        "model": model.name,
        "preset": model.inference.preset,
        "priors": dict(
            zip(("background", *classes.class_names), np.exp(classes.log_priors), strict=True)
        ),
        "background_likelihood": dict(
            zip(classes.label_names, np.exp(classes.background_log_likelihood), strict=True)
        ),
        "likelihoods": [
            {
                "class": classes.class_names[class_index],
                "label": classes.label_names[label],
                "probability": entry.probability,
                "clutter": entry.clutter,
                "peak": float(np.exp(entry.log_likelihood(entry.mixture.means).max())),
                "viewpoints": [
                    {
                        "weight": float(entry.mixture.weights[m]),
                        "position": entry.mixture.means[m].tolist(),
                        "covariance": entry.mixture.covariances[m].tolist(),
                    }
                    for m in range(len(entry.mixture.weights))
                ],
            }
            for (class_index, label), entry in sorted(classes.likelihoods.items())
        ],
    }


def model_text(model: Model, terminal: Terminal) -> str:
    """A line a viewpoint, lengths in the file's own unit."""
    classes, unit = model.classes, model.length_unit
    scale = LENGTH_UNITS[unit]
    rows = []
    for (class_index, label), entry in sorted(classes.likelihoods.items()):
        names = [classes.class_names[class_index], classes.label_names[label]]
        for line in _viewpoint_lines(entry, scale):
            rows.append([*(terminal.clean(name) if name else "" for name in names), *line])
            names = ["", ""]
    headings = [
        "class",
        "label",
        "P",
        "weight",
        f"seen from [{unit}]",
        f"deviation [{unit}]",
        f"peak [1/{unit}2]",
    ]
    lines = table(headings, rows, "<<>><<>", terminal)
    priors = ", ".join(
        f"{terminal.clean(name)} {prior:.3g}"
        for name, prior in zip(
            ("background", *classes.class_names), np.exp(classes.log_priors), strict=True
        )
    )
    head = f"{terminal.clean(model.name)}, preset {model.inference.preset}, priors: {priors}"
    return "\n".join([head, "", *lines])


def _viewpoint_lines(entry: LabelLikelihood, scale: float) -> list[list[str]]:
    """Probability, weight, position, deviations along the axes, and peak of each viewpoint."""
    lines = []
    peaks = np.exp(entry.log_likelihood(entry.mixture.means)) * scale**2
    for m, weight in enumerate(entry.mixture.weights):
        x, y = entry.mixture.means[m] / scale
        deviations = np.sqrt(np.diag(entry.mixture.covariances[m])) / scale
        lines.append(
            [
                f"{entry.probability:g}" if m == 0 else "",
                f"{weight:g}",
                f"({x:g}, {y:g})",
                f"{deviations[0]:.3g}, {deviations[1]:.3g}",
                f"{peaks[m]:.3g}",
            ]
        )
    return lines
