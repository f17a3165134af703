"""Pure. Zero-order Sugeno controller: trapezoid memberships, rules, and the weighted mean of what they say."""

from collections.abc import Mapping, Sequence
from itertools import pairwise, product

from ccatp.config.radio_models import FuzzyConfig

_Trapezoid = tuple[float, float, float, float]


class FuzzyGapError(ValueError):
    """No rule fires at a point: carries the inputs there."""

    def __init__(self, inputs: Mapping[str, float]) -> None:
        where = ", ".join(f"{name} = {value:g}" for name, value in inputs.items())
        super().__init__(f"no rule of the fuzzy controller fires at {where}; add a rule or widen a term")
        self.inputs = dict(inputs)


class Sugeno:
    """Output u = sum(w_i u_i) / sum(w_i), w_i the product of the memberships that rule i names (Takagi, Sugeno 1985).

    Memberships are trapezoids. Beyond its first and last shoulder an input counts as standing there, so a rule base
    without a gap between its corners has none anywhere.

    Args:
        cfg: inputs with their terms, outputs, rules.

    Raises:
        FuzzyGapError: a combination of corners, or a place halfway between two, where no rule fires.
    """

    def __init__(self, cfg: FuzzyConfig) -> None:
        self.inputs = tuple(cfg.inputs)
        self._terms = [tuple(given.terms.values()) for given in cfg.inputs.values()]
        names = [list(given.terms) for given in cfg.inputs.values()]
        self._spans = [(min(t[1] for t in terms), max(t[2] for t in terms)) for terms in self._terms]
        self._rules = [
            (
                tuple((i, names[i].index(rule.when[name])) for i, name in enumerate(self.inputs) if name in rule.when),
                cfg.outputs[rule.then],
            )
            for rule in cfg.rules
        ]
        self._check_gaps()

    def evaluate(self, values: Sequence[float]) -> float:
        """The output.

        Args:
            values: of the inputs, in the order of ``inputs``.

        Raises:
            FuzzyGapError: no rule fires.
        """
        grades = [
            [_grade(min(max(value, low), high), term) for term in terms]
            for value, (low, high), terms in zip(values, self._spans, self._terms, strict=True)
        ]
        total = weighted = 0.0
        for conditions, output in self._rules:
            weight = 1.0
            for i, k in conditions:
                weight *= grades[i][k]
            total += weight
            weighted += weight * output
        if total <= 0.0:
            raise FuzzyGapError(dict(zip(self.inputs, values, strict=True)))
        return weighted / total

    def memberships(self, index: int, value: float) -> list[float]:
        """Grades of a value in the terms of one input, in their order."""
        low, high = self._spans[index]
        return [_grade(min(max(value, low), high), term) for term in self._terms[index]]

    def _check_gaps(self) -> None:
        """Memberships are linear between corners: no rule is silent between two places that have one in common."""
        axes = []
        for (low, high), terms in zip(self._spans, self._terms, strict=True):
            corners = sorted({min(max(corner, low), high) for term in terms for corner in term})
            halves = [0.5 * (a + b) for a, b in pairwise(corners)]
            axes.append(sorted({*corners, *halves}))
        for values in product(*axes):
            self.evaluate(values)


def _grade(value: float, term: _Trapezoid) -> float:
    """Membership of a value in a trapezoid (left foot, left shoulder, right shoulder, right foot)."""
    left_foot, left_shoulder, right_shoulder, right_foot = term
    if left_shoulder <= value <= right_shoulder:
        return 1.0
    if value <= left_foot or value >= right_foot:
        return 0.0
    if value < left_shoulder:
        return (value - left_foot) / (left_shoulder - left_foot)
    return (right_foot - value) / (right_foot - right_shoulder)
