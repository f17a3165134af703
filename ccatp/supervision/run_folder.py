"""Edge. The folders of a run: its own, made or taken up again, and that of its sockets; each for one daemon alone."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path

from ccatp.config.loader import load_config
from ccatp.config.models import Config
from ccatp.errors import ConfigError
from ccatp.run_options import RunOptions, default_run_dir
from ccatp.runtime_dir import LOCK_FILE, TRUTH_LOCK_FILE, locked, remove_sockets

# In the runtime directory. Those of the truth may be of a simulated robot that runs alone, beside a run without one.
SOCKETS = ("main", "danger", "control", "emergency", "dashboard")
TRUTH_SOCKETS = ("truth", "puck")


@contextmanager
def owned(path: Path, option: str) -> Iterator[None]:
    """Hold a lock, or say that another daemon does and which ``option`` names another place.

    Raises:
        RefusedError: it is held.
    """
    refusal = f"another ccatp runs in {path.parent}; end it with 'ccatp stop', or give this one its own {option}"
    with locked(path, refusal):
        yield


def own_runtime_dir(stack: ExitStack, runtime_dir: Path, *, is_sim: bool) -> None:
    """Have a runtime directory for ourselves until the end, when our sockets go, too.

    Raises:
        RefusedError: another daemon has it, or a simulated robot that runs alone.
    """
    stack.enter_context(owned(runtime_dir / LOCK_FILE, "--runtime-dir"))
    if is_sim:
        alone = f"a simulated robot runs alone in {runtime_dir}; end it, or give this one its own --runtime-dir"
        stack.enter_context(locked(runtime_dir / TRUTH_LOCK_FILE, alone))
    stack.callback(remove_sockets, runtime_dir, (*SOCKETS, *(TRUTH_SOCKETS if is_sim else ())))


def new_run_dir(options: RunOptions, name: str, seed: int) -> Path:
    """The folder of a run that begins anew.

    Raises:
        ConfigError: it holds a mission already, or cannot be made.
    """
    run_dir = options.run_dir or default_run_dir(name, seed, datetime.now(UTC))
    if (run_dir / "mission.sqlite").exists():
        raise ConfigError(f"--run-dir: {run_dir} holds a mission already; name another folder")
    return _made(run_dir)


def _made(run_dir: Path) -> Path:
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--run-dir: cannot make {run_dir}: {error.strerror}") from error
    return run_dir.absolute()


def survey_run_dir(options: RunOptions, cfg: Config) -> Path:
    """The folder of a survey that begins anew, or is resumed with the points that it was planned with.

    Raises:
        ConfigError: what is asked for does not fit what it holds, or it cannot be made.
    """
    run_dir = options.run_dir or default_run_dir(cfg.run.mirror, cfg.run.seed, datetime.now(UTC))
    has_mission = (run_dir / "mission.sqlite").exists()
    if has_mission and not options.resume:
        raise ConfigError(
            f"--run-dir: {run_dir} holds a mission already; give --resume to go on with it, or another folder"
        )
    if options.resume and not has_mission:
        raise ConfigError(f"--resume: no mission in {run_dir}; name the folder of the run with --run-dir")
    if options.resume:
        _check_resumed(run_dir, cfg)
    return _made(run_dir)


def _check_resumed(run_dir: Path, cfg: Config) -> None:
    """A mission goes on with the points it was planned with."""
    path = run_dir / "config.toml"
    if not path.exists():
        return
    before = load_config(path)
    for name, was, wanted in (
        ("run.mirror", before.mirror.name, cfg.mirror.name),
        ("run.order", before.run.order, cfg.run.order),
        ("run.panels", before.run.panels, cfg.run.panels),
    ):
        if was != wanted:
            raise ConfigError(f"--resume: {name} was {was} in {run_dir} and is {wanted} now; resume with what it was")
