"""Pure. Estimators side by side on the same recordings: rows of figures, as a Markdown table."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ccatp.radio.judged import judge
from ccatp.radio.recording import RecordedRun
from ccatp.radio.slam_report import result_data
from ccatp.radio.track import Track

COLUMNS = (
    ("data", "dataset", "{}"),
    ("estimator", "filter", "{}"),
    ("path, m", "trajectory_rmse_m", "{:.3f}"),
    ("heading, rad", "heading_rmse_rad", "{:.4f}"),
    ("beacons, m", "beacon_rmse_m", "{:.3f}"),
    ("range scale", "range_scale", "{:.4f}"),
    ("NIS", "nis_mean", "{:.2f}"),
    ("NEES", "nees_mean", "{:.2f}"),
    ("update, us", "update_us_p50", "{:.0f}"),
    ("whole run, s", "run_s", "{:.1f}"),
)
AVERAGED = ("trajectory_rmse_m", "heading_rmse_rad", "beacon_rmse_m", "update_us_p50", "run_s")


def row(run: RecordedRun, name: str, track: Track, run_s: float | None, *, peer: bool = False) -> dict[str, Any]:
    """The figures of one estimator on one run; a peer tells no covariance."""
    data = result_data(run, name, track, judge(track, run))
    found = {key: data.get(key) for _, key, _ in COLUMNS}
    found["run_s"] = run_s
    if peer:
        found["nees_mean"] = None
    return found


def with_means(rows: Sequence[dict[str, Any]], name: str) -> list[dict[str, Any]]:
    """The rows, and behind them the mean of each estimator over the runs, if there are several."""
    estimators = list(dict.fromkeys(r["filter"] for r in rows))
    means = []
    for estimator in estimators:
        own = [r for r in rows if r["filter"] == estimator]
        if len(own) < 2:
            return list(rows)
        mean: dict[str, Any] = {key: None for _, key, _ in COLUMNS}
        mean.update(dataset=name, filter=estimator)
        for key in AVERAGED:
            values = [r[key] for r in own if r[key] is not None]
            mean[key] = float(np.mean(values)) if values else None
        means.append(mean)
    return [*rows, *means]


def markdown(rows: Iterable[dict[str, Any]]) -> list[str]:
    """A table."""
    cells = [[title for title, _, _ in COLUMNS]]
    cells += [["-" if r[key] is None else shape.format(r[key]) for _, key, shape in COLUMNS] for r in rows]
    widths = [max(len(line[k]) for line in cells) for k in range(len(COLUMNS))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) + " |" for line in cells
    ]
    return [lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]]
