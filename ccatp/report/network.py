"""The laser network of a survey in words and as data: whether it is consistent, what changed, what is open."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from ccatp.core import FloatArray
from ccatp.mirror.network_adjustment import Finding, NetworkState
from ccatp.mirror.network_model import Effect, EffectKind
from ccatp.mirror.network_points import CalibratedSurveys

MICRO = 1e6
_MANY_CHANGES = 3  # of one channel, from which one line states them together
GAUGE = "a common motion of all collimators, which shows in no length"


def sentence(found: CalibratedSurveys | None) -> str:
    """Whether the network is consistent, in one sentence; without the lengths that it takes, that they are missing."""
    if found is None:
        return "The laser network is not checked: no lengths are recorded."
    network = found.network
    lengths = int(np.isfinite(network.given.lengths_m).sum())
    noise = _noise(found)
    if network.state is NetworkState.TOO_FEW:
        return f"The laser network is not checked: {len(found.points)} points with {lengths} lengths are too few."
    if network.state is NetworkState.CONSISTENT:
        is_noisy = network.is_noisy or bool(_noisy(found))
        return (
            f"The laser network is consistent{' within its noise' if is_noisy else ''}: {lengths} lengths, {noise}, "
            "no channel and no collimator has changed."
        )
    if not network.has_frame:
        return (
            "The laser network has changed, and keeps no frame of reference: fewer than three collimators agree with "
            "each other, so nothing says which of them moved; survey all collimators again; until then each point is "
            f"uncertain by {_share_um(found):.0f} um ({noise})."
        )
    changes = "; ".join(_changes(found))
    return f"The laser network has changed: {changes} ({noise}); the panels are computed with it."


def _noise(found: CalibratedSurveys) -> str:
    """The noise of the lengths, and that of channels which have more of it than the others."""
    network = found.network
    channels = [f"in channel {channel} {noise:.1f} times the configured one" for channel, noise in _noisy(found)]
    others = " of the other channels" if channels else ""
    size = f"{network.noise:.2f} times the configured one" if network.is_noisy else "as configured"
    return ", ".join([f"noise{others} {size}", *channels])


def _noisy(found: CalibratedSurveys) -> list[tuple[int, float]]:
    """Channels with a noise of their own, over the configured one."""
    network = found.network
    columns = np.flatnonzero(network.channel_noise > network.noise).tolist()
    return [(found.channels[column], float(network.channel_noise[column])) for column in columns]


def _share_um(found: CalibratedSurveys) -> float:
    """Standard deviation of a coordinate of a point by the network, rms over the points of the last survey, um."""
    errors = np.array([*found.surveys[-1].common.of_point.values()])
    return MICRO * float(np.sqrt(np.mean(np.sum(errors**2, axis=2)))) if len(errors) else 0.0


def remarks(found: CalibratedSurveys | None) -> list[str]:
    """What an operator has to do or to know about the network, one line each."""
    if found is None:
        return []
    network, lines = found.network, []
    if network.state is NetworkState.CHANGED:
        lines.append(sentence(found))
    bad = np.argwhere(network.bad_lengths)
    if len(bad):
        lines.append(
            f"single lengths that contradict all others are left out: {len(bad)} of "
            f"{int(np.isfinite(network.given.lengths_m).sum())}, channels {_numbers(found, bad[:, 1])}"
        )
    if network.is_noisy:
        lines.append(
            f"the lengths have {network.noise:.2f} times the configured noise (etalon.length_sigma_m); "
            "all standard deviations are larger in proportion"
        )
    lines += [
        f"the lengths of channel {channel} have {noise:.1f} times the configured noise, and count accordingly less: "
        "check its fibre, its beam and its collimator"
        for channel, noise in _noisy(found)
    ]
    without = sum(one.unchanged for one in found.surveys)
    if without:
        lines.append(f"{without} fixes have no lengths of this network: they are used as recorded")
    return lines


def undetermined_text(found: CalibratedSurveys | None) -> str:
    """What the lengths do not determine; empty if the network was not checked."""
    if found is None:
        return ""
    names = _joined(found, found.network.undetermined)
    return f"Not determined by these lengths: {names + ', and ' if names else ''}{GAUGE}."


def air_text(found: CalibratedSurveys | None) -> str:
    """Scale and drift by which the points are computed; empty if the network was not checked."""
    if found is None:
        return ""
    adjusted, parts = found.network.adjustment, []
    for effect in adjusted.slices:
        if effect.is_of_channel or effect.since or effect.kind is EffectKind.VARIATION:
            continue
        value, sigma = float(adjusted.of(effect)[0]), float(np.sqrt(adjusted.covariance_of(effect)[0, 0]))
        unit = "ppm" if effect.kind is EffectKind.SCALE else "ppm per hour"
        parts.append(f"{effect.kind}{_of_survey(found, effect)} {_ppm(value, sigma, '+')} {unit}")
    varied = {one.effect.of: one.effect for one in found.network.findings if one.effect.kind is EffectKind.VARIATION}
    for effect in varied.values():
        rms, sigma = _variation(found, effect.of)
        parts.append(f"a variation of the scale{_of_survey(found, effect)} of {_ppm(rms, sigma)} ppm rms")
    return f"The panels are computed with {', '.join(parts)}."


def network_lines(found: CalibratedSurveys | None) -> list[str]:
    """The network in the output of ``ccatp align``."""
    lines = "", sentence(found), air_text(found), undetermined_text(found)
    return [line for line in lines if line or found is not None]


def _changes(found: CalibratedSurveys) -> Iterator[str]:
    """Each finding; many changes of one channel together, which are the parts of one that is not in the model.

    So are the changes of a noisy channel, and the bands and steps of a scale that varies.
    """
    findings = found.network.findings
    noisy = {channel for channel, _ in _noisy(found)}
    varied = {one.effect.of for one in findings if one.effect.kind is EffectKind.VARIATION}

    def is_part(one: Effect) -> bool:
        """Of the variation of a scale."""
        is_step = one.kind is EffectKind.SCALE and one.since > 0
        return (is_step or one.kind is EffectKind.VARIATION) and one.of in varied

    stated = set[tuple[bool, int]]()
    for one in findings:
        effect = one.effect
        same = [
            other for other in findings if other.effect.of == effect.of
            and (other.effect.is_of_channel if effect.is_of_channel else is_part(other.effect))
        ]  # fmt: skip
        least = 2 if effect.is_of_channel and found.channels[effect.of] in noisy else _MANY_CHANGES
        if not (len(same) >= least if effect.is_of_channel else is_part(effect)):
            yield finding_text(found, one)
        elif (effect.is_of_channel, effect.of) not in stated:
            stated.add((effect.is_of_channel, effect.of))
            if effect.is_of_channel:
                size_um = MICRO * max(abs(other.size) for other in same)
                yield (
                    f"channel {found.channels[effect.of]} changes {len(same)} times, by up to {size_um:.1f} um: it "
                    "drifts or is noisy, or its collimator moves"
                )
            else:
                bands = [other.effect for other in same if other.effect.kind is EffectKind.VARIATION]
                others = {other for finding in same for other in finding.alternatives if not is_part(other)}
                yield _or_else(found, _variation_text(found, bands), sorted(others))


def _variation_text(found: CalibratedSurveys, bands: Sequence[Effect]) -> str:
    rms, _ = _variation(found, bands[0].of)
    shortest, longest = zip(*(_periods_min(found, one) for one in bands), strict=True)
    return (
        f"the scale of all lengths{_of_survey(found, bands[0])} varies about its drift by {MICRO * rms:.2f} ppm rms, "
        f"with periods of {min(shortest):.0f} to {max(longest):.0f} minutes"
    )


def _variation(found: CalibratedSurveys, survey: int) -> tuple[float, float]:
    """Scale of a survey about its drift, and its standard deviation, rms over the points."""
    given, adjusted = found.network.given, found.network.adjustment
    is_own = given.survey == survey
    hours = given.hours[is_own]
    line, _ = np.linalg.qr(np.column_stack([np.ones_like(hours), hours]))
    design = adjusted.scale_design[is_own]
    about = design - line @ (line.T @ design)
    variances = np.sum((about @ adjusted.covariance) * about, axis=1)
    return float(np.sqrt(np.mean((about @ adjusted.values) ** 2))), float(np.sqrt(np.mean(variances)))


def _periods_min(found: CalibratedSurveys, band: Effect) -> tuple[float, float]:
    """Shortest and longest period of a band, minutes."""
    given = found.network.given
    minutes = 60.0 * float(np.ptp(given.hours[given.survey == band.of]))
    return 2.0 * minutes / (band.order + band.terms - 1), 2.0 * minutes / band.order


def finding_text(found: CalibratedSurveys, finding: Finding) -> str:
    """A change with its size; with alternatives, that the lengths do not decide."""
    return _or_else(found, _change(found, finding), finding.alternatives)


def _or_else(found: CalibratedSurveys, text: str, alternatives: Iterable[Effect]) -> str:
    others = " or ".join(effect_name(found, one) for one in alternatives)
    if not others:
        return text
    return f"either {text}, or it is the {others}: the lengths do not decide"


def _change(found: CalibratedSurveys, finding: Finding) -> str:
    effect, size, sigma = finding.effect, finding.size, finding.sigma
    since = _since(found, effect)
    match effect.kind:
        case EffectKind.OFFSET:
            how = "long" if size > 0 else "short"
            return f"channel {found.channels[effect.of]} reads {_um(abs(size), sigma)} um too {how}{since}"
        case EffectKind.COLLIMATOR:
            x, y, z = (MICRO * finding.values).tolist()
            return (
                f"the collimator of channel {found.channels[effect.of]} has moved by {_um(size, sigma)} um "
                f"({x:+.0f}, {y:+.0f}, {z:+.0f} along world x, y, z){since}"
            )
        case EffectKind.SCALE:
            return f"all lengths are {_ppm(size, sigma)} ppm too {'long' if size > 0 else 'short'}{since}"
        case EffectKind.DRIFT:
            return (
                f"the scale of all lengths drifts by {_ppm(size, sigma, '+')} ppm per hour{_of_survey(found, effect)}"
            )
        case EffectKind.VARIATION:
            return _variation_text(found, [effect])


def _since(found: CalibratedSurveys, effect: Effect) -> str:
    until = f" until survey {found.network.given.survey[effect.until] + 1} begins" if effect.until else ""
    if not effect.since:
        return _of_survey(found, effect) + until
    point, t_s = found.points[effect.since]
    survey = f" of survey {found.network.given.survey[effect.since] + 1}" if len(found.surveys) > 1 else ""
    return f" since about point {'/'.join(map(str, point))}{survey} ({t_s:.0f} s by the robot's clock){until}"


def _of_survey(found: CalibratedSurveys, effect: Effect) -> str:
    if effect.is_of_channel or len(found.surveys) == 1:
        return ""
    return f" in survey {effect.of + 1} of {len(found.surveys)}"


def effect_name(found: CalibratedSurveys, effect: Effect) -> str:
    """An effect without its value."""
    names = {
        EffectKind.OFFSET: "offset of channel",
        EffectKind.COLLIMATOR: "collimator of channel",
        EffectKind.SCALE: "scale",
        EffectKind.DRIFT: "drift of the scale",
        EffectKind.VARIATION: "variation of the scale",
    }
    number = f" {found.channels[effect.of]}" if effect.is_of_channel else ""
    return names[effect.kind] + number + _since(found, effect)


def _joined(found: CalibratedSurveys, effects: Iterable[Effect]) -> str:
    """Effects of one kind together."""
    parts = []
    for kind, name in ((EffectKind.COLLIMATOR, "collimators"), (EffectKind.OFFSET, "offsets of channels")):
        numbers = [found.channels[one.of] for one in effects if one.kind is kind and one.is_always]
        if numbers:
            parts.append(f"{name} {' '.join(map(str, numbers))}")
    rest = [one for one in effects if not (one.is_always and one.is_of_channel)]
    return ", ".join([*parts, *(effect_name(found, one) for one in rest)])


def _numbers(found: CalibratedSurveys, columns: Iterable[int]) -> str:
    return " ".join(str(found.channels[column]) for column in sorted(set(columns)))


def _um(value: float, sigma: float) -> str:
    return f"{MICRO * value:.1f} +- {MICRO * sigma:.1f}"


def _ppm(value: float, sigma: float, sign: str = "") -> str:
    value = value if sign else abs(value)
    return f"{MICRO * value:{sign}.2f} +- {MICRO * sigma:.2f}"


def network_data(found: CalibratedSurveys | None) -> dict[str, Any] | None:
    """The network in the output of ``ccatp align --json``; None without lengths."""
    if found is None:
        return None
    network = found.network
    adjusted = network.adjustment
    return {
        "state": network.state.value,
        "sentence": sentence(found),
        "undetermined": [_effect_data(found, one) for one in network.undetermined],
        "noise": round(network.noise, 4),
        "is_noisy": network.is_noisy,
        "noisy_channels": [{"channel": channel, "noise": round(noise, 4)} for channel, noise in _noisy(found)],
        "chi2": round(network.chi2, 4),
        "dof": network.dof,
        "has_frame": network.has_frame,
        "findings": [
            {
                **_effect_data(found, one.effect),
                **_values(one.effect, one.values, np.sqrt(np.diag(one.covariance))),
                "alternatives": [_effect_data(found, other) for other in one.alternatives],
            }
            for one in network.findings
        ],
        "effects": [
            {
                **_effect_data(found, one),
                **_values(one, adjusted.of(one), np.sqrt(np.diag(adjusted.covariance_of(one)))),
                "prior_sigma": round(MICRO * float(np.sqrt(adjusted.prior[adjusted.slices[one]][0])), 6),
            }
            for one in adjusted.slices
        ],
        "bad_lengths": [
            {"point": list(found.points[row][0]), "channel": found.channels[column]}
            for row, column in np.argwhere(network.bad_lengths).tolist()
        ],
        "bad_points": [list(found.points[row][0]) for row in np.flatnonzero(network.bad_points).tolist()],
    }


def _effect_data(found: CalibratedSurveys, effect: Effect) -> dict[str, Any]:
    name = {"channel": found.channels[effect.of]} if effect.is_of_channel else {"survey": effect.of}
    since = list(found.points[effect.since][0]) if effect.since else None
    until = list(found.points[effect.until][0]) if effect.until else None
    band = {}
    if effect.kind is EffectKind.VARIATION:
        band = {"periods_min": [round(one, 2) for one in _periods_min(found, effect)]}
    return {"kind": effect.kind.value, **name, "since": since, "until": until, **band}


def _values(effect: Effect, values: FloatArray, sigmas: FloatArray) -> dict[str, Any]:
    unit = "um" if effect.is_of_channel else ("ppm_per_h" if effect.kind is EffectKind.DRIFT else "ppm")
    return {
        f"value_{unit}": [round(MICRO * float(value), 4) for value in values],
        f"sigma_{unit}": [round(MICRO * float(sigma), 4) for sigma in sigmas],
    }
