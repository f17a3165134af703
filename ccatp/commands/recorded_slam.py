"""Glue. A recorded run through one estimator, or through all of them."""

from typing import TYPE_CHECKING, Any

from ccatp.errors import CcatpError, ExitStatus

if TYPE_CHECKING:
    from ccatp.config.recording_models import RecordingsConfig
    from ccatp.radio.recording import RecordedRun
    from ccatp.radio.track import Track

FORMATS = ("plaza", "mrclam", "labyrinth", "csv")
FILTERS = ("ekf-slam", "smoother")


class SlamCommandError(CcatpError):
    """A part that is not installed, or data of which an estimator makes nothing."""

    exit_status = ExitStatus.USAGE


def estimate(run: "RecordedRun", assumed: "RecordingsConfig", filter_name: str) -> "Track":
    """A run through one of ``FILTERS``.

    Raises:
        SlamCommandError: the data drove the estimator beyond finite numbers, or leave it without an answer.
    """
    from numpy.linalg import LinAlgError

    from ccatp.filters.base import FilterError

    try:
        return _estimated(run, assumed, filter_name)
    except (FilterError, LinAlgError) as error:
        raise SlamCommandError(
            f"{run.name}: {filter_name} finds no finite map for these data ({str(error)[:80]}); look at its warnings"
        ) from error


def _estimated(run: "RecordedRun", assumed: "RecordingsConfig", filter_name: str) -> "Track":
    from time import perf_counter

    from ccatp.config.recording_models import RecordingConfig
    from ccatp.radio.assumed import batch_settings, slam_settings

    cfg: RecordingConfig = getattr(assumed, run.kind)
    if filter_name == "smoother":
        from ccatp.radio.batch import smooth

        return smooth(run, batch_settings(cfg), perf_counter)
    from ccatp.radio.causal import filter_run

    first_sigmas = (cfg.priors.pose_m, cfg.priors.heading_rad)
    return filter_run(run, slam_settings(cfg, assumed.filter), first_sigmas, perf_counter)


def compared(run: "RecordedRun", assumed: "RecordingsConfig", peers: bool) -> list[dict[str, Any]]:
    """A row for each of our estimators, and for GTSAM's if asked for."""
    from time import perf_counter

    from ccatp.radio.assumed import batch_settings
    from ccatp.radio.comparison import row

    rows = []
    for name in FILTERS:
        begin_s = perf_counter()
        track = estimate(run, assumed, name)
        rows.append(row(run, name, track, perf_counter() - begin_s))
    if peers:
        from ccatp.gtsam_peer import run_gtsam

        found = run_gtsam(run, batch_settings(getattr(assumed, run.kind)), perf_counter)
        rows.append(row(run, "GTSAM iSAM2", found.isam2, float(found.isam2.update_s.sum()), peer=True))
        # it starts from what iSAM2 ended with, so that its time is not a run's
        rows.append(row(run, "GTSAM batch", found.batch, None, peer=True))
    return rows
