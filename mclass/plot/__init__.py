"""Results as figures. Needs matplotlib, which the extra ``plot`` installs.

Every function returns a `matplotlib.figure.Figure` made without pyplot: no window, no global
figure list, no change to the caller's backend or settings. `save_figure` writes it.
"""

from mclass.errors import UsageError

try:
    import matplotlib  # noqa: F401
except ImportError as error:
    raise UsageError("drawing needs matplotlib: pip install 'mclass[plot]'") from error

from mclass.plot.course import log_figure
from mclass.plot.evaluation import evaluation_figure
from mclass.plot.likelihood import likelihood_figure
from mclass.plot.maps import map_figure, ray_segments
from mclass.plot.objects import objects_figure
from mclass.plot.orientation import cell_figure, orientation_figure
from mclass.plot.style import figure_format, save_figure

__all__ = [
    "cell_figure",
    "evaluation_figure",
    "figure_format",
    "likelihood_figure",
    "log_figure",
    "map_figure",
    "objects_figure",
    "orientation_figure",
    "ray_segments",
    "save_figure",
]
