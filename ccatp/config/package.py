"""This package: which build of it runs, and how a child process gets the very same."""

import os
import sys
from collections.abc import Mapping
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

COMPILED, INTERPRETED = "compiled", "interpreted"
ROOT = Path(__file__).resolve().parents[1]


def build(root: Path = ROOT) -> str:
    """``compiled`` where the frame path is machine code (``make fast``), else ``interpreted``."""
    is_machine_code = any((root / "survey" / f"mission{suffix}").is_file() for suffix in EXTENSION_SUFFIXES)
    return COMPILED if is_machine_code else INTERPRETED


def configs_dir(root: Path = ROOT) -> Path:
    """The folder of the configurations that come with ccatp: in the package once installed, beside it in a checkout."""
    inside = root / "configs"
    return inside if inside.is_dir() else root.parent / "configs"


def child_environment(environment: Mapping[str, str]) -> dict[str, str]:
    """The environment in which ``python -m ccatp...`` runs this package, whatever lies in the working directory."""
    changed = {**environment, "PYTHONSAFEPATH": "1"}
    above = str(ROOT.parent)
    if above not in sys.path[1:]:  # neither installed nor in PYTHONPATH: it was found in the working directory
        others = environment.get("PYTHONPATH")
        changed["PYTHONPATH"] = above if not others else os.pathsep.join((above, others))
    return changed
