"""Edge. The drive in a run directory, as the calibration takes it."""

from pathlib import Path

from ccatp.calibrating.drive import Drive, DriveBuilder
from ccatp.config.models import Config
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.replaying.events import Marked, in_order
from ccatp.run_files.run_reader import open_run

# A survey has hundreds of legs; what its first ones do not show the others hardly will, and time grows with the cube.
MAX_FIXES = 60


def read_drive(run_dir: Path) -> tuple[Drive, Mirror, Config]:
    """The newest recording of a run: its drive, its mirror, its configuration.

    Raises:
        RunReadError: there is no recording that can be read.
        ConfigError: its configuration cannot be used.
    """
    recording = open_run(run_dir)[-1]
    cfg = recording.config({})
    mirror = build_mirror(cfg.mirror)
    builder, fixes = DriveBuilder(mirror, cfg.robot.puck_height_m), 0
    for event in in_order(recording.messages()):
        if isinstance(event, Marked):
            builder.frame(event.sensors)
        elif event.was_fused:
            builder.fix(event.fix)
            fixes += 1
            if fixes == MAX_FIXES:
                break
    return builder.build(), mirror, cfg
