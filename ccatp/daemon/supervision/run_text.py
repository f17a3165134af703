"""What a kind of mission says of a run: names for records, texts for the terminal."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from ccatp.config.load import load_mission
from ccatp.config.mission import CommonConfig
from ccatp.daemon.supervision.process import run_dir_in
from ccatp.errors import ConfigError
from ccatp.links.topics import MissionStatus
from ccatp.missions import kind_of


def arrival(status: MissionStatus) -> tuple[str, str]:
    """Name and value of the error at the last point; it is exactly zero before the first arrival of a main loop."""
    none = "none since the main loop began" if status.done else "none yet"
    shown = f"{status.error_mm:.2f} mm from the last point, as estimated" if status.error_mm else none
    return "arrival", shown


@dataclass(frozen=True, slots=True)
class RunText:
    """The texts of a configuration.

    ``subject``: the mirror, or the system; ``folder``: in the name of the run directory; ``details``: further metadata
    of the recording. ``title``: headline of a run, given whether it is simulated. ``goals``: what it counts, and
    ``reached`` what is said of those that are done. ``shown``: for ``ccatp config check``. ``progress``: one line of a
    status; ``accuracy``: name and value of its error.
    """

    subject: str
    title: Callable[[bool], str]
    goals: str
    shown: str
    progress: Callable[[MissionStatus], str]
    folder: str = ""
    details: Mapping[str, str] = field(default_factory=dict)
    reached: str = "reached"
    accuracy: Callable[[MissionStatus], tuple[str, str]] = arrival


def text_in(runtime_dir: Path) -> RunText | None:
    """The texts of the run in a runtime directory; ``None``: its configuration is not there."""
    with suppress(ConfigError):
        run_dir = run_dir_in(runtime_dir)
        if run_dir is not None:
            cfg = load_mission(run_dir / "config.toml")
            text: RunText = kind_of(cfg).text.get()(cfg)
            return text
    return None


def clock(seconds: float) -> str:
    """``1:02:03``, or ``2:03`` below an hour."""
    minutes, rest = divmod(max(round(seconds), 0), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def progress_text(status: MissionStatus, state: str, rest: str) -> str:
    """State, place, elapsed time and the rest."""
    return f"{state} {status.point}".strip() + f", {clock(status.elapsed_s)} elapsed, {rest}"


def plain_text(cfg: CommonConfig) -> RunText:
    """The texts of a kind of mission that has none of its own."""

    def title(is_sim: bool) -> str:
        return f"ccatp {'SIMULATION' if is_sim else 'mission'} of {cfg.system}, seed {cfg.run.seed}"

    def progress(status: MissionStatus) -> str:
        return progress_text(status, status.state, f"{clock(status.eta_s)} remaining")

    return RunText(subject=cfg.system, title=title, goals="goals", shown=f"system {cfg.system}", progress=progress)
