"""Pure. What looks wrong in a recorded run, a line each: for the reader's eyes, nothing of it reaches an estimator."""

from ccatp.radio.recording import RecordedRun


def suspicions(run: RecordedRun) -> list[str]:
    """Warnings."""
    return []
