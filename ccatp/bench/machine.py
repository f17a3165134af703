"""What the figures were taken on."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from ccatp.config.package import build

PACKAGES = ("ccatp", "numpy", "scipy", "filterpy", "stonesoup")
CPU_INFO = Path("/proc/cpuinfo")


def machine(cpu_info: Path = CPU_INFO) -> dict[str, object]:
    """Processor, usable cores, Python, build and versions of what takes part, threads of the linear algebra."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        cores = os.cpu_count() or 1
    return {
        "cpu": cpu_model(cpu_info),
        "cores": cores,
        "python": platform.python_version(),
        "build": build(),
        **{name: _version(name) for name in PACKAGES},
        "blas_threads": os.environ.get("OPENBLAS_NUM_THREADS"),
    }


def cpu_model(cpu_info: Path) -> str:
    """The model as the kernel names it, or what the platform knows."""
    try:
        lines = cpu_info.read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, "") or platform.processor() or platform.machine()


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
