"""Pure. Whether a filter knows how wrong it is: normalised errors at the stops and innovations of the fixes.

The mean of N values that follow chi-square with n degrees of freedom is n, and N times it follows chi-square with N n:
between its 2.5 and 97.5 % quantiles over N the mean of a consistent filter lies in 95 % of the campaigns (Bar-Shalom,
Li and Kirubarajan 2001, 5.4). The stops count as independent: each begins a leg of its own after its fix.
"""

from typing import Any

import numpy as np
from scipy.special import chdtri

from ccatp.samples import FloatArray
from ccatp.studies.mission_job import COLUMN

_POSE = [COLUMN["error_x_m"], COLUMN["error_y_m"], COLUMN["error_heading_rad"]]
_UPPER = [COLUMN[name] for name in ("p_xx", "p_xy", "p_xh", "p_yy", "p_yh", "p_hh")]
POSE, POSITION = 3, 2  # degrees of freedom


def nees(rows: FloatArray, states: int) -> FloatArray:
    """Normalised estimation error squared, e' P^-1 e, of the first ``states`` of x, y, heading, shape (k,).

    Args:
        rows: stops, columns ``mission_job.STOP_COLUMNS``.
        states: 3 for the pose, 2 for the position.

    Returns:
        NaN where the covariance is not positive definite.
    """
    full = np.empty((len(rows), 3, 3))
    upper = np.triu_indices(3)
    full[:, upper[0], upper[1]] = full[:, upper[1], upper[0]] = rows[:, _UPPER]
    result = np.full(len(rows), np.nan)
    for k, covariance in enumerate(full[:, :states, :states]):
        error = rows[k, _POSE[:states]]
        try:
            half = np.linalg.solve(np.linalg.cholesky(covariance), error)
        except np.linalg.LinAlgError:
            continue
        result[k] = half @ half
    return result


def nees_figures(rows: FloatArray) -> dict[str, Any]:
    """Normalised errors of pose and position at the stops; see ``chi_square_figures``."""
    return {
        "pose": chi_square_figures(nees(rows, POSE), POSE),
        "position": chi_square_figures(nees(rows, POSITION), POSITION),
    }


def nis_figures(rows: FloatArray) -> dict[str, Any]:
    """Normalised innovations squared of the fixes; see ``chi_square_figures``."""
    return chi_square_figures(rows[:, COLUMN["nis"]], POSITION)


def chi_square_figures(values: FloatArray, freedom: int) -> dict[str, Any]:
    """How values compare with chi-square; those that are not finite are left out.

    Args:
        values: shape (k,).
        freedom: degrees of freedom.

    Returns:
        ``count``; ``mean`` and ``band_95``, in which that of a consistent filter lies; ``is_within_band``; ``p50``;
        ``within_95_fraction``, the share below the 95 % quantile of a single value.
    """
    known = values[np.isfinite(values)]
    if not known.size:
        nothing = dict.fromkeys(("mean", "band_95", "is_within_band", "p50", "within_95_fraction"))
        return {"count": 0, **nothing}
    total = known.size * freedom
    low, high = (float(chdtri(total, tail)) / known.size for tail in (0.975, 0.025))
    mean = float(known.mean())
    return {
        "count": int(known.size),
        "mean": round(mean, 4),
        "band_95": [round(low, 4), round(high, 4)],
        "is_within_band": low <= mean <= high,
        "p50": round(float(np.median(known)), 4),
        "within_95_fraction": round(float(np.mean(known <= chdtri(freedom, 0.05))), 4),
    }
