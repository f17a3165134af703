"""The study `time`: what order of points, speed and measuring time do to the hour a mission may take.

The figures of the study `time`: where the time of a mission goes, its bounds, and the budget.
"""

from collections.abc import Sequence
from pathlib import Path

from ccatp.mirror.mirror import build_mirror
from ccatp.report.plots import INK, QUIET, dress, new_figure
from ccatp.studies.campaign import Cell, CellResult, Column, Factors, Job, JobOutcome, Study
from ccatp.studies.figures import LIMIT, colour, save
from ccatp.studies.mission_study import combine_missions, run_mission
from ccatp.survey.planning.route import ORDERS
from ccatp.survey.planning.tour_bound import tour_bound

_PARTS = ("measuring", "driving", "turning", "settling")


def draw_time(cells: Sequence[CellResult], out: Path) -> None:
    """One bar for each cell, stacked by what the robot does; one figure for each mirror."""
    for mirror in dict.fromkeys(str(cell.factors["mirror"]) for cell in cells):
        there = [c for c in cells if c.factors["mirror"] == mirror and c.values["mission_time_s"] is not None]
        if there:
            _draw(mirror, there, out / f"time-{mirror}")


def _draw(mirror: str, cells: Sequence[CellResult], stem: Path) -> None:
    figure = new_figure(8.4, 0.32 * len(cells) + 1.9)
    axes = figure.subplots()
    for place, cell in enumerate(cells):
        left_s = 0.0
        states_s = cell.values["states_s"]
        for index, part in enumerate((*_PARTS, "rest")):
            rest = sum(time_s for state, time_s in states_s.items() if state not in _PARTS)
            width_s = rest if part == "rest" else states_s.get(part, 0.0)
            shade = QUIET if part == "rest" else colour(index)
            label = part if place == 0 else None
            axes.barh(place, width_s, left=left_s, height=0.66, color=shade, label=label)
            left_s += width_s
        for name, style in (("lower_bound_s", "-"), ("tour_bound_s", ":")):
            label = {"-": "bound of the path", ":": "bound of any tour"}[style] if place == 0 else None
            axes.plot([cell.values[name]] * 2, [place - 0.45, place + 0.45], color=INK, linestyle=style, label=label)
        axes.text(left_s, place, f"  {cell.values['time_ratio']:.3f}", va="center", fontsize=7, color=QUIET)
    budget_s = cells[0].values["budget_s"]
    longest_s = max(cell.values["mission_time_s"] for cell in cells)
    if longest_s > 0.4 * budget_s:  # a few panels are no matter of an hour
        axes.axvline(budget_s, color=LIMIT, linewidth=1.2, label="budget")
    axes.set_yticks(range(len(cells)), [_name(cell) for cell in cells])
    axes.invert_yaxis()
    axes.margins(x=0.08)
    axes.set(
        xlabel="time, s; number: in units of the path's bound", title=f"Where the time of a mission on {mirror} goes"
    )
    dress(axes)
    axes.grid(visible=False, axis="y")
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    save(figure, stem)


def _name(cell: CellResult) -> str:
    factors = cell.factors
    return f"{factors['order']}, {factors['v_max_m_s']:.2f} m/s, {factors['measuring_time_s']:.1f} s"


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


def run_job(job: Job) -> JobOutcome:
    """One mission, and the least time of any tour through its points."""
    values, arrays = run_mission(job)
    cfg = job.cfg
    mirror = build_mirror(cfg.mirror)
    points = ORDERS[cfg.run.order](mirror, cfg.run.panels)
    bound_s = tour_bound(mirror, points, cfg.limits, cfg.etalon.measuring_time_s)
    return JobOutcome({**values, "tour_bound_s": round(bound_s, 3), "budget_s": cfg.run.budget_s}, arrays)


def combine(factors: Factors, outcomes: Sequence[JobOutcome]) -> JobOutcome:
    """The missions pooled, and the margin that the slowest leaves."""
    values, arrays = combine_missions(factors, outcomes)
    tour_s, budget_s = (float(outcomes[0].values[name]) for name in ("tour_bound_s", "budget_s"))
    mean_s, slowest_s = values["mission_time_s"], values["mission_time_max_s"]
    return JobOutcome(
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
