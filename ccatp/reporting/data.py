"""Pure. The figures of a report as data. Lengths in mm, times in s, unless a name says otherwise; null is not known."""

from typing import Any

from ccatp.aligning.wavefront import MirrorWavefront
from ccatp.reporting.findings import Findings
from ccatp.reporting.points import Grade
from ccatp.reporting.time_budget import TimeBudget

_MICRO = 1e6


def run_data(found: Findings) -> dict[str, Any]:
    """What ``ccatp report --json`` tells."""
    record = found.record
    return {
        "run": record.name,
        "mirror": record.mirror.name,
        "simulation": record.is_simulation,
        "world": record.cfg.world.name if record.is_simulation else None,
        "seed": record.cfg.run.seed,
        "outcome": found.outcome.text,
        "cause": found.outcome.cause,
        "points": {
            "total": len(found.points),
            **{str(grade).replace(" ", "_"): sum(v.grade is grade for v in found.points) for grade in Grade},
        },
        "arrival_error_mm": _spread([v.first_mm for v in found.points if v.first_mm is not None]),
        "localization_error_mm": None if found.figures is None else _rounded(found.figures._asdict()),
        "time_budget_s": None if found.budget is None else budget_data(found.budget),
        "half_wavefront_um": None if found.alignment is None else wavefront_data(found.alignment.wavefront),
        "missing": list(record.missing),
        "warnings": list(record.warnings),
    }


def budget_data(budget: TimeBudget) -> dict[str, Any]:
    """A time budget: spent and least times by kind, and their sums."""
    return {
        "spent": _rounded(budget.spent_s),
        "least": None if budget.least_s is None else _rounded(budget.least_s),
        "total": round(budget.total_s, 3),
        "bound": None if budget.bound_s is None else round(budget.bound_s, 3),
        "is_exact": budget.is_exact,
    }


def _spread(values: list[float]) -> dict[str, float] | None:
    return _rounded({"mean": sum(values) / len(values), "max": max(values)}) if values else None


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: round(value, 6) for name, value in values.items()}


def wavefront_data(wavefront: MirrorWavefront | None) -> dict[str, float] | None:
    """Half-wavefront errors, um; None where there are none."""
    if wavefront is None:
        return None
    return {name.removesuffix("_m"): round(v * _MICRO, 4) for name, v in wavefront._asdict().items()}
