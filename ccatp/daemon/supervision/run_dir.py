"""Run directory and runtime directory, each locked by one daemon; resumable runs; options of ``ccatp run``."""

import itertools
import json
import os
import sys
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path, PurePath
from typing import Any
from uuid import uuid4

from ccatp.config.files import read_input, read_text, write_durably
from ccatp.config.mission import CommonConfig
from ccatp.daemon.loops.emergency_file import EMERGENCIES_FILE
from ccatp.daemon.supervision.run_text import RunText
from ccatp.errors import CcatpError, ConfigError, ExitStatus, RefusedError
from ccatp.links.runtime_dir import (
    BESIDE,
    LOCK_FILE,
    ORIGIN_FILE,
    RUN_LOCK,
    TRUTH_LOCK_FILE,
    is_held,
    locked,
    make_runtime_dir,
    remove_sockets,
)
from ccatp.missions import MissionKind, kind_of

UNFINISHED_FILE = Path("runs") / "unfinished"
# Emergencies that were active when a run finished, for the next run, because without a daemon nobody can clear them.
LATCHED_FILE = Path("runs") / EMERGENCIES_FILE
# Complete, or at base after an abort: such a run is not resumed.
FINISHED = (ExitStatus.COMPLETE, ExitStatus.ABORTED)


def find_resumable() -> Path | None:
    """The directory of the run that did not finish, ``None`` if there is none with a mission."""
    try:
        kept = read_input(UNFINISHED_FILE)
    except FileNotFoundError:
        return None
    except OSError as error:
        text = f"cannot read {UNFINISHED_FILE}: {error}; remove it to begin a new run"
        raise ConfigError(f"--resume-last: {text}") from error
    text = os.fsdecode(kept.strip())
    if not text or not kept.endswith(b"\n"):  # written as one whole line
        raise ConfigError(
            f"--resume-last: {UNFINISHED_FILE} is damaged, so the run that did not finish is not known; name it with "
            "--resume --run-dir, or remove the file to begin a new run with the robot at base"
        )
    run_dir = Path(text)
    return run_dir if (run_dir / "mission.sqlite").exists() else None


def find_unfinished() -> Path:
    """The directory in ``./runs`` whose mission is not complete; ``ConfigError`` unless there is exactly one."""
    found = [path.parent for path in sorted(Path("runs").glob("*/mission.sqlite"))]
    found = [run_dir for run_dir in found if finished_summary(run_dir) is None]
    if len(found) != 1:
        names = f": {', '.join(map(str, found))}" if found else ""
        raise ConfigError(f"--resume: {len(found)} unfinished runs in ./runs{names}; name one with --run-dir")
    return found[0]


def finished_summary(run_dir: Path) -> dict[str, Any] | None:
    """The summary of a mission whose points are all measured, else ``None``."""
    try:
        summary = json.loads(read_text(run_dir / "summary.json"))
        points = summary["points"]
        is_finished = points["measured"] == points["total"] > 0
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return summary if is_finished else None


def mark_resumable(run_dir: Path) -> None:
    """Record in ``UNFINISHED_FILE`` that a run has begun; raises ``ConfigError`` if it cannot be written."""
    try:
        UNFINISHED_FILE.parent.mkdir(parents=True, exist_ok=True)
        write_durably(UNFINISHED_FILE, os.fsencode(run_dir) + b"\n")
    except OSError as error:
        raise ConfigError(
            f"--resume-last: cannot write {UNFINISHED_FILE}: {error.strerror}; start where ./runs can be made"
        ) from error


def clear_finished(status: int, run_dir: Path) -> None:
    """Remove the record of a finished run; save its active emergencies for the next one. ConfigError: it cannot."""
    if status not in FINISHED:
        return
    emergencies = run_dir / EMERGENCIES_FILE
    kept = emergencies.read_bytes() if emergencies.exists() else b""
    try:
        is_latched = bool(kept) and bool(json.loads(kept)["active"])
    except (ValueError, KeyError, TypeError):
        is_latched = True  # damaged
    try:
        if is_latched:
            write_durably(LATCHED_FILE, kept)
        else:
            LATCHED_FILE.unlink(missing_ok=True)
    except OSError as error:
        raise ConfigError(f"--resume-last: cannot keep {LATCHED_FILE}: {error.strerror}") from error
    UNFINISHED_FILE.unlink(missing_ok=True)


def take_over_emergencies(run_dir: Path) -> bool:
    """Copy the emergencies of the last run that are still active; whether there are any. ConfigError: it cannot."""
    try:
        kept = LATCHED_FILE.read_bytes()
        run_dir.mkdir(parents=True, exist_ok=True)
        write_durably(run_dir / EMERGENCIES_FILE, kept)
    except FileNotFoundError:
        return False
    except OSError as error:
        raise ConfigError(f"--resume-last: cannot take over {LATCHED_FILE}: {error.strerror}") from error
    return True


