"""Pure. What is drawn of a campaign of self-mappings: its first map, and the errors of all runs."""

import numpy as np

from ccatp.pictures.mote_figure import MapPicture, Traces
from ccatp.radio.rigid_alignment import best_motion
from ccatp.studies.mote_runs import MoteRun
from ccatp.studies.mote_summary import MoteCampaign, traces_of

_LINED = 100  # motes up to which the measured pairs are drawn


def pictured(campaign: MoteCampaign, seed: int) -> tuple[MapPicture, Traces | None]:
    """The map of the first run, and of the filter the errors against updates.

    Args:
        campaign: the runs.
        seed: of the first, for the title.
    """
    run = campaign.runs[0]
    title = f"{campaign.method}, {len(run.names)} motes, seed {seed}, error {1e3 * run.rms_m:.3g} mm"
    positions_m, covariance_m2 = run.positions_m, run.covariance_m2
    if run.is_aligned:  # its frame is its own: moved onto the truth, for the eye
        motion = best_motion(run.positions_m, run.true_m, mirrors=True)
        positions_m, covariance_m2 = motion.moved(positions_m), motion.turned_map(covariance_m2)
    pairs = np.array(_pairs(campaign, run), dtype=np.intp).reshape(-1, 2)
    picture = MapPicture(run.names, positions_m, covariance_m2, run.true_m, pairs, run.doubtful, title)
    if campaign.method != "ekf":
        return picture, None
    errors, expected = traces_of(campaign.runs)
    low, middle, high = np.percentile(errors, (10, 50, 90), axis=0)
    bound_m = campaign.outlook.bound_rms_m
    return picture, Traces(low, middle, high, np.median(expected, axis=0), bound_m, len(campaign.runs))


def _pairs(campaign: MoteCampaign, run: MoteRun) -> list[tuple[int, int]]:
    """Pairs of motes of the map that ranged, in phase 2 for the filter, in phase 1 for the batch."""
    field = campaign.field
    if len(run.names) > _LINED:
        return []
    row = {name: number for number, name in enumerate(run.names)}
    names = field.plan.names
    if campaign.method == "ekf":
        ends = {(names[i], names[j]) for i, j, _, _ in field.second}
    else:
        ends = {(reading.first, reading.second) for reading in field.first}
    return sorted((row[a], row[b]) for a, b in ends if a in row and b in row)
