"""What `check` finds in a model: where inequality (12) is violated, and by how much."""

from __future__ import annotations

from collections.abc import Sequence

from mclass.checks import MATTERS, Violation
from mclass.text.documents import JsonObject, finite
from mclass.text.terminal import Terminal, wrap
from mclass.text.values import share_text

_ENDLESS = 1e6


def check_json(violations: Sequence[Violation]) -> JsonObject:
    """The violations of inequality (12), in metres and 1/m²."""
    return {
        "violations": [
            {
                "class": violation.class_name,
                "label": violation.label,
                "true_label": violation.true_label,
                "position": [finite(value) for value in violation.position],
                "confusion_density": finite(violation.confusion_density),
                "true_density": finite(violation.true_density),
                "ratio": finite(violation.ratio),
                "share": finite(violation.share),
                "greatest_ratio": finite(violation.greatest_ratio),
            }
            for violation in violations
        ]
    }


def check_text(
    violations: Sequence[Violation], terminal: Terminal, unit: tuple[str, float] = ("m", 1.0)
) -> str:
    """Report on inequality (12), in the model file's own unit.

    Args:
        violations: One for each class and confusing label that violates it.
        terminal: What the reader's terminal can show.
        unit: Name of the length unit, and metres in one.
    """
    if not violations:
        return "Inequality (12) holds: every class is likeliest to return its own label."
    lines = [
        terminal.paint("Inequality (12) does not hold everywhere.", "warning"),
        *wrap(
            "From some places a confusing label is likelier than the class's own; there it "
            "misleads. Places matter where the class returns one of the two labels with at least "
            f"{MATTERS:.0%} of the peak density of its own.".replace("%", " %"),
            terminal,
        ),
    ]
    for violation in violations:
        lines += ["", *_violation_lines(violation, terminal, unit)]
    return "\n".join(lines)


def _violation_lines(
    violation: Violation, terminal: Terminal, unit: tuple[str, float]
) -> list[str]:
    """Who confuses what, in how much of the region, and where most."""
    name, metres = unit
    # Polishing leaves 1e-20 where it means 0; minus zero is zero.
    x, y = (round(float(value) / metres, 6) + 0.0 for value in violation.position)
    # A density per square metre holds fewer of them in a smaller unit's square.
    confusion, own = (
        density * metres**2 for density in (violation.confusion_density, violation.true_density)
    )
    what = (
        f"class {terminal.clean(violation.class_name)}: label {terminal.clean(violation.label)} "
        f"is likelier than {terminal.clean(violation.true_label)} in "
        f"{share_text(violation.share)} of the places that matter"
    )
    where = (
        f"  most at ({x:.3g}, {y:.3g}) {name} from the object, in its frame: {confusion:.3g} "
        f"against {own:.3g} per {name}{terminal.sign('²')}, {_times(violation.ratio)}; "
        f"anywhere up to {_times(violation.greatest_ratio)}"
    )
    return [*wrap(what, terminal, "  "), *wrap(where, terminal, "  ")]


def _times(ratio: float) -> str:
    """``2.5 times``; beyond a million the digits say nothing."""
    return f"{ratio:.3g} times" if ratio < _ENDLESS else "over a million times"
