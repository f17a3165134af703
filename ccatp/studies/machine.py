"""The machine on which something was measured, as a table and in one line."""

import os
import platform
from collections.abc import Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

PACKAGES = ("ccatp", "numpy", "scipy", "filterpy", "stonesoup")
CPU_INFO = Path("/proc/cpuinfo")


def machine() -> dict[str, object]:
    """Processor, usable cores, versions of Python and the packages, threads of the linear algebra."""
    cpu, cores = platform.processor() or platform.machine(), os.cpu_count() or 1
    with suppress(OSError):  # the kernel's name of the model
        lines = [line.partition(":") for line in CPU_INFO.read_text(encoding="utf-8").splitlines()]
        cpu = next((model.strip() for name, _, model in lines if name.strip() == "model name"), cpu)
    with suppress(AttributeError):  # not on every system
        cores = len(os.sched_getaffinity(0))
    versions: dict[str, str | None] = dict.fromkeys(PACKAGES)
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    blas_threads = os.environ.get("OPENBLAS_NUM_THREADS")
    return {"cpu": cpu, "cores": cores, "python": platform.python_version(), **versions, "blas_threads": blas_threads}


def machine_line(machine: Mapping[str, Any]) -> str:
    """The machine in one line."""
    packages = [f"{name} {machine[name]}" for name in PACKAGES[1:] if machine[name]]
    return ", ".join([machine["cpu"], f"{machine['cores']} cores", f"Python {machine['python']}", *packages])
