"""Whether the moves that a survey plans were made, by the change of the panels that a later survey shows."""

from collections.abc import Collection, Iterator, Sequence
from enum import StrEnum
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, erfc

from ccatp.core import FloatArray, PanelId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.panel_alignment import PanelResult
from ccatp.mirror.panel_changes import Changes, PanelChange
from ccatp.mirror.panel_modes import Moves, adjuster_places, rigid

_SIGMAS = 4.0  # of a difference that noise does not make in the several hundred adjusters of a mirror
_FALSE_ALARM = float(erfc(_SIGMAS / np.sqrt(2.0)))
_MOST_EXPLANATIONS = 3  # of the change of a panel, beyond which only its plane is known


class Made(StrEnum):
    """Whether a move was made."""

    AS_PLANNED = "as planned"
    NOT = "did not move"
    WRONG_WAY = "moved the wrong way"
    PARTLY = "moved too little"
    TOO_FAR = "moved too far"
    EXCHANGED = "exchanged"
    OPEN = "not known"


class MoveCheck(NamedTuple):
    """One adjuster: planned and measured move, m, the sigma of their difference, and the verdict.

    ``measured_m``: change of the panel at the adjuster, of its plane if it has not bent.
    """

    panel: PanelId
    adjuster: str
    planned_m: float
    measured_m: float
    sigma_m: float
    made: Made


class MoveExplanation(NamedTuple):
    """Adjusters that explain a change: what all of them did, and the moves that it takes, m, with their sigmas.

    ``factor``: all adjusters moved by this multiple of the plan; None if only those named differ from it.
    """

    made: Made
    adjusters: tuple[str, ...]
    moved_m: tuple[float, ...]
    sigmas_m: tuple[float, ...]
    factor: float | None = None


class PanelCheck(NamedTuple):
    """The adjusters of a panel, and what explains a change of its plane that is not the planned one.

    ``is_plane``: the panel has not bent, so that its change has three numbers and not one for each adjuster; without
    an ``explanation`` more than two adjusters are not as planned.
    """

    panel: PanelId
    moves: tuple[MoveCheck, ...]
    is_plane: bool
    explanations: tuple[MoveExplanation, ...]

    @property
    def is_as_planned(self) -> bool:
        """Whether the panel has changed as planned."""
        return all(move.made is Made.AS_PLANNED for move in self.moves)


def made_of(planned_m: float, measured_m: float, sigma_m: float) -> Made:
    """The verdict on one move; as planned is a measured move that differs from it by no more than noise."""
    limit = _SIGMAS * sigma_m
    if abs(measured_m - planned_m) <= limit:
        return Made.AS_PLANNED
    if abs(measured_m) <= limit:
        return Made.NOT
    if measured_m * planned_m < 0.0 and abs(planned_m) > limit:
        return Made.WRONG_WAY
    if abs(measured_m) < abs(planned_m):
        return Made.PARTLY
    return Made.TOO_FAR


def check_moves(
    mirrors: tuple[Mirror, Mirror],
    pairs: Sequence[tuple[PanelResult, PanelResult]],
    changes: Changes,
    with_work: Collection[PanelId],
) -> tuple[PanelCheck, ...]:
    """Moves planned by the earlier survey of each pair, and the change of the panels, by the places of the adjusters.

    A panel that bends with its adjusters shows each move: nine points determine five. A panel that does not bend shows
    a plane, which follows the moves by least squares: named are the fewest adjusters that explain it. ``mirrors``: of
    both surveys, which may order the adjusters otherwise. ``with_work``: panels that were to be moved; others have no
    plan.
    """
    return tuple(
        _check(mirrors, before, after, change)
        for (before, after), change in zip(pairs, changes.panels, strict=True)
        if before.panel in with_work
    )


def _check(mirrors: tuple[Mirror, Mirror], one: PanelResult, other: PanelResult, plane: PanelChange) -> PanelCheck:
    planned = one.rigid.moves.values_m
    modes = rigid(adjuster_places(mirrors[0], one.panel)[1])
    if one.bending is not None and other.bending is not None:
        order = _order(mirrors, one.panel)
        bent = one.bending.moves.values_m - other.bending.moves.values_m[order] - modes @ plane.common
        # What panels share, and the common motion, change planes.
        covariance = modes @ (plane.covariance - plane.own_covariance) @ modes.T
        covariance += plane.variance * (_own(one.bending.moves) + _own(other.bending.moves)[np.ix_(order, order)])
        across = np.linalg.svd(modes)[0][:, modes.shape[1] :]
        if _probability(across.T @ bent, across.T @ covariance @ across) < _FALSE_ALARM:
            made = [made_of(*each) for each in zip(planned, bent, np.sqrt(np.diag(covariance)), strict=True)]
            return PanelCheck(one.panel, _moves(one, bent, covariance, made), False, ())
    change, covariance = modes @ plane.values, modes @ plane.covariance @ modes.T
    to_plane = np.asarray(np.linalg.pinv(modes), dtype=np.float64)
    sigmas = np.sqrt(np.diag(covariance))
    difference = plane.values - to_plane @ planned
    if is_noise(difference, plane.covariance):
        return PanelCheck(one.panel, _moves(one, change, covariance, [Made.AS_PLANNED] * len(planned)), True, ())
    found = _explanations(one.adjusters, planned, to_plane, difference, plane.covariance, sigmas)
    concerned = {name for explanation in found for name in explanation.adjusters}
    made = [Made.OPEN if name in concerned or not found else Made.AS_PLANNED for name in one.adjusters]
    if len(found) == 1:
        (only,) = found
        for name, moved, sigma in zip(only.adjusters, only.moved_m, only.sigmas_m, strict=True):
            at = one.adjusters.index(name)
            made[at] = only.made if only.made is Made.EXCHANGED else made_of(float(planned[at]), moved, sigma)
    return PanelCheck(one.panel, _moves(one, change, covariance, made), True, found)


