"""Glue. THE process table: what runs, in which order it starts and stops; and how a run of it begins."""

import json
import os
import socket
import sys
import time
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ccatp.config.loader import dump_config, load_config
from ccatp.config.radio_loader import dump_radio_config, is_radio_file, load_radio_config
from ccatp.dashboard.token_file import read_token
from ccatp.errors import ConfigError, ExitStatus
from ccatp.processes.common import FAULTS_FILE, RUN_DIR_FILE, Endpoints
from ccatp.processes.observing import check_observatory
from ccatp.processes.page_socket import open_page_socket
from ccatp.robot_link import read_key
from ccatp.run_files.writing import RUN_LOCK
from ccatp.run_options import RunOptions, default_run_dir
from ccatp.runtime_dir import make_runtime_dir
from ccatp.supervision.children import ProcessSpec
from ccatp.supervision.listening import listen, places_of, with_addresses
from ccatp.supervision.one_run import Run
from ccatp.supervision.run_folder import new_run_dir, own_runtime_dir, owned, survey_run_dir
from ccatp.supervision.run_kinds import BeaconRun, SurveyRun
from ccatp.supervision.unfinished import (
    find_unfinished,
    finished_summary,
    forget_finished,
    note_unfinished,
    take_over_emergencies,
)

# First, so that it is there for the end of the others. It gets what time they leave, so it has a minute to speak.
_DASHBOARD = ProcessSpec(
    "dashboard",
    "ccatp.processes.dashboard",
    listens="dashboard",
    is_loop=True,
    is_needed=False,
    niceness=15,
    patience_s=60.0,
)


# In the order of starting; stopping is in the reverse order, so that main holds the wheels first.
PROCESSES: tuple[ProcessSpec, ...] = (
    _DASHBOARD,
    ProcessSpec("dataloop", "ccatp.processes.dataloop", is_stand_in=True, listens="sim.robot", is_replaceable=False),
    ProcessSpec("etalon", "ccatp.processes.etalon", is_stand_in=True, listens="sim.etalon"),
    ProcessSpec("danger", "ccatp.processes.danger_loop", is_loop=True),
    ProcessSpec("main", "ccatp.processes.main_loop", is_loop=True),
)


# No laser system: what is measured is measured by radio. A main loop that dies takes the map with it: held, and over.
BEACON_PROCESSES: tuple[ProcessSpec, ...] = (
    _DASHBOARD,
    ProcessSpec("dataloop", "ccatp.processes.dataloop", is_stand_in=True, listens="sim.robot", is_replaceable=False),
    ProcessSpec("danger", "ccatp.processes.danger_loop", is_loop=True),
    ProcessSpec("main", "ccatp.processes.main_loop", is_loop=True, is_replaceable=False),
)


def run(options: RunOptions) -> int:
    """Run what the configuration is of: a survey, or a mission among beacons; arguments as of ``run_survey``."""
    if options.config_file is not None and is_radio_file(options.config_file):
        return run_beacons(options)
    return run_survey(options)


def run_beacons(options: RunOptions) -> int:
    """Run one mission among beacons to its end; arguments, status and errors as of ``run_survey``."""
    if options.resume or options.recover:
        flag = "--resume" if options.resume else "--recover"
        raise ConfigError(f"{flag}: a mission among beacons has nothing to go on with, its map is not kept; begin anew")
    if options.faults_file is not None:
        raise ConfigError("--faults: plans are for surveys; sim.incidents of the configuration holds those of beacons")
    cfg = load_radio_config(options.config_file, dict(options.overrides))
    check_observatory(cfg.observatory)
    read_key(cfg.robot.key_file, must_be_private=not options.sim)
    read_token(cfg.dashboard)
    started = time.monotonic()
    with ExitStack() as stack:
        runtime_dir = make_runtime_dir(str(options.runtime_dir or cfg.processes.runtime_dir), os.environ)
        own_runtime_dir(stack, runtime_dir, is_sim=options.sim)
        sockets: dict[str, socket.socket] = {}
        if options.sim:
            at = cfg.sim.robot
            sockets["dataloop"] = listener = stack.enter_context(listen("sim.robot", at.host, at.port))
            host, port = listener.getsockname()
            cfg = cfg.model_copy(update={"robot": cfg.robot.model_copy(update={"host": host, "port": port})})
        page = open_page_socket(cfg.dashboard)
        if page.socket is not None:
            sockets["dashboard"] = stack.enter_context(page.socket)
            cfg = cfg.model_copy(update={"dashboard": page.config})
        run_dir = new_run_dir(options, cfg.system, cfg.run.seed)
        stack.enter_context(owned(run_dir / RUN_LOCK, "--run-dir"))
        (run_dir / "config.toml").write_text(dump_radio_config(cfg), encoding="utf-8")
        (runtime_dir / RUN_DIR_FILE).write_text(f"{run_dir}\n", encoding="utf-8")
        kind = BeaconRun(cfg, BEACON_PROCESSES, is_sim=options.sim)
        return Run(options, kind, run_dir, Endpoints(runtime_dir), sockets, page, started).go()


