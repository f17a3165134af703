"""Synthetic laser networks with known errors: does the self-calibration find them, and do its intervals hold?

Only lengths are simulated, no robot:
``python -m tools.network_campaign [--networks N] [--seed S] [--mirror NAME] [--kind KIND]``.
Each network has errors as its priors say, and larger ones with some probability: offsets of channels up to 1 mm,
collimators moved by up to 2 mm, a scale up to 5 ppm, a drift up to 2 ppm per hour, noise up to three times the
configured one. The panels are misaligned, too. One network in five has no error beyond its priors. ``--kind`` adds an
error to every network: one channel with 3 to 10 times the noise of the others, or a scale that oscillates with 1 to
3 ppm and a period of 5 to 30 minutes.
"""

import argparse
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from enum import StrEnum
from functools import cache
from itertools import repeat
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import DeckPose, FloatArray, PanelId
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.mirror.misalignment import PanelMisalignment, misaligned_puck_world
from ccatp.mirror.network_adjustment import NetworkResult, NetworkState, calibrate
from ccatp.mirror.network_model import Effect, EffectKind, SurveyLengths, adjust, equal_effects
from ccatp.mirror.panel_modes import rigid

MIRRORS = ("thesis-m1", "fyst-m1", "fyst-m2", "thesis-m2")


class Kind(StrEnum):
    """What every network has besides the errors that are drawn for each."""

    USUAL = "usual"  # nothing
    NOISY_CHANNEL = "noisy channel"
    OSCILLATING_SCALE = "oscillating scale"


_SHARE = 0.2  # of channels with an offset, and of moved collimators
_LARGEST = {EffectKind.OFFSET: 1e-3, EffectKind.COLLIMATOR: 2e-3, EffectKind.SCALE: 5e-6, EffectKind.DRIFT: 2e-6}
_SCALE, _DRIFT, _VARIATION = (Effect(one, 0) for one in (EffectKind.SCALE, EffectKind.DRIFT, EffectKind.VARIATION))
_TIMES = 20  # of a survey, at which its scale is compared
_INTERVAL = 1.959964  # sigmas of a 95 % interval


class Places(NamedTuple):
    """The points of a mirror: pucks on panels that lie as drawn, normals, and the fit of each panel's plane."""

    mirror: Mirror
    nominal_m: FloatArray
    panels: tuple[PanelId, ...]
    normals: FloatArray
    fits: FloatArray  # (panels, 3, points of a panel): piston, tip and tilt from deviations


class Truth(NamedTuple):
    """A drawn network: the true points, its lengths, the value of each effect, and which of them were injected.

    ``noise``: over the configured one; ``channel_noise`` (m,): of each channel over that. ``scale`` (k,).
    """

    points_m: FloatArray
    given: SurveyLengths
    values: dict[Effect, FloatArray]
    injected: frozenset[Effect]
    noise: float
    channel_noise: FloatArray
    scale: FloatArray


class Outcome(NamedTuple):
    """What came of one network."""

    state: NetworkState
    seconds: float
    before_m: float
    after_m: float
    sigma_m: float
    chi2: float
    dof: int
    panel_chi2: float
    panel_dof: int
    covered: dict[str, tuple[int, int]]
    false_findings: int
    undecided: int
    left_out: int
    has_frame: bool
    missed: int
    injected: int
    names_the_kind: bool


def places_of(cfg: Config) -> Places:
    """The measurement points of the whole mirror."""
    mirror = build_mirror(cfg.mirror)
    height_m, nominal, normals, fits = cfg.robot.puck_height_m, [], [], []
    for panel, body in mirror.panels.items():
        places = []
        for point in mirror.point_ids(panel):
            x, y = mirror.point_on_deck(point)
            nominal.append(mirror.puck_world(DeckPose(x, y, 0.0), height_m))
            normals.append(mirror.rotate_world_from_deck(mirror.surface.normal(x, y)))
            places.append(body.from_deck(mirror.surface.point(x, y))[:2])
        fits.append(np.linalg.pinv(rigid(np.array(places))))
    return Places(mirror, np.array(nominal), tuple(mirror.panels), np.array(normals), np.array(fits))


