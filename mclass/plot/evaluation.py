"""Whether results can be trusted: reliability, coverage and confusion of many objects."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, PercentFormatter
from scipy.stats import binom

from mclass.evaluation.summary import Evaluation
from mclass.plot.style import OBJECT_COLOR, TRACK_COLOR, drawable, styled
from mclass.records import FloatArray, IntArray
from mclass.text.values import count_text, natural

_BINS = 10
_QUANTILE = 1.96
_MOST_CLASSES = 25


@styled
def evaluation_figure(evaluation: Evaluation) -> Figure:
    """Reliability of the named class, coverage of orientation regions, and confusion.

    Bars are 95 % intervals of a share (Wilson), the band is where 95 % of the shares of
    calibrated beliefs would lie, as if objects were independent.

    Args:
        evaluation: Of any number of logs.
    """
    objects = [one for log in evaluation.logs for one in log.objects]
    figure = Figure(figsize=(13.0, 5.0), layout="constrained")
    logs, missed = len(evaluation.logs), sum(len(log.missed) for log in evaluation.logs)
    figure.suptitle(
        f"{count_text(len(objects), 'object')} of {count_text(logs, 'log')}, {missed} missed"
    )
    reliability, coverage, confusion = figure.subplots(1, 3)
    if not objects:
        for axes in (reliability, coverage, confusion):
            axes.set_axis_off()
        coverage.text(0.5, 0.5, "no object was matched", ha="center", va="center")
        return figure
    _reliability(
        reliability,
        np.array([one.confidence for one in objects]),
        np.array([one.correct for one in objects]),
    )
    _coverage(coverage, np.sort([one.level for one in objects]))
    _confusion(confusion, evaluation)
    return figure


def _reliability(axes: Axes, confidence: FloatArray, correct: FloatArray) -> None:
    """Share of right names among objects named with like confidence."""
    _unit_square(axes)
    bins = np.minimum((confidence * _BINS).astype(np.int64), _BINS - 1)
    counts = np.bincount(bins, minlength=_BINS)
    used = np.flatnonzero(counts)
    mean = np.bincount(bins, confidence, _BINS)[used] / counts[used]
    share = np.bincount(bins, correct, _BINS)[used] / counts[used]
    low, high = wilson_interval(share, counts[used])
    # As plain numbers: of arrays of one element some releases of matplotlib ask for a scalar.
    below, above = np.clip([share - low, high - share], 0.0, None).tolist()
    axes.errorbar(
        mean,
        share,
        yerr=[below, above],
        fmt="o",
        color=TRACK_COLOR,
        capsize=3.0,
        clip_on=False,
    )
    for x, y, count in zip(mean, share, counts[used], strict=True):
        axes.annotate(
            str(count),
            (x, y),
            (5, 4),
            textcoords="offset points",
            fontsize=7,
            annotation_clip=False,
        )
    axes.set_title("Reliability (numbers: objects)", loc="left")
    axes.set(xlabel="P(named class)", ylabel="named rightly")


def _coverage(axes: Axes, levels: FloatArray) -> None:
    """How often regions of each mass hold the true orientation."""
    _unit_square(axes)
    steps = np.concatenate([[0.0], levels, [1.0]])
    shares = np.append(np.arange(len(levels) + 1) / len(levels), 1.0)
    axes.step(steps, shares, where="post", color=OBJECT_COLOR, linewidth=1.6)
    grid = np.linspace(0.0, 1.0, 101)
    low, high = (binom.ppf(share, len(levels), grid) / len(levels) for share in (0.025, 0.975))
    axes.fill_between(grid, low, high, color="#dddddd", linewidth=0.0, label="95 % if calibrated")
    axes.set_title("Orientation: coverage of regions", loc="left")
    axes.set(xlabel="mass of the region", ylabel="holds the true orientation")
    axes.legend(loc="lower right")


def _confusion(axes: Axes, evaluation: Evaluation) -> None:
    """True class by row, class named by column; shaded by the share of the row."""
    names = sorted({name for pair in evaluation.confusion for name in pair}, key=natural)
    hidden = max(len(names) - _MOST_CLASSES, 0)
    names = names[:_MOST_CLASSES]
    counts = np.array([[evaluation.confusion.get((row, col), 0) for col in names] for row in names])
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    axes.set_box_aspect(1.0)
    size = 9.0 if len(names) <= 8 else 5.5
    for (row, column), count in np.ndenumerate(counts):
        if count:
            color = "white" if shares[row, column] > 0.6 else "black"
            axes.text(column, row, str(count), ha="center", va="center", color=color, fontsize=size)
    shown = [drawable(name, 16) for name in names]
    axes.set_xticks(range(len(names)), shown, rotation=45.0, ha="right", fontsize=size)
    axes.set_yticks(range(len(names)), shown, fontsize=size)
    axes.tick_params(length=0.0)
    axes.spines[:].set_visible(False)
    axes.set_title(f"Confusion{f' ({hidden} classes not drawn)' if hidden else ''}", loc="left")
    axes.set(xlabel="named", ylabel="true class")


def _unit_square(axes: Axes) -> None:
    """0 to 100 % both ways, and the line on which both agree."""
    axes.plot([0.0, 1.0], [0.0, 1.0], color="#767676", linewidth=1.0, linestyle="--")
    # Room at the rim for what is certain.
    axes.set(xlim=(-0.04, 1.04), ylim=(-0.04, 1.09))
    axes.set_box_aspect(1.0)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(PercentFormatter(1.0))
        axis.set_major_locator(FixedLocator(np.linspace(0.0, 1.0, 6).tolist()))


def wilson_interval(share: FloatArray, count: IntArray) -> tuple[FloatArray, FloatArray]:
    """95 % intervals of shares of so many."""
    square = _QUANTILE**2
    middle = (share + square / (2.0 * count)) / (1.0 + square / count)
    half = np.sqrt(share * (1.0 - share) / count + square / (4.0 * count**2))
    half = _QUANTILE * half / (1.0 + square / count)
    return middle - half, middle + half
