"""Draws docs/network.png: what a laser network can tell over a mirror. ``python -m tools.network_picture``."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ccatp.config.load import load_config
from ccatp.core import FloatArray
from ccatp.mirror.length_integrity import LengthIntegrity
from ccatp.mirror.mirror import Mirror
from ccatp.mirror.network_adjustment import calibrate
from ccatp.mirror.network_model import SurveyLengths
from tools.network_campaign import Places, places_of

OUT = Path(__file__).parents[1] / "docs" / "network.png"
MIRROR = "fyst-m1"


def protection_um(mirror: Mirror, places: Places, network: LengthIntegrity, channels: int) -> FloatArray:
    """Protection level of each point with the first channels, um: exact lengths, the network as configured."""
    found = []
    for puck in places.nominal_m:
        lengths = np.linalg.norm(mirror.collimators_m - puck, axis=1)
        valid = dict(zip(mirror.channels[:channels], lengths[:channels].tolist(), strict=True))
        x, y, z = puck.tolist()
        found.append(1e6 * network.judge((x, y, z), valid).protection_m)
    return np.array(found)


def main() -> None:
    """Draw the picture."""
    cfg = load_config(None, {"run.mirror": MIRROR})
    places = places_of(cfg)
    mirror = places.mirror
    deck = np.array([mirror.deck_from_world((x, y, z))[:2] for x, y, z in places.nominal_m.tolist()])
    there = dict(zip(mirror.channels, np.asarray(mirror.collimators_m), strict=True))
    distances = np.linalg.norm(places.nominal_m[:, None] - mirror.collimators_m, axis=2)
    sigmas = cfg.etalon.length_sigma_m + cfg.etalon.length_sigma_per_m * distances
    count = len(distances)
    given = SurveyLengths(
        distances, sigmas, mirror.collimators_m, places.nominal_m,
        np.linspace(-0.5, 0.5, count), np.zeros(count, dtype=np.int64),
    )  # fmt: skip
    adjusted = calibrate(given, cfg.etalon, cfg.align.network, cfg.align.false_alarm).adjustment
    moves = np.einsum("ka,kan->kn", places.normals, adjusted.moves)
    share = 1e6 * np.sqrt(np.einsum("kn,np,kp->k", moves, adjusted.covariance, moves))
    drawn = [
        (
            "protection level of a point, 8 channels, um",
            protection_um(mirror, places, LengthIntegrity(cfg.etalon, there), 8),
        ),
        ("the same with 6 channels, um", protection_um(mirror, places, LengthIntegrity(cfg.etalon, there), 6)),
        ("share of the network in a deviation, um", share),
    ]
    figure = Figure(figsize=(13.0, 4.6), layout="constrained")
    for number, (title, values) in enumerate(drawn):
        axes = figure.add_subplot(1, 3, number + 1, aspect="equal")
        dots = axes.scatter(deck[:, 0], deck[:, 1], c=values, s=55, marker="s", cmap="viridis")
        axes.set(title=title, xlabel="deck x, m", ylabel="deck y, m" if number == 0 else "")
        figure.colorbar(dots, ax=axes, shrink=0.85)
    figure.suptitle(f"{MIRROR}: eight collimators, priors as shipped")
    figure.savefig(OUT, dpi=110)


if __name__ == "__main__":
    main()
