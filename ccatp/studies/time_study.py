"""Pure. The study `time`: what order of points, speed and measuring time do to the hour a mission may take."""

from collections.abc import Sequence

from ccatp.mirror.mirror import build_mirror
from ccatp.planning.tour_bound import tour_bound
from ccatp.planning.traversal import ORDERS
from ccatp.studies.campaign import Cell, Column, Factors, Job, Outcome, Study
from ccatp.studies.mission_cell import combine_missions
from ccatp.studies.mission_job import run_mission
from ccatp.studies.time_figures import draw_time

TRAVERSALS = ("thesis", "optimised")
SPEEDS_M_S = (0.10, 0.15, 0.20)
MEASURING_S = (0.5, 1.0)
COLUMNS = (
    Column("complete", "complete"),
    Column("mission, s", "mission_time_s", ".0f"),
    Column("bound of the path, s", "lower_bound_s", ".0f"),
    Column("time / bound", "time_ratio", ".4f"),
    Column("bound of any tour, s", "tour_bound_s", ".0f"),
    Column("time / any tour", "tour_ratio", ".4f"),
    Column("margin to the budget, s", "margin_s", ".0f"),
    Column("turning, s", "states_s.turning", ".0f"),
    Column("driving, s", "states_s.driving", ".0f"),
    Column("settling, s", "states_s.settling", ".0f"),
    Column("measuring, s", "states_s.measuring", ".0f"),
    Column("corrections", "corrections"),
    Column("localization mean, mm", "localization_error_mm.mean", ".3f"),
    Column("arrival mean, mm", "arrival_error_mm.mean", ".3f"),
    Column("arrival max, mm", "arrival_error_mm.max", ".2f"),
)


def cells() -> Sequence[Cell]:
    """Orders times speeds times measuring times."""
    return [
        Cell(
            {"order": order, "v_max_m_s": v_m_s, "measuring_time_s": measuring_s},
            {"run.order": order, "limits.v_max_m_s": v_m_s, "etalon.measuring_time_s": measuring_s},
        )
        for order in TRAVERSALS
        for v_m_s in SPEEDS_M_S
        for measuring_s in MEASURING_S
    ]


def run_job(job: Job) -> Outcome:
    """One mission, and the least time of any tour through its points."""
    values, arrays = run_mission(job)
    cfg = job.cfg
    mirror = build_mirror(cfg.mirror)
    points = ORDERS[cfg.run.order](mirror, cfg.run.panels)
    bound_s = tour_bound(mirror, points, cfg.limits, cfg.etalon.measuring_time_s)
    return Outcome({**values, "tour_bound_s": round(bound_s, 3), "budget_s": cfg.run.budget_s}, arrays)


def combine(factors: Factors, outcomes: Sequence[Outcome]) -> Outcome:
    """The missions pooled, and the margin that the slowest leaves."""
    values, arrays = combine_missions(factors, outcomes)
    tour_s, budget_s = (float(outcomes[0].values[name]) for name in ("tour_bound_s", "budget_s"))
    mean_s, slowest_s = values["mission_time_s"], values["mission_time_max_s"]
    return Outcome(
        {
            **values,
            "tour_bound_s": tour_s,
            "tour_ratio": None if mean_s is None else round(mean_s / tour_s, 5),
            "budget_s": budget_s,
            "margin_s": None if slowest_s is None else round(budget_s - slowest_s, 3),
        },
        arrays,
    )


STUDY = Study(
    name="time",
    title="Order, speed and measuring time against the hour",
    cells=cells,
    run_job=run_job,
    combine=combine,
    columns=COLUMNS,
    draw=draw_time,
    runs=2,
)
