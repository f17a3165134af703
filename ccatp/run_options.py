"""Pure. What ``ccatp run`` was asked to do."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path, PurePath


@dataclass(frozen=True, slots=True)
class RunOptions:
    """The command line of ``ccatp run``.

    Attributes:
        sim: start the stand-ins of robot and laser system.
        config_file: the user's configuration, or ``None`` for the default one.
        overrides: dotted keys given on the command line (``{"run.seed": 2}``), stronger than the file.
        realtime: pace the stand-ins on the wall clock instead of in lockstep.
        run_dir: where the run is written; ``None`` asks for ``default_run_dir``.
        resume: carry on with the mission in ``run_dir``.
        held: begin held, until an operator resumes.
        recover: carry on, held, with the run that did not finish, or else begin one that may be recovered.
        json_output: the summary goes to standard output as JSON, and nothing else does.
        runtime_dir: folder of the unix sockets given on the command line, or ``None``.
        faults_file: plan of faults for the stand-ins, or ``None``; a copy goes into the run directory.
        shows_summary: the summary goes to standard output at the end.
    """

    sim: bool
    config_file: Path | None = None
    overrides: Mapping[str, object] = field(default_factory=dict)
    realtime: bool = False
    run_dir: Path | None = None
    resume: bool = False
    held: bool = False
    recover: bool = False
    json_output: bool = False
    runtime_dir: Path | None = None
    faults_file: Path | None = None
    shows_summary: bool = True

    @property
    def is_paced(self) -> bool:
        """The robot's clock is that of the wall: there is time to sleep between frames."""
        return self.realtime or not self.sim


def default_run_dir(mirror: str, seed: int, now_utc: datetime, parent: Path = Path("runs")) -> Path:
    """Where a run is written when nobody said: ``runs/<UTC time>-<mirror>-s<seed>``.

    Args:
        mirror: ``run.mirror``, a name or the path of a file.
        seed: ``run.seed``.
        now_utc: the time, with its zone set to UTC.
        parent: the folder of all runs.
    """
    return parent / f"{now_utc:%Y%m%dT%H%M%SZ}-{PurePath(mirror).stem}-s{seed}"
