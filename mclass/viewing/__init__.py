"""Results in the viewer Rerun. Needs rerun-sdk, which the extra ``view`` installs.

`contents` gathers what is shown from an output, `recording` turns it into Rerun's entities,
`blueprint` says how they are laid out, `show` opens the viewer or writes a file.
"""

from mclass.errors import UsageError

try:
    import rerun  # noqa: F401
except ImportError as error:
    raise UsageError("viewing needs Rerun: pip install 'mclass[view]'") from error

from mclass.viewing.contents import Contents, gather
from mclass.viewing.show import Shown, open_viewer, save_recording

__all__ = ["Contents", "Shown", "gather", "open_viewer", "save_recording"]