def run_survey(options: RunOptions) -> int:
    """Run one survey to its end.

    Args:
        options: what the command line asked for.

    Returns:
        The exit status of ``cli.md``.

    Raises:
        CcatpError: the run could not begin.
    """
    if options.recover:
        return _recover(options)
    overrides = dict(options.overrides)
    cfg = load_config(options.config_file, overrides)
    check_observatory(cfg.observatory)
    # The processes read it again; here it is refused before anything has begun.
    read_key(cfg.robot.key_file, must_be_private=not options.sim)
    read_token(cfg.dashboard)
    started = time.monotonic()
    with ExitStack() as stack:
        runtime_dir = make_runtime_dir(str(options.runtime_dir or cfg.run.runtime_dir), os.environ)
        own_runtime_dir(stack, runtime_dir, is_sim=options.sim)
        stand_ins = [p for p in PROCESSES if p.is_stand_in and p.listens and options.sim]
        places = places_of(cfg)
        sockets = {p.name: stack.enter_context(listen(p.listens, *places[p.listens])) for p in stand_ins}
        cfg = with_addresses(cfg, sockets) if options.sim else cfg
        page = open_page_socket(cfg.dashboard)
        if page.socket is not None:
            sockets["dashboard"] = stack.enter_context(page.socket)
            cfg = cfg.model_copy(update={"dashboard": page.config})
        run_dir = survey_run_dir(options, cfg)
        stack.enter_context(owned(run_dir / RUN_LOCK, "--run-dir"))
        if options.resume and (done := finished_summary(run_dir)) is not None:
            return _tell_finished(done, run_dir, as_json=options.json_output)
        (run_dir / "config.toml").write_text(dump_config(cfg), encoding="utf-8")
        (runtime_dir / RUN_DIR_FILE).write_text(f"{run_dir}\n", encoding="utf-8")
        if options.faults_file is not None:
            (run_dir / FAULTS_FILE).write_bytes(options.faults_file.read_bytes())
        kind = SurveyRun(cfg, PROCESSES, is_sim=options.sim)
        return Run(options, kind, run_dir, Endpoints(runtime_dir), sockets, page, started).go()


def _recover(options: RunOptions) -> int:
    """Go on, held, with the run that did not finish; else begin a new one that may be recovered."""
    options = replace(options, recover=False)
    found = find_unfinished()
    if found is not None:
        options = replace(options, run_dir=found, resume=True, held=True)
    else:
        cfg = load_config(options.config_file, dict(options.overrides))
        run_dir = default_run_dir(cfg.run.mirror, cfg.run.seed, datetime.now(UTC)).absolute()
        # What was latched when the last run ended stays so: the robot waits at its base until it is cleared.
        options = replace(options, run_dir=run_dir, held=take_over_emergencies(run_dir))
        note_unfinished(run_dir)
        found = run_dir
    status = run_survey(options)
    forget_finished(status, found)
    return status


def _tell_finished(summary: dict[str, Any], run_dir: Path, *, as_json: bool) -> int:
    """Nothing is left of a mission: what is known of it stays as it is."""
    if as_json:
        print(json.dumps(summary))
    count = summary["points"]["total"]
    print(f"nothing left to do: all {count} points of {run_dir} are measured", file=sys.stderr)
    return ExitStatus.COMPLETE
