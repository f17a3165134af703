"""The daemon's processes: supervisor, main loop, danger loop, dashboard, and simulated servers.

``supervisor`` holds the process table; each process module has a ``main``.
"""

import sys
from importlib import import_module

# Where they are installed, structlog imports these for renderers that no process uses: 0.15 s of each start.
_UNUSED = [name for name in ("rich", "twisted") if name not in sys.modules]
sys.modules.update(dict.fromkeys(_UNUSED))  # type: ignore[arg-type]
import_module("structlog")
for _name in _UNUSED:
    del sys.modules[_name]