def _pucks(cfg: Config, places: Places, rng: np.random.Generator) -> FloatArray:
    """Where the puck stands: some mm beside each point, on panels that do not lie as they should."""
    mirror, found = places.mirror, []
    for panel in places.panels:
        piston_m = float(rng.normal()) * cfg.sim.truth.piston_sigma_m
        tip, tilt = (rng.normal(size=2) * cfg.sim.truth.tilt_sigma_rad).tolist()
        lies = PanelMisalignment(piston_m, tip, tilt)
        for point in mirror.point_ids(panel):
            x, y = mirror.point_on_deck(point)
            dx, dy = (rng.normal(size=2) * 3e-3).tolist()
            pose = DeckPose(x + dx, y + dy, 0.0)
            found.append(misaligned_puck_world(mirror, panel, lies, pose, cfg.robot.puck_height_m))
    return np.array(found)


def draw(cfg: Config, places: Places, rng: np.random.Generator, kind: Kind = Kind.USUAL) -> Truth:
    """One network with its survey of an hour."""
    collimators = np.array(places.mirror.collimators_m)
    effects = equal_effects(len(collimators), 1)
    usual = {
        EffectKind.OFFSET: cfg.etalon.offset_sigma_m,
        EffectKind.COLLIMATOR: cfg.etalon.collimator_sigma_m,
        EffectKind.SCALE: cfg.etalon.refraction_sigma,
        EffectKind.DRIFT: cfg.align.network.drift_sigma_per_h,
    }
    is_quiet = rng.random() < 0.2
    values, injected = {}, set()
    for effect in effects:
        value = rng.normal(size=effect.size) * usual[effect.kind]
        if not is_quiet and rng.random() < (_SHARE if effect.is_of_channel else 0.5):
            direction = rng.normal(size=effect.size)
            value += rng.uniform(0.0, _LARGEST[effect.kind]) * direction / np.linalg.norm(direction)
            injected.add(effect)
        values[effect] = value
    noise = 1.0 if rng.random() < 0.5 else float(rng.uniform(1.0, 3.0))
    pucks = _pucks(cfg, places, rng)
    moved = collimators + np.array([values[one] for one in effects if one.kind is EffectKind.COLLIMATOR])
    offsets = np.array([values[one][0] for one in effects if one.kind is EffectKind.OFFSET])
    hours = np.linspace(-0.5, 0.5, len(pucks))
    scale = values[Effect(EffectKind.SCALE, 0)] + values[Effect(EffectKind.DRIFT, 0)] * hours
    distances = np.linalg.norm(pucks[:, None] - moved, axis=2)
    sigmas = cfg.etalon.length_sigma_m + cfg.etalon.length_sigma_per_m * distances
    errors, channel_noise = noise * sigmas * rng.normal(size=distances.shape), np.ones(len(collimators))
    match kind:
        case Kind.NOISY_CHANNEL:
            channel_noise[rng.integers(len(collimators))] = rng.uniform(3.0, 10.0)
            errors *= channel_noise
        case Kind.OSCILLATING_SCALE:
            period_h, phase = rng.uniform(5.0, 30.0) / 60.0, rng.uniform(0.0, 2.0 * np.pi)
            scale += rng.uniform(1e-6, 3e-6) * np.cos(2.0 * np.pi * hours / period_h + phase)
            # The line that fits it best is a scale and a drift.
            injected |= {_SCALE, _DRIFT, _VARIATION}
    lengths = distances * (1.0 + scale[:, None]) + offsets + errors
    survey = np.zeros(len(pucks), dtype=np.int64)
    given = SurveyLengths(lengths, sigmas, collimators, places.nominal_m, hours, survey)
    return Truth(pucks, given, values, frozenset(injected), noise, channel_noise, scale)


