"""Where the shipped configurations are, and how a child process runs this very package."""

import os
import sys
from collections.abc import Mapping
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def configs_dir(root: Path = ROOT) -> Path:
    """The folder of the configurations that come with ccatp: in the package once installed, beside it in a checkout."""
    inside = root / "configs"
    return inside if inside.is_dir() else root.parent / "configs"


def child_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment in which ``python -m ccatp...`` runs this package, whatever the working directory contains."""
    changed = {**environment, "PYTHONSAFEPATH": "1"}
    above = str(ROOT.parent)
    if above not in sys.path[1:]:  # neither installed nor in PYTHONPATH: it was found in the working directory
        others = environment.get("PYTHONPATH")
        changed["PYTHONPATH"] = above if not others else os.pathsep.join((above, others))
    return changed
