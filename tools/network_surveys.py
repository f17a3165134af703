"""Whole simulated surveys with known errors of the laser network: is what ``ccatp align`` says of it true?

``python -m tools.network_surveys [--only N ...] [--seed S] [--panels P]``. The robot drives each survey
(``ccatp.simulate``); mirrors, worlds and kinds of error take turns. In every survey each effect has an error as its
prior says. All but the surveys without a change have a larger one besides, by a fault plan from the first length or
from a point in the survey on. Prints a table in Markdown.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from ccatp.analysis.simulation import simulate
from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import FloatArray, Measured, PanelId, Vector3
from ccatp.mirror.mirror import build_mirror
from ccatp.mirror.mirror_alignment import align_survey, compare, survey_result
from ccatp.mirror.network_model import Effect, EffectKind, equal_effects
from ccatp.mirror.network_points import CalibratedSurveys
from ccatp.report.network import sentence

MIRRORS = ("fyst-m2", "fyst-m1")
WORLDS = ("thesis", "hard", "extreme")
KINDS = (
    "none", "offset", "offset from a point on", "scale", "drift", "moved", "moved from a point on", "noise",
    "offset and moved", "scale and noise",
)  # fmt: skip
_INTERVAL = 1.959964  # sigmas of a 95 % interval
_HOUR_S = 3600.0
_EVER_S = 1e6
_FIRST_S, _LAST_S = 600.0, 2400.0  # a change in a survey begins between


class Change(NamedTuple):
    """An injected change: the value of an effect from ``at_s`` on, s of robot time."""

    effect: Effect
    at_s: float
    value: FloatArray


class Drawn(NamedTuple):
    """A survey as drawn: errors as of the priors by effect, changes beyond them, noise by the configured one."""

    mirror: str
    world: str
    seed: int
    kind: str
    usual: dict[Effect, FloatArray]
    changes: tuple[Change, ...]
    noise: float


class Surveyed(NamedTuple):
    """What the robot measured, and the misalignment of each panel."""

    drawn: Drawn
    cfg: Config
    measured: tuple[Measured, ...]
    injected: dict[PanelId, Vector3]
    seconds: float


class Outcome(NamedTuple):
    """What came of one survey; pistons in m, rms over the panels."""

    drawn: Drawn
    panels: int
    planned: int
    before_m: float
    after_m: float
    stated_m: float
    chi2: float
    dof: int
    agrees: bool
    covered: dict[str, tuple[int, int]]
    said: str
    found: int
    false: int
    missed: int


def draw(number: int, seed: int) -> Drawn:
    """One survey of the campaign."""
    rng = np.random.default_rng([seed, number])
    mirror, world = MIRRORS[number % len(MIRRORS)], WORLDS[number % len(WORLDS)]
    kind = KINDS[number // len(MIRRORS) % len(KINDS)]
    cfg = load_config(None, {"run.mirror": mirror})
    sigma = {
        EffectKind.OFFSET: cfg.etalon.offset_sigma_m,
        EffectKind.COLLIMATOR: cfg.etalon.collimator_sigma_m,
        EffectKind.SCALE: cfg.etalon.refraction_sigma,
        EffectKind.DRIFT: cfg.align.network.drift_sigma_per_h,
    }
    channels = len(build_mirror(cfg.mirror).channels)
    usual = {one: sigma[one.kind] * rng.normal(size=one.size) for one in equal_effects(channels, 1)}
    at_s = float(rng.uniform(_FIRST_S, _LAST_S)) if "from a point on" in kind else 0.0
    first, second = (int(one) for one in rng.permutation(channels)[:2])
    sign, changes = float(rng.choice([-1.0, 1.0])), list[Change]()
    if "offset" in kind:
        changes.append(Change(Effect(EffectKind.OFFSET, first), at_s, np.array([sign * rng.uniform(5e-5, 1e-3)])))
    if "moved" in kind:
        direction = rng.normal(size=3)
        move = rng.uniform(1e-4, 2e-3) * direction / np.linalg.norm(direction)
        changes.append(Change(Effect(EffectKind.COLLIMATOR, second), at_s, move))
    if "scale" in kind:
        changes.append(Change(Effect(EffectKind.SCALE, 0), 0.0, np.array([sign * rng.uniform(1.5e-6, 5e-6)])))
    if "drift" in kind:
        changes.append(Change(Effect(EffectKind.DRIFT, 0), 0.0, np.array([sign * rng.uniform(1e-6, 4e-6)])))
    noise = float(rng.uniform(1.5, 3.0)) if "noise" in kind else 1.0
    return Drawn(mirror, world, 700 + number, kind, usual, tuple(changes), noise)


def _plan(drawn: Drawn, channels: Sequence[int]) -> str:
    """The fault plan of the errors."""
    faults = list[str]()
    for effect, at_s, value in [*((effect, 0.0, value) for effect, value in drawn.usual.items()), *drawn.changes]:
        numbers = [float(one) for one in value]
        keys = {
            EffectKind.OFFSET: f'type = "offset"\noffset_m = {numbers[0]!r}',
            EffectKind.COLLIMATOR: f'type = "moved"\nby_m = {numbers!r}',
            EffectKind.SCALE: f'type = "scaled"\nfactor = {1.0 + numbers[0]!r}',
            EffectKind.DRIFT: f'type = "scale_drift"\nrate_1_s = {numbers[0] / _HOUR_S!r}',
        }[effect.kind]
        of = f"channel = {channels[effect.of]}\n" if effect.is_of_channel else ""
        faults.append(f'[[fault]]\nsignal = "laser"\nat_s = {at_s}\nfor_s = {_EVER_S}\n{of}{keys}\n')
    if drawn.noise != 1.0:
        faults.append(
            f'[[fault]]\nsignal = "laser"\nat_s = 0.0\nfor_s = {_EVER_S}\ntype = "noisy"\nfactor = {drawn.noise}\n'
        )
    return "\n".join(faults)


def survey(drawn: Drawn, panels: int = 0) -> Surveyed:
    """Let the robot drive it; ``panels``: of the mirror, 0 for all."""
    started = time.perf_counter()
    cfg = load_config(None, {"run.mirror": drawn.mirror})
    with TemporaryDirectory() as folder:
        path = Path(folder) / "network.toml"
        path.write_text(_plan(drawn, build_mirror(cfg.mirror).channels), encoding="utf-8")
        run = simulate(
            mirror=drawn.mirror, world=drawn.world, seed=drawn.seed, panels=panels, faults=path, keep_samples=False
        )
    record = run.findings.record
    return Surveyed(
        drawn, record.cfg, tuple(record.measured), dict(record.injected or {}), time.perf_counter() - started
    )


def judge(found: Surveyed) -> Outcome:
    """Align the survey, and compare with what was drawn."""
    cfg, drawn, mirror = found.cfg, found.drawn, build_mirror(found.cfg.mirror)
    planned = {one.point.panel for one in found.measured}
    height_m = cfg.robot.puck_height_m
    recorded = survey_result(mirror, cfg.align, height_m, found.measured, planned)
    aligned = align_survey(cfg, mirror, found.measured, planned)
    before, after = (compare(one.panels, found.injected) for one in (recorded, aligned.result))
    network = aligned.network
    if before is None or after is None or network is None:
        raise SystemExit(f"survey of seed {drawn.seed}: no panel was measured")
    panels = aligned.result.panels
    errors = np.array([one.fit.values - np.array(found.injected[one.panel]) for one in panels])
    sigmas = np.array([one.fit.sigma for one in panels])
    covered = _coverage(found, network)
    covered["panel"] = int(np.sum(np.abs(errors) <= _INTERVAL * sigmas)), errors.size
    true = {one.effect for one in drawn.changes}
    # A drift is also a scale in the middle of the survey.
    may = true | {Effect(EffectKind.SCALE, 0) for one in true if one.kind is EffectKind.DRIFT}
    named = [(one.effect, *one.alternatives) for one in network.network.findings]
    certain = [some[0] for some in named if len(some) == 1]
    found_effects = {one._replace(since=0) for some in named for one in some}
    return Outcome(
        drawn=drawn,
        panels=len(panels),
        planned=len(planned),
        before_m=before.piston_rms_m,
        after_m=after.piston_rms_m,
        stated_m=float(np.sqrt(np.mean(sigmas[:, 0] ** 2))),
        chi2=after.chi2,
        dof=after.dof,
        agrees=after.agrees,
        covered=covered,
        said=sentence(network),
        found=len(certain),
        false=sum(not _is_true(one, drawn, may, network) for one in certain),
        missed=len(true - found_effects),
    )


def _is_true(effect: Effect, drawn: Drawn, may: set[Effect], network: CalibratedSurveys) -> bool:
    """Whether the named effect was injected, with its size within four sigmas, and at its time within a few points."""
    base = effect._replace(since=0)
    if base not in may:
        return False
    begins = max((one.at_s for one in drawn.changes if one.effect == base), default=0.0)
    times = np.array([t_s for _, t_s in network.points])
    first = int(np.searchsorted(times, begins))
    return abs(effect.since - first) <= 10


def _coverage(found: Surveyed, network: CalibratedSurveys) -> dict[str, tuple[int, int]]:
    """By kind: values inside their 95 % interval, and all of them. Values at the first point; a scale in the middle."""
    adjusted, drawn = network.network.adjustment, found.drawn
    total = {effect: value.copy() for effect, value in drawn.usual.items()}
    for effect, at_s, value in drawn.changes:
        if at_s == 0.0:
            total[effect] += value
    times = [t_s for _, t_s in network.points]
    middle_h = 0.5 * (times[0] + times[-1]) / _HOUR_S
    scale, drift = Effect(EffectKind.SCALE, 0), Effect(EffectKind.DRIFT, 0)
    total[scale] = total[scale] + total[drift] * middle_h
    covered: dict[str, tuple[int, int]] = {}
    for effect, value in total.items():
        sigma = np.sqrt(np.diag(adjusted.covariance_of(effect)))
        inside, of = covered.get(effect.kind.value, (0, 0))
        hits = int(np.sum(np.abs(adjusted.of(effect) - value) <= _INTERVAL * sigma))
        covered[effect.kind.value] = inside + hits, of + effect.size
    return covered


def _injected_text(drawn: Drawn, channels: Sequence[int]) -> str:
    texts = list[str]()
    for effect, at_s, value in drawn.changes:
        name = f"{effect.kind} {channels[effect.of]}" if effect.is_of_channel else effect.kind.value
        size = 1e6 * float(np.linalg.norm(value) if effect.size > 1 else value[0])
        unit = "um" if effect.is_of_channel else ("ppm/h" if effect.kind is EffectKind.DRIFT else "ppm")
        since = f" from {at_s:.0f} s on" if at_s else ""
        texts.append(f"{name} {size:+.1f} {unit}{since}" if effect.is_of_channel else f"{name} {size:+.2f} {unit}")
    if drawn.noise != 1.0:
        texts.append(f"noise {drawn.noise:.2f}")
    return ", ".join(texts) or "nothing"


def rows(outcomes: Sequence[Outcome]) -> list[str]:
    """The table, a line for each survey."""
    found = [
        "| mirror, world | injected | pistons, um rms: before, after (stated) | chi-square of panels | said |",
        "|---|---|---|---|---|",
    ]
    for one in outcomes:
        channels = build_mirror(load_config(None, {"run.mirror": one.drawn.mirror}).mirror).channels
        band = "" if one.agrees else ", outside its band"
        found.append(
            f"| `{one.drawn.mirror}`, `{one.drawn.world}`, {one.panels} panels | {_injected_text(one.drawn, channels)} "
            f"| {1e6 * one.before_m:.2f}, {1e6 * one.after_m:.2f} ({1e6 * one.stated_m:.2f}) "
            f"| {one.chi2:.0f} of {one.dof}{band} | {one.said} |"
        )
    return found


def totals(outcomes: Sequence[Outcome]) -> list[str]:
    """All surveys in a few lines."""
    parts = []
    for kind in outcomes[0].covered:
        hits, of = (sum(one.covered[kind][k] for one in outcomes) for k in (0, 1))
        parts.append(f"{kind} {100.0 * hits / of:.1f} % of {of}")
    chi2, dof = sum(one.chi2 for one in outcomes), sum(one.dof for one in outcomes)
    return [
        f"{len(outcomes)} surveys, {sum(one.panels for one in outcomes)} panels; chi-square of the panels by its "
        f"degrees of freedom {chi2 / dof:.3f}, {sum(one.agrees for one in outcomes)} in their 99 % bands",
        f"95 % intervals hold: {', '.join(parts)}",
        f"{sum(len(one.drawn.changes) for one in outcomes)} changes injected, {sum(one.found for one in outcomes)} "
        f"found, {sum(one.missed for one in outcomes)} not named, {sum(one.false for one in outcomes)} false",
    ]


def main() -> None:
    """Run the campaign, and print its result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--only", type=int, nargs="+", default=range(2 * len(KINDS)), help="numbers of surveys")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--panels", type=int, default=0)
    args = parser.parse_args()
    outcomes = list[Outcome]()
    for number in args.only:
        outcomes.append(judge(survey(draw(number, args.seed), args.panels)))
        print("\n".join(rows(outcomes[-1:])[0 if len(outcomes) == 1 else -1 :]), flush=True)
    print("\n".join(["", *totals(outcomes)]))


if __name__ == "__main__":
    main()