def judge(cfg: Config, places: Places, truth: Truth) -> Outcome:
    """Calibrate a network, and compare with the truth."""
    started = time.process_time()
    result = calibrate(truth.given, cfg.etalon, cfg.align.network, cfg.align.false_alarm)
    seconds = time.process_time() - started
    exact = {one: 1e-9 if one.is_of_channel else 1e-12 for one in truth.values}
    before = _panels(places, adjust(truth.given, exact).points_m - truth.points_m)
    errors = _panels(places, result.adjustment.points_m - truth.points_m)
    covariance = _panel_covariance(places, result)
    sigmas = np.sqrt(np.diag(covariance))
    flat = errors.ravel()
    found = {one.effect for one in result.findings if not one.alternatives}
    named = found | {other for one in result.findings for other in (one.effect, *one.alternatives)}
    same = {(one.kind, one.of) for one in truth.injected}
    may_begin = {EffectKind.SCALE} if _VARIATION in truth.injected else set()
    is_noisy = truth.channel_noise > 1.0
    is_named = result.channel_noise > result.noise
    covered = _coverage(truth, result)
    # A point that is left out determines nothing of its panel.
    is_whole = np.repeat(~result.bad_points.reshape(len(places.panels), -1).any(axis=1), 3)
    flat, sigmas, covariance = flat[is_whole], sigmas[is_whole], covariance[np.ix_(is_whole, is_whole)]
    covered["panel"] = int(np.sum(np.abs(flat) <= _INTERVAL * sigmas)), len(flat)
    return Outcome(
        state=result.state,
        seconds=seconds,
        before_m=float(np.sqrt(np.mean(before[:, 0] ** 2))),
        after_m=float(np.sqrt(np.mean(flat[::3] ** 2))),
        sigma_m=float(np.sqrt(np.mean(sigmas[::3] ** 2))),
        chi2=result.chi2 / truth.noise**2,
        dof=result.dof,
        panel_chi2=float(flat @ np.linalg.solve(covariance, flat)),
        panel_dof=len(flat),
        covered=covered,
        false_findings=int(np.sum(is_named & ~is_noisy))
        + sum((one.kind, one.of) not in same or (one.since > 0 and one.kind not in may_begin) for one in found),
        undecided=sum(bool(one.alternatives) for one in result.findings),
        left_out=int(result.bad_lengths.sum() + result.bad_points.sum()),
        has_frame=result.has_frame,
        missed=(len(same - {(one.kind, one.of) for one in named}) if result.has_frame else 0)
        + int(np.sum(is_noisy & ~is_named)),
        injected=len(same) + int(is_noisy.sum()),
        names_the_kind=bool(is_named[is_noisy].all())
        and (_VARIATION not in truth.injected or any(one.kind is EffectKind.VARIATION for one in named)),
    )


def _panels(places: Places, errors_m: FloatArray) -> FloatArray:
    """Errors of piston, tip and tilt of each panel, (panels, 3)."""
    along = np.sum(errors_m * places.normals, axis=1).reshape(len(places.panels), -1)
    return np.asarray((places.fits @ along[..., None])[..., 0])


def _panel_covariance(places: Places, result: NetworkResult) -> FloatArray:
    """Covariance of all panels by noise and network, (3 panels, 3 panels)."""
    adjusted, normals = result.adjustment, places.normals
    variances = np.einsum("ka,kab,kb->k", normals, adjusted.noise_m2, normals).reshape(len(places.panels), -1)
    moves = (normals[:, None, :] @ adjusted.moves)[:, 0].reshape(len(places.panels), places.fits.shape[2], -1)
    network = (places.fits @ moves).reshape(-1, moves.shape[-1])
    found = network @ adjusted.covariance @ network.T
    for number, (fit, variance) in enumerate(zip(places.fits, variances, strict=True)):
        part = slice(3 * number, 3 * number + 3)
        found[part, part] += (fit * variance) @ fit.T
    return np.asarray(found)


