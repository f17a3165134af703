"""Whether the moves that a survey plans were made, by the change of the panels that a later survey shows."""

from collections.abc import Iterator, Sequence
from enum import StrEnum
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, erfc

from ccatp.core import FloatArray, PanelId
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.panel_alignment import PanelResult
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
    mirror: Mirror, before: Sequence[PanelResult], after: Sequence[PanelResult], errors: tuple[slice, slice]
) -> tuple[PanelCheck, ...]:
    """Moves planned by the survey ``before``, and the change of the panels that ``after`` shows.

    A panel that bends with its adjusters shows each move: nine points determine five. A panel that does not bend shows
    a plane, which follows the moves by least squares: named are the fewest adjusters that explain it. ``errors``: those
    of the errors common to the panels of a survey that differ between the surveys.
    """
    return tuple(_check(mirror, one, other, errors) for one, other in zip(before, after, strict=True))


def _check(mirror: Mirror, one: PanelResult, other: PanelResult, errors: tuple[slice, slice]) -> PanelCheck:
    planned = one.rigid.moves.values_m
    modes = rigid(adjuster_places(mirror, one.panel)[1])
    if one.bending is not None and other.bending is not None:
        bent, covariance = _change((one.bending.moves, other.bending.moves), errors)
        across = np.linalg.svd(modes)[0][:, modes.shape[1] :]
        if _probability(across.T @ bent, across.T @ covariance @ across) < _FALSE_ALARM:
            made = [made_of(*each) for each in zip(planned, bent, np.sqrt(np.diag(covariance)), strict=True)]
            return PanelCheck(one.panel, _moves(one, bent, covariance, made), False, ())
    change, covariance = _change((one.rigid.moves, other.rigid.moves), errors)
    to_plane = np.asarray(np.linalg.pinv(modes), dtype=np.float64)
    of_plane = to_plane @ covariance @ to_plane.T
    sigmas = np.sqrt(np.diag(covariance))
    if _probability(to_plane @ (change - planned), of_plane) >= _FALSE_ALARM:
        return PanelCheck(one.panel, _moves(one, change, covariance, [Made.AS_PLANNED] * len(planned)), True, ())
    found = _explanations(one.adjusters, planned, to_plane, to_plane @ (change - planned), of_plane, sigmas)
    concerned = {name for explanation in found for name in explanation.adjusters}
    made = [Made.OPEN if name in concerned or not found else Made.AS_PLANNED for name in one.adjusters]
    if len(found) == 1:
        (only,) = found
        for name, moved, sigma in zip(only.adjusters, only.moved_m, only.sigmas_m, strict=True):
            at = one.adjusters.index(name)
            made[at] = only.made if only.made is Made.EXCHANGED else made_of(float(planned[at]), moved, sigma)
    return PanelCheck(one.panel, _moves(one, change, covariance, made), True, found)


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


def _probability(values: FloatArray, covariance: FloatArray) -> float:
    return float(chdtrc(len(values), values @ np.linalg.solve(covariance, values)))


def _change(plans: tuple[Moves, Moves], errors: tuple[slice, slice]) -> tuple[FloatArray, FloatArray]:
    """The change between two surveys at the adjusters, and its covariance without the errors that cancel."""
    covariance = np.zeros_like(plans[0].covariance_m2)
    for moves, part in zip(plans, errors, strict=True):
        cancel = np.delete(moves.common_m, np.arange(moves.common_m.shape[1])[part], axis=1)
        covariance = covariance + moves.covariance_m2 - cancel @ cancel.T
    return plans[0].values_m - plans[1].values_m, covariance


def _moves(one: PanelResult, change: FloatArray, covariance: FloatArray, made: Sequence[Made]) -> tuple[MoveCheck, ...]:
    sigmas = np.sqrt(np.diag(covariance)).tolist()
    rows = zip(one.adjusters, one.rigid.moves.values_m.tolist(), change.tolist(), sigmas, made, strict=True)
    return tuple(MoveCheck(one.panel, *row) for row in rows)
