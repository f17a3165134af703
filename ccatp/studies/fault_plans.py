"""Pure. Random plans of faults that pass by: sensors, frames, clock, wheels, at random times of a mission."""

import random

from ccatp.sim.faults.models import SENSOR_SIGNALS
from ccatp.sim.faults.plan import FaultPlan, parse_plan

LONGEST_S = 2.0
FIRST_S = 3.0  # not before the sensors have said anything


class NoFrames(RuntimeError):
    """The robot fell silent for good, which no plan of passing faults does."""


def random_plan(seed: int, count: int, last_s: float) -> FaultPlan:
    """A function of its arguments alone.

    Args:
        seed: of the plan.
        count: how many faults.
        last_s: robot time by which all have begun; each lasts at most ``LONGEST_S``.
    """
    rng = random.Random(f"plan {seed}")
    texts = []
    for _ in range(count):
        signal, kind, keys = _draw(rng)
        at_s, for_s = rng.uniform(FIRST_S, last_s), rng.uniform(0.05, LONGEST_S)
        texts.append(
            f'[[fault]]\nsignal = "{signal}"\ntype = "{kind}"\nat_s = {at_s:.3f}\nfor_s = {for_s:.3f}\n{keys}\n'
        )
    return parse_plan("".join(texts), f"plan {seed}")


def _draw(rng: random.Random) -> tuple[str, str, str]:
    """Signal, type and keys of a fault."""
    if rng.random() < 0.25:
        return rng.choice(
            [
                ("frames", "drop", f"every = {rng.randint(1, 4)}"),
                ("frames", "reorder", f"every = {rng.randint(2, 5)}"),
                ("frames", "duplicate", "every = 2"),
                ("clock", "jump", f"by_s = {rng.uniform(-0.5, 0.5):.3f}"),
                ("body", "slip", f"factor = {rng.uniform(0.2, 1.0):.3f}"),
                ("right_wheel", "blocked", ""),
                ("left_wheel", "blocked", ""),
                ("faults", "raise", 'names = ["imu", "edge"]'),
            ]
        )
    signal = rng.choice(SENSOR_SIGNALS)
    kind, keys = rng.choice(
        [
            ("off", ""),
            ("stuck", ""),
            ("garbage", f"beyond = {rng.choice((0.0, 0.3))}"),
            ("wrong", f"factor = {rng.uniform(0.5, 1.5):.3f}"),
            ("slow", f"every = {rng.randint(2, 20)}"),
            ("delayed", f'by_s = {rng.uniform(0.02, 0.5):.3f}\nstamps = "{rng.choice(("old", "fresh"))}"'),
            ("intermittent", f"period_s = {rng.uniform(0.01, 0.3):.3f}\nduty = 0.5"),
            ("saturated", "low = -0.1\nhigh = 0.1" if not signal.startswith("edge") else "high = 0.0"),
            ("non_finite", 'token = "NaN"'),
        ]
    )
    return signal, kind, keys
