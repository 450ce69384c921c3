"""The common look of all figures: colours, names, scale bars, and how they are saved."""

from __future__ import annotations

import errno
import functools
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ParamSpec

import matplotlib.style
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties, findfont, get_font
from matplotlib.legend import Legend
from matplotlib.patheffects import AbstractPathEffect, Normal, Stroke

from mclass.errors import MclassError, UsageError
from mclass.outputs.colors import class_color
from mclass.text.terminal import Terminal

Parameters = ParamSpec("Parameters")

# Dashes and markers tell classes apart in grey print, where their colours cannot.
CLASS_DASHES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (5, 1, 1, 1)), (0, (1, 1)))
# Seven beside six colours: pairs repeat only after 42 classes.
CLASS_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
BACKGROUND_COLOR = "#767676"
TRACK_COLOR = "#0072B2"
OBJECT_COLOR = "#D55E00"

_STYLE: Mapping[str, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.0,
    "axes.labelsize": 9.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "figure.titlesize": 11.0,
    "figure.labelsize": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    # Element names in SVG files would otherwise be random.
    "svg.hashsalt": "mclass",
}
_METADATA: Mapping[str, Mapping[str, str | None]] = {
    "png": {"Software": None},
    "svg": {"Date": None, "Creator": "mclass"},
    "pdf": {"CreationDate": None, "Creator": "mclass", "Producer": None},
}
_DOTS_PER_INCH = 150


def styled(draw: Callable[Parameters, Figure]) -> Callable[Parameters, Figure]:
    """Draw in our style whatever the user's matplotlib settings are, and restore them."""

    @functools.wraps(draw)
    def in_style(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Figure:
        with matplotlib.style.context(dict(_STYLE), after_reset=True):
            return draw(*args, **kwargs)

    return in_style


def figure_format(path: str | os.PathLike[str]) -> str:
    """Format that a figure's file name asks for.

    Raises:
        UsageError: If the suffix is none of .png, .svg, .pdf.
    """
    suffix = Path(path).suffix
    if suffix.lower().lstrip(".") not in _METADATA:
        what = f"'{suffix}'" if suffix else "no suffix"
        raise UsageError(f"{path}: a figure is saved as .png, .svg or .pdf, not {what}")
    return suffix.lower().lstrip(".")


def require_savable(path: str | os.PathLike[str]) -> None:
    """Refuse a file name that no figure can be saved under, before work is spent on one.

    Raises:
        UsageError: If the suffix is none of .png, .svg, .pdf.
        MclassError: If the file cannot be written.
    """
    figure_format(path)
    part = _part_of(path)
    try:
        if Path(path).is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        part.touch()
        part.unlink()
    except OSError as error:
        raise MclassError(f"{path}: cannot be written: {error.strerror or error}") from error


def _part_of(path: str | os.PathLike[str]) -> Path:
    """Where a figure grows before it takes its name."""
    return Path(path).with_name(Path(path).name + ".part")


def save_figure(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure as its suffix says; the same figure gives the same bytes.

    Args:
        figure: From any function of this package.
        path: Ends in .png, .svg or .pdf; an existing file is replaced, once the new one
            is complete.

    Raises:
        UsageError: If the suffix is another.
        MclassError: If the file cannot be written.
    """
    kind = figure_format(path)
    target, part = Path(path), _part_of(path)
    try:
        with matplotlib.style.context(dict(_STYLE), after_reset=True):
            figure.savefig(part, format=kind, dpi=_DOTS_PER_INCH, metadata=dict(_METADATA[kind]))
        part.replace(target)
    except OSError as error:
        raise MclassError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)


def class_line(index: int) -> dict[str, Any]:
    """Colour and dashes of a class's line; pairs repeat only after twelve classes."""
    return {
        "color": class_color(index),
        "linestyle": CLASS_DASHES[index % len(CLASS_DASHES)],
    }


def drawable(name: str, limit: int = 24) -> str:
    """A foreign name as it can be drawn: escaped, shortened, only glyphs that the font has."""
    font = get_font(findfont(FontProperties()))
    glyphs = [
        character
        if font.get_char_index(ord(character))
        else character.encode("unicode_escape").decode("ascii")
        for character in Terminal().clean(name, limit)
    ]
    # An unescaped pair of dollars would be read as mathematics.
    return Terminal().shorten("".join(glyphs), limit).replace("$", "\\$")


def named_legend(
    owner: Axes | Figure, handles: Sequence[Artist], names: Sequence[str], **settings: Any
) -> Legend:
    """A legend with names as they are, those that matplotlib would hide (``_a``) included."""
    legend = owner.legend(handles, [str(index) for index in range(len(names))], **settings)
    for text, name in zip(legend.get_texts(), names, strict=True):
        text.set_text(name)
    return legend


def halo(width: float = 2.0) -> list[AbstractPathEffect]:
    """A white rim that keeps lines and letters legible on any ground."""
    return [Stroke(linewidth=width, foreground="white"), Normal()]


def add_scale_bar(axes: Axes, unit: str, *, above: bool = False) -> None:
    """A bar of a round length, a fifth of the axes' width or so, at the right.

    Args:
        axes: With equal scales and its final x limits.
        unit: Name of the data unit.
        above: Beside the title, where it hides nothing, rather than in the lower corner.
    """
    left, right = axes.get_xlim()
    longest = 0.25 * (right - left)
    power = 10.0 ** math.floor(math.log10(longest))
    length = power * max(step for step in (1, 2, 5) if power * step <= longest)
    margin = 0.0 if above else 0.04
    end = right - margin * (right - left)
    height = 1.025 if above else margin
    place = axes.get_xaxis_transform()  # x in data units, y from 0 to 1 over the axes
    axes.plot(
        [end - length, end],
        [height, height],
        color="black",
        linewidth=2.5,
        solid_capstyle="butt",
        transform=place,
        path_effects=[] if above else halo(5.0),
        clip_on=False,
        gid="scale bar",
    )
    axes.annotate(
        f"{length:g} {unit}",
        xy=(end - 0.5 * length, height),
        xycoords=place,
        xytext=(0, 2),
        textcoords="offset points",
        ha="center",
        va="bottom",
        fontsize=8,
        path_effects=halo(),
    )
