"""Work that goes wrong, in a module that processes import quickly."""

from __future__ import annotations

import os
import signal


class Trouble:
    """Ends its process at two of the jobs."""

    def __call__(self, job: int) -> tuple[int, str]:
        if job == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        if job == 5:
            os._exit(7)
        return 2 * job, os.environ["OPENBLAS_NUM_THREADS"]