@dataclass(frozen=True, slots=True)
class RunOptions:
    """The command line of ``ccatp run``."""

    sim: bool  # simulate robot and laser system
    config_file: Path | None = None
    # Dotted keys from the command line (``{"run.seed": 2}``), which override the file.
    overrides: Mapping[str, object] = field(default_factory=dict)
    realtime: bool = False  # simulate in real time instead of in lockstep
    run_dir: Path | None = None  # None for ``default_run_dir``
    resume: bool = False  # continue the mission in ``run_dir``
    held: bool = False  # begin held
    recover: bool = False  # continue, held, the run that did not finish, or begin one that can be recovered
    json_output: bool = False  # standard output is the summary as JSON, and nothing else
    runtime_dir: Path | None = None  # folder of the unix sockets
    faults_file: Path | None = None  # plan of simulated faults; a copy goes into the run directory
    shows_summary: bool = True
    verbosity: int = 0  # as of ``RunView``

    @property
    def is_paced(self) -> bool:
        """The robot runs in real time, so that processes sleep between frames."""
        return self.realtime or not self.sim


def default_run_dir(mirror: str, seed: int, now_utc: datetime, parent: Path = Path("runs")) -> Path:
    """``runs/<UTC time>-<mirror>-s<seed>``; the mirror is a name or the path of a file."""
    return parent / f"{now_utc:%Y%m%dT%H%M%SZ}-{PurePath(mirror).stem}-s{seed}"


def recover(options: RunOptions, cfg: CommonConfig, run: Callable[[RunOptions, CommonConfig], int]) -> int:
    """Continue, held, the run that did not finish; otherwise begin a new one that can be recovered."""
    run_dir = find_resumable()
    if run_dir is not None:
        options = replace(options, run_dir=run_dir, resume=True, held=True)
    else:
        run_dir = default_run_dir(_folder_of(cfg), cfg.run.seed, datetime.now(UTC)).absolute()
        # An emergency of the last run stays latched: the robot waits at base until it is cleared.
        options = replace(options, run_dir=run_dir, held=take_over_emergencies(run_dir))
        mark_resumable(run_dir)
    status = run(options, cfg)
    clear_finished(status, run_dir)
    return status


# Lock in run directory and runtime directory, held by every child of the supervisor.
CHILDREN_LOCK = ".children"
PREDECESSORS_S = 30.0  # a process that starts on an overloaded machine needs long to notice the supervisor's death
# In the runtime directory. The sockets of the truth may belong to a simulated robot that runs alone.
SOCKETS = ("main", "danger", "control", "emergency", "dashboard")
TRUTH_SOCKETS = ("truth", "puck")
MOST_BESIDE = 99  # largest number of concurrent simulations without a configured runtime directory


def owned(path: Path, option: str) -> AbstractContextManager[int]:
    """Hold a lock. If it is held already, raises ``RefusedError``, which names the ``option`` for another place."""
    refusal = f"another ccatp runs in {path.parent}; end it with 'ccatp stop', or give this one its own {option}"
    return locked(path, refusal)


def await_predecessors(stack: ExitStack, *folders: Path) -> tuple[int, ...]:
    """Lock the folders until the stack is closed; the children inherit the locks.

    The children of a killed supervisor end by themselves a little later. Until then they write their last records and
    remove their sockets, so this waits for the end of the last one. RefusedError: some still run after
    ``PREDECESSORS_S``.
    """
    locks = []
    for folder in folders:
        path = folder / CHILDREN_LOCK
        text = f"processes of an earlier run still use {folder}; end them ('fuser {path}' names them), and try again"
        locks.append(stack.enter_context(locked(path, text, PREDECESSORS_S)))
    return tuple(locks)


def take_runtime_dir(stack: ExitStack, configured: str, *, is_sim: bool) -> Path:
    """Create a runtime directory and lock it until the stack is closed: the configured one, else the usual one.

    If the usual one is in use, a simulation without a configured one takes another one next to it. ConfigError: it
    cannot be created; RefusedError: it is in use.
    """
    usual = folder = make_runtime_dir(configured, os.environ)
    for number in itertools.count(2):
        try:
            with ExitStack() as trial:
                own_runtime_dir(trial, folder, is_sim=is_sim)
                stack.enter_context(trial.pop_all())
                break
        except RefusedError:
            if configured or not is_sim or number > MOST_BESIDE:
                raise
        folder = make_runtime_dir(str(usual / BESIDE.format(number)), {})
    if folder != usual:
        print(f"ccatp: {usual} is in use; commands to this run take --runtime-dir {folder}", file=sys.stderr)
    return folder


def own_runtime_dir(stack: ExitStack, runtime_dir: Path, *, is_sim: bool) -> None:
    """Lock a runtime directory until the stack is closed; then remove its sockets.

    RefusedError: another daemon uses it, or a simulated robot that runs alone.
    """
    stack.enter_context(owned(runtime_dir / LOCK_FILE, "--runtime-dir"))
    if is_sim:
        alone = f"a simulated robot runs alone in {runtime_dir}; end it, or give this one its own --runtime-dir"
        stack.enter_context(locked(runtime_dir / TRUTH_LOCK_FILE, alone))
    stack.callback(remove_sockets, runtime_dir, (*SOCKETS, *(TRUTH_SOCKETS if is_sim else ())))


