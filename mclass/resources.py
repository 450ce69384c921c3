"""Files that come with the package: message schemas, models, scenarios, viewer layouts.

A wheel carries them as ``mclass/data``; a checkout has them at its top.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from mclass.errors import MclassError

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

Folder: TypeAlias = Literal["schemas", "configs"]


def folder(name: Folder) -> Traversable:
    """The folder ``schemas`` or ``configs``, in the package or else in the checkout.

    Raises:
        MclassError: If it is in neither.
    """
    packaged = files("mclass") / "data" / name
    if packaged.is_dir():
        return packaged
    checkout = Path(__file__).resolve().parent.parent / name
    if checkout.is_dir():
        return checkout
    raise MclassError(f"the folder {name!r} of mclass is missing. Install mclass again.")


def read_text(name: Folder, path: str) -> str:
    """Text of one file, ``path`` with slashes below the folder ``name``.

    Raises:
        MclassError: If there is no such file.
    """
    resource = folder(name).joinpath(*path.split("/"))
    if not resource.is_file():
        raise MclassError(f"the file {name}/{path} of mclass is missing. Install mclass again.")
    return resource.read_text(encoding="utf-8")
