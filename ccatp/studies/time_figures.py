"""Edge. The figures of the study `time`: where the time of a mission goes, its bounds, and the budget."""

from collections.abc import Sequence
from pathlib import Path

from ccatp.studies.campaign import CellResult
from ccatp.studies.figures import INK, LIMIT, QUIET, colour, dress, new_figure, save

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
