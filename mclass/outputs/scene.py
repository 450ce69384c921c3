"""What viewers draw of an object, the same for markers and scene entities."""

from __future__ import annotations

import math
from dataclasses import dataclass

from mclass.classes import BACKGROUND
from mclass.outputs.colors import class_color
from mclass.outputs.names import display_text
from mclass.results import ObjectEstimate

_CELLS_PER_ARROW = 4.0
_SHORTEST, _LONGEST = 0.2, 1.0


@dataclass(frozen=True)
class ObjectScene:
    """Arrows, a cube and a name at one object's position.

    Attributes:
        x: Position [m].
        y: Position [m].
        text: Name, class and its probability.
        color: Of the named class, 0 to 1.
        arrows: Orientation [rad] and opacity of each mode.
    """

    x: float
    y: float
    text: str
    color: tuple[float, float, float]
    arrows: tuple[tuple[float, float], ...]


def object_scene(estimate: ObjectEstimate, class_names: tuple[str, ...]) -> ObjectScene:
    """The scene of one object; an arrow is as opaque as its mode is heavy."""
    probabilities = estimate.class_probabilities
    if estimate.unexplained:
        text = f"{display_text(estimate.object_id)}\nno class explains its labels"
        x, y = (float(value) for value in estimate.position)
        return ObjectScene(x, y, text, class_color(estimate.class_index), ())
    names = " = ".join(class_names[index] for index in estimate.tie or (estimate.class_index,))
    text = f"{display_text(estimate.object_id)}\n{display_text(names)} "
    text += f"{probabilities[1 + estimate.class_index]:.0%}"
    if probabilities[0] > probabilities[1 + estimate.class_index]:
        text += f" ({BACKGROUND} {probabilities[0]:.0%})"
    return ObjectScene(
        float(estimate.position[0]),
        float(estimate.position[1]),
        text,
        class_color(estimate.class_index),
        tuple((mode.orientation, mode.mass) for mode in estimate.modes),
    )


def arrow_length(cell_size: float) -> float:
    """Length of arrows [m] that suits a map with such cells."""
    return min(max(_CELLS_PER_ARROW * cell_size, _SHORTEST), _LONGEST)


def quaternion_of(heading: float) -> tuple[float, float, float, float]:
    """Turn about z as quaternion x, y, z, w."""
    return 0.0, 0.0, math.sin(heading / 2.0), math.cos(heading / 2.0)
