"""Glue. The report at the end of a run. It never fails the run, and nobody who asked for the end waits for it."""

from pathlib import Path

import structlog

from ccatp.errors import ExitStatus


def write_run_report(run_dir: Path, status: ExitStatus, log: structlog.typing.FilteringBoundLogger) -> str:
    """Write the report of a run that has ended.

    Args:
        run_dir: the run.
        status: what it ended with; an interrupted run gets none, because somebody is waiting for the end.
        log: takes why there is none.

    Returns:
        Where it is, or why there is none.
    """
    by_hand = f"none; make it with: ccatp report {run_dir}"
    if status is ExitStatus.INTERRUPTED:
        return by_hand
    # Nothing of it is needed while the robot moves.
    from ccatp.report_writer import report_run  # noqa: PLC0415
    from ccatp.run_files.run_reader import RunReadError  # noqa: PLC0415

    try:
        return str(report_run(run_dir).path)
    except RunReadError as error:
        return f"none; {error}"
    except Exception as error:
        # Whatever it is: the survey is done, and its record is on the disk.
        log.error("report", error=f"{type(error).__name__}: {error}")
        return by_hand
