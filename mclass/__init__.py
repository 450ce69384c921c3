"""Object class, orientation and position from class labels in MCAP logs.

From Python::

    import mclass

    found = mclass.estimate("drive.mcap", "boxes.yaml")
    found.object_ids, found.class_probabilities, found.positions, found.orientations

Names are imported when first used, so ``import mclass`` alone costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mclass.arrays import measurements_from_arrays
    from mclass.config.model_file import load_model, parse_model
    from mclass.errors import ConfigError, LogError, MclassError, ModelError, UsageError
    from mclass.evaluation.outputs import evaluate
    from mclass.evaluation.summary import Evaluation
    from mclass.findings import Estimate
    from mclass.fusion import fuse
    from mclass.model import Model
    from mclass.outputs.readback import OutputLog
    from mclass.pipeline import estimate, infer
    from mclass.records import LabelMeasurements

__version__ = "0.1.0"

__all__ = [
    "ConfigError",
    "Estimate",
    "Evaluation",
    "LabelMeasurements",
    "LogError",
    "MclassError",
    "Model",
    "ModelError",
    "OutputLog",
    "UsageError",
    "__version__",
    "estimate",
    "evaluate",
    "fuse",
    "infer",
    "load_model",
    "measurements_from_arrays",
    "parse_model",
]

_HOMES = {
    "ConfigError": "errors",
    "Estimate": "findings",
    "Evaluation": "evaluation.summary",
    "LabelMeasurements": "records",
    "LogError": "errors",
    "MclassError": "errors",
    "Model": "model",
    "ModelError": "errors",
    "OutputLog": "outputs.readback",
    "UsageError": "errors",
    "estimate": "pipeline",
    "evaluate": "evaluation.outputs",
    "fuse": "fusion",
    "infer": "pipeline",
    "load_model": "config.model_file",
    "measurements_from_arrays": "arrays",
    "parse_model": "config.model_file",
}
"""Module of each public name."""


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
