"""Whether this machine permits real-time scheduling: with it other bounds hold than without."""

import functools
import os
import threading


@functools.cache
def is_realtime_permitted() -> bool:
    """Try it on a thread of its own, which ends with what it was given."""
    outcome: list[bool] = []

    def try_it() -> None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
        except OSError:
            outcome.append(False)
        else:
            outcome.append(True)

    thread = threading.Thread(target=try_it)
    thread.start()
    thread.join()
    return outcome == [True]
