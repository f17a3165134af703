"""Glue. A dashboard beside a daemon that runs already: ``ccatp dashboard``."""

import asyncio
import os
from collections.abc import Callable, Mapping
from pathlib import Path

from ccatp.config.loader import load_config
from ccatp.config.radio_loader import is_radio_file, load_radio_config
from ccatp.errors import ConfigError, UnreachableError
from ccatp.processes.common import RUN_DIR_FILE, Endpoints, open_log
from ccatp.processes.dashboard import run_dashboard
from ccatp.processes.page_socket import open_page_socket
from ccatp.run_files.recorder import read_metadata
from ccatp.runtime_dir import runtime_dir_path

ROOT = "dashboard."


def attach(runtime_dir: Path | None, settings: Mapping[str, object], say: Callable[[str], None]) -> int:
    """Serve until SIGINT or SIGTERM.

    Args:
        runtime_dir: of the daemon, if not the usual one.
        settings: keys of ``dashboard`` that are not those of the run.
        say: tells where the page is.

    Raises:
        UnreachableError: no daemon runs there.
        ConfigError: a setting that is none of the page's, a token that cannot be read, or no address to listen on.
    """
    for key in settings:
        if not key.startswith(ROOT):
            raise ConfigError(f"--set: {key} is no key of the page; the daemon runs with what it has, see {ROOT}*")
    folder = runtime_dir_path(str(runtime_dir or ""), os.environ)
    run_dir = _run_dir_of(folder)
    path, wanted = run_dir / "config.toml", {**settings, f"{ROOT}enabled": True}
    cfg = load_radio_config(path, wanted) if is_radio_file(path) else load_config(path, wanted)
    page = open_page_socket(cfg.dashboard)
    if page.socket is None:
        raise ConfigError(page.text)
    is_sim = read_metadata(run_dir / "telemetry.mcap").get("simulation") == "true"
    log = open_log(run_dir / "log.jsonl", "dashboard")
    with page.socket:
        say(page.text)
        asyncio.run(
            run_dashboard(cfg, run_dir, Endpoints(folder), page.socket, is_sim=is_sim, log=log, has_pulse=False)
        )
    return 0


def _run_dir_of(runtime_dir: Path) -> Path:
    """Where the daemon of a runtime directory writes."""
    try:
        run_dir = Path((runtime_dir / RUN_DIR_FILE).read_text(encoding="utf-8").strip())
    except OSError:
        run_dir = None
    if run_dir is None or not (runtime_dir / "control").exists():
        raise UnreachableError(
            f"no daemon in {runtime_dir}; start one with ccatp run, or name its folder with --runtime-dir"
        )
    return run_dir
