"""The work at the adjusters: steps that make the moves of a survey."""

from collections.abc import Sequence
from math import ceil
from typing import NamedTuple

import numpy as np

from ccatp.config.models import AdjustersConfig
from ccatp.core import PanelId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.panel_alignment import PanelResult
from ccatp.mirror.panel_modes import adjuster_places

_SIGNIFICANT = 3.0  # standard deviations of a move from which it counts
_NAMED = 12  # largest number of panels that a message names


class Step(NamedTuple):
    """One turn of one adjuster: its place in the panel frame, m; move, m; ``turns`` of the screw if known.

    ``round``: all adjusters of a panel are turned once in a round, none by more than the configured step.
    ``is_significant``: the whole move is more than three of its standard deviations.
    """

    panel: PanelId
    round: int
    rounds: int
    adjuster: str
    x_m: float
    y_m: float
    move_m: float
    sigma_m: float
    is_significant: bool
    turns: float | None


class WorkList(NamedTuple):
    """The steps of panels, and warnings: panels without steps, and moves that are not significant."""

    steps: tuple[Step, ...]
    warnings: tuple[str, ...]

    @property
    def panels(self) -> frozenset[PanelId]:
        """The panels that are to be moved."""
        return frozenset(step.panel for step in self.steps)


def work_list(mirror: Mirror, cfg: AdjustersConfig, panels: Sequence[PanelResult]) -> WorkList:
    """The rigid moves of the panels as steps in an order that exceeds no limit.

    Panels whose points do not decide have none, and panels whose largest move is not three times the largest of their
    standard deviations: their adjusters would follow the noise.
    """
    steps, warnings = list[Step](), list[str]()
    undecided, unclear = list[PanelId](), list[PanelId]()
    travel_m, step_m, pitch_m = (1e-3 * value for value in (cfg.travel_mm, cfg.step_mm, cfg.pitch_mm))
    for panel in panels:
        moves = panel.rigid.moves
        worst = int(np.argmax(np.abs(moves.values_m)))
        if panel.deciding is not None:
            undecided.append(panel.panel)
            continue
        if abs(moves.values_m[worst]) < _SIGNIFICANT * float(moves.sigma_m.max()):
            unclear.append(panel.panel)
            continue
        if travel_m and abs(moves.values_m[worst]) > travel_m:
            warnings.append(
                f"panel {panel.panel.row}/{panel.panel.col}: {panel.adjusters[worst]} has to move by "
                f"{1e3 * moves.values_m[worst]:+.3f} mm, its travel is {cfg.travel_mm:g} mm: it is not in the work list"
            )
            continue
        rounds = ceil(abs(float(moves.values_m[worst])) / step_m - 1e-9) if step_m else 1
        places = adjuster_places(mirror, panel.panel)[1].tolist()
        for number in range(1, max(rounds, 1) + 1):
            for name, (x_m, y_m), move, sigma in zip(
                panel.adjusters, places, moves.values_m.tolist(), moves.sigma_m.tolist(), strict=True
            ):
                part = move / max(rounds, 1)
                turns = part / pitch_m if pitch_m else None
                is_significant = abs(move) >= _SIGNIFICANT * sigma
                steps.append(
                    Step(panel.panel, number, max(rounds, 1), name, x_m, y_m, part, sigma, is_significant, turns)
                )
    small = sum(not step.is_significant for step in steps if step.round == 1)
    if undecided:
        warnings.append(f"not in the work list, as their points do not decide: panels {_names(undecided)}")
    if unclear:
        warnings.append(
            f"not in the work list, as no move is {_SIGNIFICANT:g} times the largest standard deviation of the panel's "
            f"moves: panels {_names(unclear)}"
        )
    if small:
        warnings.append(
            f"{small} moves of the work list are less than {_SIGNIFICANT:g} times their standard deviation "
            "(is_significant 0): they complete the plane of their panel"
        )
    return WorkList(tuple(steps), tuple(warnings))


def _names(panels: Sequence[PanelId]) -> str:
    names = [f"{panel.row}/{panel.col}" for panel in panels]
    return ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
