"""Robot-controller daemon that surveys telescope mirrors with a laser-tracked puck.

For analysis in Python: ``open_run`` opens the directory of a run, ``simulate`` simulates a survey in this process. What
they need is imported when they are used; their types stand in the stub beside this file.
"""

from typing import Any

__version__ = "0.1.0"
__all__ = ["__version__", "open_run", "simulate"]

_PLACES = {"open_run": "ccatp.analysis.run", "simulate": "ccatp.analysis.simulation"}


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module  # noqa: PLC0415 - as late as the modules themselves

    return getattr(import_module(_PLACES[name]), name)
