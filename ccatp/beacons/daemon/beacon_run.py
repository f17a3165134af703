"""A run of a mission among beacons: its processes and its texts."""

from dataclasses import replace

from ccatp.beacons.config.models import RadioConfig
from ccatp.daemon.supervision.run_dir import RunOptions
from ccatp.daemon.supervision.run_text import RunText, progress_text
from ccatp.daemon.supervision.supervisor import WITHOUT_LASER
from ccatp.errors import ConfigError
from ccatp.links.topics import MissionStatus

# Positions come from radio. When main dies, its map is lost, and the run ends, held.
PROCESSES = tuple(replace(spec, is_replaceable=spec.is_replaceable and spec.name != "main") for spec in WITHOUT_LASER)


def check_beacons(options: RunOptions, cfg: RadioConfig) -> None:
    """Raises ``ConfigError`` if the simulated robot would only stand: no radio to follow, or too few rounds to map."""
    if not options.sim:
        return
    rounds, repeats = cfg.listener.mapping_rounds, cfg.cricket.ranging.repeats
    if cfg.system == "cricket" and 2 * rounds <= repeats:  # each of a pair sends once in a round
        raise ConfigError(
            f"listener.mapping_rounds = {rounds}: the map needs cricket.ranging.repeats = {repeats} readings of each "
            f"pair of motes, and more for phase 2; give {repeats} or more"
        )
    if cfg.follow.is_active and cfg.sim.target.motion == "none":
        raise ConfigError(
            'sim.target.motion = "none": there is no radio that the simulated robot could follow; give "random" or '
            '"waypoints"'
        )


def beacon_text(cfg: RadioConfig) -> RunText:
    """The texts of a mission among beacons."""
    is_following = cfg.follow.is_active
    what, goals = ("follow a radio", "seconds") if is_following else ("visit waypoints", "waypoints")

    def title(is_sim: bool) -> str:
        seed = f", seed {cfg.run.seed}" if is_sim else ""
        return f"ccatp {'SIMULATION' if is_sim else 'mission'} among beacons: {cfg.system}, {what}{seed}"

    return RunText(
        subject=cfg.system,
        title=title,
        goals=goals,
        reached="followed" if is_following else "reached",
        shown=f"system {cfg.system}",
        progress=_progress,
        accuracy=_accuracy,
    )


def _progress(status: MissionStatus) -> str:
    state = status.state + (f" ({status.cause})" if status.cause else "")
    return progress_text(status, state, " ".join(_accuracy(status)))


def _accuracy(status: MissionStatus) -> tuple[str, str]:
    return "position", f"known to {0.1 * status.error_mm:.1f} cm"
