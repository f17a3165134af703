"""A run of a survey: its texts, what is checked before it begins, limits of the main loop."""

import importlib.util
from pathlib import Path

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.daemon.loops.mission_runner import LoopLimits
from ccatp.daemon.supervision.run_dir import RunOptions
from ccatp.daemon.supervision.run_text import RunText, clock, progress_text
from ccatp.errors import ConfigError
from ccatp.links.topics import MissionStatus


def survey_text(cfg: Config) -> RunText:
    """The texts of a survey."""

    def title(is_sim: bool) -> str:
        world = f", world {cfg.world.name}, seed {cfg.run.seed}" if is_sim else ""
        what = f"{'SIMULATION' if is_sim else 'survey'} of {cfg.mirror.name}{world}, filter {cfg.run.filter}"
        return f"ccatp {what}"

    return RunText(
        subject=cfg.mirror.name,
        folder=cfg.run.mirror,
        details={"world": cfg.world.name},
        title=title,
        goals="points",
        reached="measured",
        shown=f"mirror {cfg.mirror.name}, {cfg.mirror.panels.count} panels, world {cfg.world.name}",
        progress=_progress,
    )


def _progress(status: MissionStatus) -> str:
    arrival = f", arrival {status.error_mm:.2f} mm" if status.error_mm else ""
    return progress_text(status, status.state, f"{clock(status.eta_s)} remaining{arrival}")


def loop_limits(cfg: Config) -> LoopLimits:
    """Limits of the main loop."""
    health = cfg.health
    return LoopLimits(health.clock_jump_s, health.hold_limit_s)


def check_survey(options: RunOptions, cfg: Config) -> None:
    """Raises ``ConfigError`` if the physics of the simulated robot is not available, before its process starts."""
    if not options.sim:
        return
    physics = cfg.sim.robot.physics
    if options.faults_file is not None and physics != "lag":
        raise ConfigError(f'--faults: plans are for sim.robot.physics = "lag", not for "{physics}"')
    if physics == "mujoco" and importlib.util.find_spec("mujoco") is None:
        raise ConfigError(f'sim.robot.physics = "{physics}": {physics} is not installed; pip install ccatp[physics]')


def check_resumed(cfg: Config, run_dir: Path) -> None:
    """Raises ``ConfigError``: the survey in a run directory has other points, or another world, filter or physics."""
    before = load_config(run_dir / "config.toml")
    for key, was, wanted in (
        ("run.mirror", before.mirror.name, cfg.mirror.name),
        ("run.order", before.run.order, cfg.run.order),
        ("run.panels", before.run.panels, cfg.run.panels),
        ("run.seed", before.run.seed, cfg.run.seed),
        ("run.world", before.world.name, cfg.world.name),
        ("run.filter", before.run.filter, cfg.run.filter),
        ("sim.robot.physics", before.sim.robot.physics, cfg.sim.robot.physics),
    ):
        if was != wanted:
            raise ConfigError(
                f"--resume: {key} was {was} in {run_dir} and is {wanted} now; leave it out to keep what it was"
            )
    for section, then, now in (
        ("mirror.surface", before.mirror.surface, cfg.mirror.surface),
        ("mirror.panels", before.mirror.panels, cfg.mirror.panels),
        ("world", before.world, cfg.world),
    ):
        if then != now:
            text = f"section {section} is not that of {run_dir}; leave it out to keep what it was"
            raise ConfigError(f"--resume: {text}")
