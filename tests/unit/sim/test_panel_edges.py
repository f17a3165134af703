"""Panels whose edges lie elsewhere than designed."""

from itertools import product
from math import pi, sqrt

import numpy as np
import pytest
from numpy.typing import NDArray

from ccatp.config.load import load_config
from ccatp.config.models import Config
from ccatp.core import DeckPose, PanelId
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.sim.edge_sensors import MIN_GAP_M, EdgeSensors, PanelEdges, nominal_rectangles
from ccatp.sim.plant import Plant

SIGMA_M = 2e-4
OFFSETS = ((0.09, 0.09), (0.09, -0.09), (-0.09, 0.09), (-0.09, -0.09))
DT_S = 0.01


@pytest.fixture(scope="module")
def wide() -> Config:
    """A mirror with gaps of 10 mm, where no shift is ever limited."""
    return load_config(overrides={"run.mirror": "thesis-m1"})


def edges_of(cfg: Config, mirror: Mirror, seed: int = 1, sigma_m: float = SIGMA_M) -> PanelEdges:
    return PanelEdges(mirror, cfg.mirror.panels, sigma_m, np.random.default_rng(seed))


def shifts_of(cfg: Config, seed: int = 1) -> NDArray[np.float64]:
    """Outward shifts, shape (panels, 4)."""
    mirror = build_mirror(cfg.mirror)
    found, nominal = edges_of(cfg, mirror, seed).rectangles, nominal_rectangles(mirror)
    return np.array([np.subtract(found[p], nominal[p]) * (-1, 1, -1, 1) for p in nominal])


def test_edges_shift_by_their_sigma_each_for_itself(wide: Config) -> None:
    shifts = np.concatenate([shifts_of(wide, seed) for seed in range(20)])
    n = len(shifts)
    assert shifts.std(axis=0) == pytest.approx([SIGMA_M] * 4, rel=4.5 / sqrt(2 * n))
    assert np.abs(shifts.mean(axis=0)).max() < 4.5 * SIGMA_M / sqrt(n)
    assert np.abs(np.corrcoef(shifts.T)[np.triu_indices(4, 1)]).max() < 4.5 / sqrt(n)


def test_the_same_seed_gives_the_same_edges(wide: Config) -> None:
    assert (shifts_of(wide, 1) == shifts_of(wide, 1)).all()
    assert (shifts_of(wide, 1) != shifts_of(wide, 2)).all()


@pytest.mark.parametrize("sigma_m", [SIGMA_M, 2e-3])
def test_neighbours_keep_a_gap(config: Config, sigma_m: float) -> None:
    mirror = build_mirror(config.mirror)
    for seed in range(20):
        found = edges_of(config, mirror, seed, sigma_m).rectangles
        for pid, (_, x1, _, y1) in found.items():
            if right := found.get(PanelId(pid.row, pid.col + 1)):
                assert right[0] - x1 >= MIN_GAP_M - 1e-9  # rounding of metres
            if above := found.get(PanelId(pid.row + 1, pid.col)):
                assert above[2] - y1 >= MIN_GAP_M - 1e-9


def test_material_is_inside_the_shifted_edges_and_nowhere_else(config: Config) -> None:
    mirror = build_mirror(config.mirror)
    edges = edges_of(config, mirror)
    for x0, x1, y0, y1 in edges.rectangles.values():
        x, y, d = (x0 + x1) / 2.0, (y0 + y1) / 2.0, 1e-9
        for (px, py), (qx, qy) in zip(
            ((x0 + d, y), (x1 - d, y), (x, y0 + d), (x, y1 - d)),
            ((x0 - d, y), (x1 + d, y), (x, y0 - d), (x, y1 + d)),
            strict=True,
        ):
            assert edges.is_on_panel(px, py)
            assert not edges.is_on_panel(qx, qy)
    assert not edges.is_on_panel(99.0, 0.0)


@pytest.mark.parametrize("seed", range(3))
def test_sensors_see_the_shifted_edges_at_every_millisecond(config: Config, seed: int) -> None:
    """Against the plain question asked at each sample, along drives and turns across seams and over the rim."""
    mirror = build_mirror(config.mirror)
    shifted = edges_of(config, mirror, seed)
    rng = np.random.default_rng(seed)
    fractions = [(k + 1) / 10.0 for k in range(10)]
    times = [0.001 * (k + 1) for k in range(10)]
    off = ideal = 0
    for _ in range(25):
        centre = mirror.panels[list(mirror.panels)[int(rng.integers(len(mirror.panels)))]]
        dx, dy = rng.uniform(-1, 1, 2)
        start = DeckPose(centre.x_m + dx * centre.half_x_m, centre.y_m + dy * centre.half_y_m, rng.uniform(-pi, pi))
        plant = Plant(mirror.surface, start, wheel_radius_m=0.03, wheel_base_m=0.15, wheel_lag_s=0.08)
        sensors = EdgeSensors(mirror, OFFSETS, shifted)
        sensors.place(plant)
        right, left = rng.uniform(-7, 7, 2)
        for k in range(150):
            before = [mirror.body_offset(plant.pose, *o) for o in OFFSETS]
            plant.step(k * DT_S, DT_S, right, left)
            after = [mirror.body_offset(plant.pose, *o) for o in OFFSETS]
            for (_, *values), f in zip(sensors.read(plant, times, fractions), fractions, strict=True):
                for value, (x0, y0), (x1, y1) in zip(values, before, after, strict=True):
                    x, y = x0 + f * (x1 - x0), y0 + f * (y1 - y0)
                    if value != shifted.is_on_panel(x, y):
                        # Within a nanometre of an edge rounding may decide.
                        near = [shifted.is_on_panel(x + a, y + b) for a, b in product((-1e-9, 1e-9), repeat=2)]
                        assert len(set(near)) == 2
                    off += 1 - value
                    ideal += value != mirror.is_on_panel(x, y)
    assert off > 100
    assert ideal > 10  # the shifts were felt
