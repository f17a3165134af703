"""Edge. One thread for the linear algebra: on matrices this small more of them cost time, and fight the workers."""

import os

VARIABLES = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")


def limit_threads() -> None:
    """Ask for one thread, for this process and its children. Has an effect only before numpy is imported."""
    for name in VARIABLES:
        os.environ.setdefault(name, "1")