def _order(mirrors: tuple[Mirror, Mirror], panel: PanelId) -> list[int]:
    """The adjusters of the second mirror in the order of the first, by their places."""
    places, others = (adjuster_places(mirror, panel)[1] for mirror in mirrors)
    return [int(np.argmin(np.linalg.norm(others - place, axis=1))) for place in places]


def _own(moves: Moves) -> FloatArray:
    """The covariance without errors that panels share."""
    return np.asarray(moves.covariance_m2 - moves.common_m @ moves.common_m.T)


def _explanations(
    names: tuple[str, ...],
    planned: FloatArray,
    to_plane: FloatArray,
    difference: FloatArray,
    covariance: FloatArray,
    sigmas: FloatArray,
) -> tuple[MoveExplanation, ...]:
    """Explanations with the fewest free numbers of a change whose plane differs from the planned one; () without."""
    candidates = (
        _without_numbers(names, planned, sigmas),
        _with_numbers(names, planned, 1),
        _with_numbers(names, planned, 2),
    )
    for some in candidates:
        found = []
        for made, concerned, start, free in some:
            design = to_plane @ free
            weighted = np.linalg.solve(
                np.linalg.cholesky(covariance), np.column_stack([difference - to_plane @ start, design])
            )
            values = np.linalg.lstsq(weighted[:, 1:], weighted[:, 0], rcond=None)[0]
            left = weighted[:, 0] - weighted[:, 1:] @ values
            if float(chdtrc(len(left) - free.shape[1], left @ left)) < _FALSE_ALARM:
                continue
            own = free @ np.linalg.pinv(weighted[:, 1:].T @ weighted[:, 1:]) @ free.T
            at = [names.index(name) for name in concerned]
            moved = planned + start + free @ values
            is_common = made is not Made.EXCHANGED and len(at) == len(names)
            factor = float(moved @ planned / (planned @ planned)) if is_common else None
            found.append(
                MoveExplanation(
                    made, concerned, tuple(moved[at].tolist()), tuple(np.sqrt(np.diag(own))[at].tolist()), factor
                )
            )
        if found:
            return tuple(found) if len(found) <= _MOST_EXPLANATIONS else ()
    return ()


_Candidate = tuple[Made, tuple[str, ...], FloatArray, FloatArray]  # change of the moves, and of them per free number


def _without_numbers(names: tuple[str, ...], planned: FloatArray, sigmas: FloatArray) -> Iterator[_Candidate]:
    """No adjuster moved, all moved the wrong way, or two were exchanged."""
    nothing = np.zeros((len(names), 0))
    yield Made.NOT, names, -planned, nothing
    yield Made.WRONG_WAY, names, -2.0 * planned, nothing
    for i, j in combinations(range(len(names)), 2):
        turn = planned[j] - planned[i]
        if abs(turn) > _SIGMAS * max(sigmas[i], sigmas[j]):
            change = np.zeros(len(names))
            change[[i, j]] = turn, -turn
            yield Made.EXCHANGED, (names[i], names[j]), change, nothing


def _with_numbers(names: tuple[str, ...], planned: FloatArray, count: int) -> Iterator[_Candidate]:
    """Some adjusters moved by other amounts, or all by a multiple of the plan."""
    if count == 1:
        yield Made.OPEN, names, np.zeros(len(names)), planned[:, None]
    for some in combinations(range(len(names)), count):
        yield Made.OPEN, tuple(names[at] for at in some), np.zeros(len(names)), np.eye(len(names))[:, list(some)]


def is_noise(values: FloatArray, covariance: FloatArray) -> bool:
    """Whether noise of this covariance may make the values, on any panel of a mirror."""
    return _probability(values, covariance) >= _FALSE_ALARM


def _probability(values: FloatArray, covariance: FloatArray) -> float:
    return float(chdtrc(len(values), values @ np.linalg.solve(covariance, values)))


def _moves(one: PanelResult, change: FloatArray, covariance: FloatArray, made: Sequence[Made]) -> tuple[MoveCheck, ...]:
    sigmas = np.sqrt(np.diag(covariance)).tolist()
    rows = zip(one.adjusters, one.rigid.moves.values_m.tolist(), change.tolist(), sigmas, made, strict=True)
    return tuple(MoveCheck(one.panel, *row) for row in rows)
