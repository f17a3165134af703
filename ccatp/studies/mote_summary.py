"""Pure. Many self-mappings of one configuration, put together: errors, bound, what is free, traces."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from ccatp.config.cricket_models import CricketConfig
from ccatp.motes.range_network import FloatArray
from ccatp.radio.rigid_alignment import aligned_rms_m, rms_m
from ccatp.studies.mote_field import SimulatedField, simulate_field
from ccatp.studies.mote_runs import MoteOutlook, MoteRun, look_ahead, run_batch, run_filter

METHODS = ("ekf", "batch")


class MoteCampaign(NamedTuple):
    """Runs of one configuration.

    Attributes:
        method: ``ekf`` or ``batch``.
        runs: in the order of their seeds.
        outlook: of the first seed's graph, bounds at the median number of updates.
        field: the first.
    """

    method: str
    runs: tuple[MoteRun, ...]
    outlook: MoteOutlook
    field: SimulatedField


def run_campaign(
    cfg: CricketConfig, method: str, seeds: Sequence[int], tell: Callable[[int], None] = lambda _: None
) -> MoteCampaign:
    """Map the motes once for each seed.

    Args:
        cfg: the motes.
        method: ``ekf`` or ``batch``.
        seeds: of the runs.
        tell: called with the number of runs done.

    Raises:
        MappingError: a field of which no map can be made.
    """
    field = simulate_field(cfg, seeds[0])
    outlook = look_ahead(cfg, field, method)
    runs = []
    for done, seed in enumerate(seeds, start=1):
        drawn = field if seed == seeds[0] else simulate_field(cfg, seed)
        # Drawn layouts differ from seed to seed, and so do their folds.
        known = outlook if cfg.layout != "random" or seed == seeds[0] else look_ahead(cfg, drawn, method)
        runs.append(run_filter(cfg, drawn) if method == "ekf" else run_batch(cfg, drawn, known))
        tell(done)
    if method == "ekf":
        updates = int(np.median([run.iterations for run in runs]))
        outlook = look_ahead(cfg, field, method, max(updates, 1))
    return MoteCampaign(method, tuple(runs), outlook, field)


def campaign_data(campaign: MoteCampaign) -> dict[str, Any]:
    """What ``ccatp radio map --json`` prints."""
    runs, outlook = campaign.runs, campaign.outlook
    laid = [run.phase1_rms_m for run in runs if run.phase1_rms_m is not None]
    return {
        "rms_m": percentiles([run.rms_m for run in runs]),
        "crlb_m": outlook.bound_rms_m,
        "rank_deficiency": outlook.freedom.deficiency,
        "fold_over_risk": not outlook.folds.is_unique,
        "phase1_rms_m": float(np.median(laid)) if laid else None,
        "iterations": int(np.median([run.iterations for run in runs])),
        "method": campaign.method,
        "seeds": len(runs),
        "motes": len(runs[0].names),
        "frame": "aligned" if runs[0].is_aligned else "surveyed",
        "rms_of_all_m": float(np.sqrt(np.mean([run.rms_m**2 for run in runs]))),
        "motes_in_doubt": int(np.median([len(run.doubtful) for run in runs])),
        "rms_of_others_m": float(np.median([sure_rms_m(run) for run in runs])),
        "expected_rms_m": float(np.median([run.expected_rms_m for run in runs])),
        "offset_m": float(np.median([run.offset_m for run in runs])),
        "scale": 1.0 + float(np.median([run.scale for run in runs])),
        "free_directions": [*outlook.freedom.frame, *outlook.freedom.flexes, *outlook.freedom.calibration],
        "warnings": list(outlook.folds.warnings),
    }


def sure_rms_m(run: MoteRun) -> float:
    """Error of the motes that are not in doubt, in the frame of the run; not a number where there are too few."""
    sure = [row for row in range(len(run.names)) if row not in run.doubtful]
    found, true = run.positions_m[sure], run.true_m[sure]
    if not run.is_aligned:
        return rms_m(found, true)
    return aligned_rms_m(found, true, mirrors=True) if len(sure) > true.shape[1] else float("nan")


def percentiles(values: Sequence[float]) -> dict[str, float]:
    """10, 50 and 90 %."""
    low, middle, high = np.percentile(values, (10, 50, 90))
    return {"p10": float(low), "p50": float(middle), "p90": float(high)}


def traces_of(runs: Sequence[MoteRun]) -> tuple[FloatArray, FloatArray]:
    """Errors and expected errors by update, shape (runs, k) each; a run that ended early stays where it was."""
    longest = max(len(run.trace_m) for run in runs)

    def padded(traces: Sequence[FloatArray]) -> FloatArray:
        return np.array([np.pad(trace, (0, longest - len(trace)), mode="edge") for trace in traces])

    return padded([run.trace_m for run in runs]), padded([run.expected_trace_m for run in runs])
