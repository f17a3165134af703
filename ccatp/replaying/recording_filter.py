"""Pure. A filter that keeps what is done to it, so that a smoother can go back over it."""

from collections import deque
from typing import NamedTuple, cast

import numpy as np

from ccatp.filters.base import Filter, FloatArray, Innovation, Observation, Transition
from ccatp.filters.smoother import ROUNDING, Smoother

# Calls that may still be taken back. A late fix reaches back some seconds, which are a few hundred.
REACH = 2000
# Steps in one smoother: some 30 MB at 19 states, so that going back needs little more memory than the record itself.
CHAPTER = 4096


class _Step(NamedTuple):
    """x' = F x + ..., P' = F P F^T + Q: what a smoother needs of a transition."""

    F: FloatArray
    predicted: FloatArray
    Q: FloatArray


class _Past(NamedTuple):
    """The state before a call, and the transition that the call was; None for an update."""

    mean: FloatArray
    covariance: FloatArray
    step: _Step | None


class _State(NamedTuple):
    """A mean and its covariance: all that a smoother asks of a filter."""

    mean: FloatArray
    covariance: FloatArray


class SmoothedPoses(NamedTuple):
    """The first three states, given everything recorded: means (k, 3) and covariances (k, 3, 3) of k states."""

    means: FloatArray
    covariances: FloatArray


class RecordingFilter:
    """Does what the filter in it does, and records every transition of the state.

    A ``reset`` is one of three things. To a state that the filter has been in: it is taken back there, and what came
    after is forgotten. From a state in which nothing was recorded yet: the beginning. Anything else is a transition of
    its own (``transition_of_reset``).

    The record costs ``Smoother``'s memory, 9 kB a transition at 19 states.

    Args:
        filter_: does the work.

    Attributes:
        mean, covariance, transition: the filter's.
    """

    def __init__(self, filter_: Filter) -> None:
        self._filter = filter_
        self._past: deque[_Past] = deque()
        self._chapters: list[Smoother] = []
        self._recorded = 0  # in the chapters
        self._pending = 0  # transitions among the past
        self._look()

    def _look(self) -> None:
        filter_ = self._filter
        self.mean, self.covariance, self.transition = filter_.mean, filter_.covariance, filter_.transition

    @property
    def count(self) -> int:
        """Transitions so far: the present state is that after as many."""
        return self._recorded + self._pending

    def predict(self, F: FloatArray | Transition, Q: FloatArray) -> None:
        """As ``Filter.predict``."""
        mean, covariance = self.mean, self.covariance
        self._filter.predict(F, Q)
        self._look()
        noise = added_noise(covariance, self.transition, self.covariance, Q)
        self._keep(_Past(mean, covariance, _Step(self.transition, self.mean, noise)))

    def update(self, z: FloatArray, H: FloatArray | Observation, R: FloatArray) -> Innovation:
        """As ``Filter.update``."""
        past = _Past(self.mean, self.covariance, None)
        innovation = self._filter.update(z, H, R)
        self._look()
        self._keep(past)
        return innovation

    def reset(self, mean: FloatArray, covariance: FloatArray) -> None:
        """As ``Filter.reset``."""
        before = _State(self.mean, self.covariance)
        is_beginning = not self.count and not self._past
        is_back = self._take_back(mean, covariance)
        self._filter.reset(mean, covariance)
        self._look()
        if is_beginning or is_back:
            return
        F, Q = transition_of_reset(before.covariance, self.covariance)
        self._keep(_Past(before.mean, before.covariance, _Step(F, self.mean, Q)))

    def _take_back(self, mean: FloatArray, covariance: FloatArray) -> bool:
        """Forget everything after the state with these arrays, where the filter has been in it."""
        if mean is self.mean and covariance is self.covariance:
            return True
        past = self._past
        for k in range(len(past) - 1, -1, -1):
            if past[k].mean is mean and past[k].covariance is covariance:
                while len(past) > k:
                    self._pending -= past.pop().step is not None
                return True
        return False

    def _keep(self, past: _Past) -> None:
        self._past.append(past)
        self._pending += past.step is not None
        if len(self._past) > REACH:
            self._settle()

    def _settle(self) -> None:
        """Hand the oldest call to the smoother."""
        mean, covariance, step = self._past.popleft()
        if step is None:
            return
        self._pending -= 1
        if self._recorded % CHAPTER == 0:
            self._chapters.append(Smoother(mean.size))
        self._chapters[-1].record(mean, covariance, *step)
        self._recorded += 1

    def smooth(self) -> SmoothedPoses:
        """The first three states after 0, 1, ... ``count`` transitions, given everything.

        Nothing can be taken back afterwards.

        Raises:
            FilterDiverged: a smoothed state is not finite.
        """
        while self._past:
            self._settle()
        n = self._recorded
        means, covariances = np.empty((n + 1, 3)), np.empty((n + 1, 3, 3))
        end = _State(self.mean, self.covariance)
        means[n], covariances[n] = end.mean[:3], end.covariance[:3, :3]
        for number in range(len(self._chapters) - 1, -1, -1):
            chapter, first = self._chapters[number], number * CHAPTER
            found = chapter.smooth(cast(Filter, end))  # of which it reads the mean and the covariance
            last = first + len(chapter)
            means[first:last], covariances[first:last] = found.means[:-1, :3], found.covariances[:-1, :3, :3]
            end = _State(found.means[0], found.covariances[0])
        return SmoothedPoses(means, covariances)


def added_noise(P: FloatArray, F: FloatArray, predicted: FloatArray, Q: FloatArray) -> FloatArray:
    """Q of ``P' = F P F^T + Q`` where F is a regression and the given Q only part of what the prediction added.

    Args:
        P: covariance before a prediction, shape (n, n).
        F: its transition, shape (n, n).
        predicted: P' after it, shape (n, n).
        Q: the noise that it was given, shape (n, n).
    """
    excess = predicted - F.dot(P).dot(F.T) - Q
    sigma = np.sqrt(np.maximum(predicted.diagonal(), 0.0))
    # Rounding is left out, so that a state without noise stays one.
    is_rounding = bool((np.abs(excess) <= ROUNDING * np.outer(sigma, sigma)).all())
    return Q if is_rounding else Q + excess


def transition_of_reset(before: FloatArray, after: FloatArray) -> tuple[FloatArray, FloatArray]:
    """F and Q (n, n) of a reset, from the covariances (n, n) around it.

    States whose variance changed are drawn anew (their rows of F are zero), the others keep what was known of them; a
    change of the mean alone shifts the state. That holds where the reset left the covariance of the others as it was
    and cut them from those that it drew; otherwise nothing before it says anything of what came after.
    """
    rounding = ROUNDING * np.sqrt(np.outer(after.diagonal(), after.diagonal()).clip(0.0))
    has_changed = np.abs(after - before) > rounding
    is_drawn = has_changed.diagonal()
    drawn, kept = np.flatnonzero(is_drawn), np.flatnonzero(~is_drawn)
    if has_changed[np.ix_(kept, kept)].any() or after[np.ix_(drawn, kept)].any():
        return np.zeros_like(after), after.copy()
    F, Q = np.diag((~is_drawn).astype(np.float64)), np.zeros_like(after)
    Q[np.ix_(drawn, drawn)] = after[np.ix_(drawn, drawn)]
    return F, Q
