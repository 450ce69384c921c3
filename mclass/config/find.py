"""Which model file to use when none is named."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from mclass.config.model_file import load_model, parse_model
from mclass.errors import ConfigError, ConfigProblem
from mclass.model import Model
from mclass.places import Place

MODEL_FILE_NAME = "mclass.yaml"
"""Name of a model file, or of an attachment holding one, that is found by itself."""


def find_model_file(log: Place) -> Path | None:
    """``mclass.yaml`` beside the log or, failing that, in the working directory.

    Beside a URL nothing is looked for.
    """
    beside = [log.parent] if isinstance(log, Path) else []
    candidates = [folder / MODEL_FILE_NAME for folder in (*beside, Path())]
    return next((path for path in candidates if path.exists()), None)


def find_model(
    log: Place, attachment: str | bytes | None = None, losses: Sequence[str] = ()
) -> Model:
    """The model for a log when the user names none: a file found, else the log's own.

    Args:
        log: Where the log is.
        attachment: Content of the log's attachment `MODEL_FILE_NAME`, None if it has none.
        losses: What of the log was lost, in sentences: the attachment may be among it.

    Raises:
        ConfigError: If there is no model, or if the one found is wrong; a wrong file is never
            passed over for the next candidate.
    """
    path = find_model_file(log)
    if path is not None:
        return load_model(path)
    if attachment is not None:
        return parse_model(attachment, f"{log.name}#{MODEL_FILE_NAME}")
    message = (
        f"no model: there is no {MODEL_FILE_NAME} beside the log, in the working directory or "
        "attached to the log. "
    )
    if losses:
        message += (
            f"The log is damaged ({'; '.join(losses)}), and a model that was attached to it may be "
            f"lost: name the model file that it was made with by -c, copy it to {MODEL_FILE_NAME}, "
            "or write a new one with `mclass init`"
        )
    else:
        message += "Name one with -c, or write one with `mclass init`"
    raise ConfigError([ConfigProblem(str(log), 0, 0, "", message)])