def _coverage(truth: Truth, result: NetworkResult) -> dict[str, tuple[int, int]]:
    """By kind: values inside their 95 % interval, and all of them; scale and drift of the line that fits it best."""
    adjusted, covered = result.adjustment, dict[str, tuple[int, int]]()
    for effect, value in truth.values.items():
        if effect.is_of_channel:
            sigma = np.sqrt(np.diag(adjusted.covariance_of(effect)))
            inside, of = covered.get(effect.kind.value, (0, 0))
            hits = int(np.sum(np.abs(adjusted.of(effect) - value) <= _INTERVAL * sigma))
            covered[effect.kind.value] = inside + hits, of + effect.size
    hours = truth.given.hours
    line = np.linalg.pinv(np.column_stack([np.ones_like(hours), hours]))
    parts = {EffectKind.SCALE: line[:1], EffectKind.DRIFT: line[1:]}
    if _VARIATION in truth.injected:
        parts[EffectKind.VARIATION] = np.eye(len(hours))[:: len(hours) // _TIMES]
    for kind, part in parts.items():
        design = part @ adjusted.scale_design
        sigma = np.sqrt(np.sum((design @ adjusted.covariance) * design, axis=1))
        errors = design @ adjusted.values - part @ truth.scale
        covered[kind.value] = int(np.sum(np.abs(errors) <= _INTERVAL * sigma)), len(part)
    return covered


def one_network(name: str, seed: int, number: int, kind: Kind = Kind.USUAL) -> Outcome:
    """The outcome of one network, which has a random generator of its own."""
    cfg, places = _world(name)
    return judge(cfg, places, draw(cfg, places, np.random.default_rng([seed, number]), kind))


@cache
def _world(name: str) -> tuple[Config, Places]:
    cfg = load_config(None, {"run.mirror": name})
    return cfg, places_of(cfg)


def campaign(
    networks: int, seed: int, mirrors: Sequence[str] = MIRRORS, kind: Kind = Kind.USUAL, workers: int = 0
) -> list[tuple[str, Outcome]]:
    """Outcomes of networks on each mirror in turn; in this process without ``workers``."""
    names = [mirrors[number % len(mirrors)] for number in range(networks)]
    which = names, repeat(seed), range(networks), repeat(kind)
    if not workers:
        return list(zip(names, map(one_network, *which), strict=True))
    with ProcessPoolExecutor(workers) as pool:
        return list(zip(names, pool.map(one_network, *which), strict=True))


def lines(outcomes: Sequence[tuple[str, Outcome]]) -> list[str]:
    """The result in a few lines."""
    found = [one for _, one in outcomes]
    before, after, sigma = (
        1e6 * float(np.sqrt(np.mean([getattr(one, name) ** 2 for one in found])))
        for name in ("before_m", "after_m", "sigma_m")
    )
    median = [1e6 * float(np.median([getattr(one, name) for one in found])) for name in ("before_m", "after_m")]
    ratio = sum(one.chi2 for one in found) / sum(one.dof for one in found)
    chi2, dof = sum(one.panel_chi2 for one in found), sum(one.panel_dof for one in found)
    low, high = (float(chdtri(dof, chance)) / dof for chance in (0.995, 0.005))
    false = sum(one.false_findings > 0 for one in found)
    kinds = [*(kind.value for kind in EffectKind), "panel"]
    shares = []
    for kind in kinds:
        hits, of = (sum(one.covered.get(kind, (0, 0))[k] for one in found) for k in (0, 1))
        if of:
            shares.append(f"{kind} {100.0 * hits / of:.1f} % of {of}")
    seconds = [one.seconds for one in found]
    injected, missed = sum(one.injected for one in found), sum(one.missed for one in found)
    return [
        f"{len(found)} networks; error of the pistons, rms of all / median network: before {before:.1f} / "
        f"{median[0]:.1f} um, after {after:.2f} / {median[1]:.2f} um, stated {sigma:.2f} um",
        f"chi-square by degrees of freedom: lengths {ratio:.3f}, panels {chi2 / dof:.3f} "
        f"(99 % band {low:.3f} to {high:.3f})",
        f"95 % intervals hold: {', '.join(shares)}",
        f"networks with a false finding: {false} ({100.0 * false / len(found):.1f} %); of {injected} injected errors "
        f"{missed} not named, {sum(one.undecided for one in found)} findings undecided; "
        f"{sum(one.left_out for one in found)} lengths or points left out, "
        f"{sum(not one.has_frame for one in found)} networks without a frame; "
        f"the error of the kind is named in {sum(one.names_the_kind for one in found)} networks",
        f"CPU time of a network: {np.median(seconds):.2f} s in the median, {max(seconds):.2f} s at most",
    ]


def main() -> None:
    """Run the campaign, and print its result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--networks", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--mirror", action="append", choices=MIRRORS)
    parser.add_argument("--kind", choices=[kind.value for kind in Kind], default=Kind.USUAL.value)
    args = parser.parse_args()
    outcomes = campaign(args.networks, args.seed, tuple(args.mirror or MIRRORS), Kind(args.kind), args.workers)
    print("\n".join(lines(outcomes)))
    for name in dict.fromkeys(name for name, _ in outcomes):
        print(f"\n{name}")
        print("\n".join(lines([pair for pair in outcomes if pair[0] == name])))


if __name__ == "__main__":
    main()