def with_origin(options: RunOptions) -> RunOptions:
    """The options with ``sim`` and ``realtime`` as the resumed run began.

    ConfigError: it began with a real robot, and a simulation is requested; or in lockstep, and real time is requested.
    """
    if not options.resume or options.run_dir is None or (began := _began_simulated(options.run_dir)) is None:
        return options
    if options.sim and not began:
        raise ConfigError(f"--sim: the run in {options.run_dir} is of a real robot; leave --sim out to resume it")
    was_realtime = _read_origin(options.run_dir).get("realtime", options.realtime)  # older versions do not say
    if options.realtime and not was_realtime:
        raise ConfigError(f"--realtime: the run in {options.run_dir} began without it; leave it out to resume the run")
    return replace(options, sim=began, realtime=was_realtime)


def _began_simulated(run_dir: Path) -> bool | None:
    """Whether a run began in simulation; ``None`` if that is not known."""
    if (is_sim := _read_origin(run_dir).get("simulation")) is not None:
        return bool(is_sim)
    # A run of an older version: its recording has it, too. Its readers take a tenth of the time of a start to import.
    from ccatp.records.recorder import TELEMETRY, read_metadata  # noqa: PLC0415

    try:
        simulation = read_metadata(run_dir / TELEMETRY).get("simulation")
    except (OSError, CcatpError):
        return None
    return None if simulation is None else simulation == "true"


def _read_origin(run_dir: Path) -> dict[str, Any]:
    """What the file holds, nothing for a run of an older version. ConfigError: it cannot be read, or is damaged."""
    path = run_dir / ORIGIN_FILE
    advice = "put back a copy; without the file the run is resumed as one of an older version"
    try:
        found = json.loads(read_text(path))
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}; {advice}") from error
    except ValueError:
        found = None
    if not (isinstance(found, dict) and isinstance(found.get("simulation"), bool)):
        raise ConfigError(f"{path}: is empty or damaged; {advice}")
    return found


def read_run_id(run_dir: Path) -> str:
    """The id that distinguishes the files of this run from those of others; empty if an older version began it."""
    return str(_read_origin(run_dir).get("run_id", ""))


def keep_origin(run_dir: Path, *, is_sim: bool, is_realtime: bool, is_new: bool) -> None:
    """Save the id of a run, and how it is simulated, for ``with_origin``; a resumed run keeps its id."""
    run_id = uuid4().hex if is_new else read_run_id(run_dir)
    origin = {"simulation": is_sim, "realtime": is_realtime, "run_id": run_id}
    write_durably(run_dir / ORIGIN_FILE, json.dumps(origin).encode())


def check_takes_faults(kind: MissionKind, faults_file: Path | None) -> None:
    """Raises ``ConfigError``: there is a fault plan, and the simulated robot of this kind of mission takes none."""
    if faults_file is not None and kind.no_faults is not None:
        raise ConfigError(f"--faults: {kind.no_faults}")


def _folder_of(cfg: CommonConfig) -> str:
    text: RunText = kind_of(cfg).text.get()(cfg)
    return text.folder or text.subject


def make_run_dir(options: RunOptions, cfg: CommonConfig) -> Path:
    """The directory of a new run, or of a survey that is resumed with the same points.

    ConfigError: options or configuration contradict its content, or it cannot be created.
    """
    kind = kind_of(cfg)
    run_dir = options.run_dir or _make_new(default_run_dir(_folder_of(cfg), cfg.run.seed, datetime.now(UTC)))
    has_mission = (run_dir / "mission.sqlite").exists()
    if has_mission and not options.resume:
        if is_held(run_dir / RUN_LOCK):
            raise ConfigError(f"--run-dir: another ccatp runs in {run_dir}; name another folder")
        advice = "give --resume to continue it, or another folder" if kind.no_resume is None else "name another folder"
        raise ConfigError(f"--run-dir: {run_dir} holds a mission already; {advice}")
    if options.resume and not has_mission:
        raise ConfigError(f"--resume: no mission in {run_dir}; name the folder of the run with --run-dir")
    if options.resume and (run_dir / "config.toml").exists() and kind.resumed is not None:
        check: Callable[[Any, Path], None] = kind.resumed.get()
        check(cfg, run_dir)
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--run-dir: cannot make {run_dir}: {error.strerror}") from error
    return run_dir.absolute()


def _make_new(path: Path) -> Path:
    """Create a run directory, with a number after its name if another run began in the same second."""
    made = path
    for number in itertools.count(2):
        try:
            made.mkdir(parents=True)
            break
        except FileExistsError:
            made = path.with_name(f"{path.name}-{number}")
        except OSError as error:
            raise ConfigError(f"--run-dir: cannot make {made}: {error.strerror}; name another folder") from error
    return made
