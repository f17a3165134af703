"""Pure. The four shipped mirrors, and configurations that contradict themselves."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from ccatp.config.models import MirrorConfig
from ccatp.core import DeckPose
from ccatp.mirror.mirror import Mirror, build_mirror
from ccatp.mirror.surface import LayoutError

Raw = dict[str, Any]
PANELS = {"fyst-m1": 77, "fyst-m2": 69, "thesis-m1": 87, "thesis-m2": 78}
POINTS = {"fyst-m1": 693, "fyst-m2": 621, "thesis-m1": 783, "thesis-m2": 702}
MAX_DOP = 3.0


def test_counts(mirror: Mirror) -> None:
    points = {mirror.point_on_deck(pid) for panel in mirror.panels for pid in mirror.point_ids(panel)}
    assert len(mirror.panels) == PANELS[mirror.name]
    assert len(points) == POINTS[mirror.name]
    assert mirror.overhang == mirror.name.endswith("m2")


def test_longest_leg_between_panels_of_the_thesis(mirror: Mirror) -> None:
    # The thesis's largest leg is 0.744 m: panel to panel between equal points, along a column.
    ys = sorted({round(p.y_m, 9) for p in mirror.panels.values()})
    if mirror.name.startswith("thesis"):
        assert np.diff(ys) == pytest.approx(0.744, abs=1e-9)


def test_collimators_see_every_corner_of_every_panel_well(mirror: Mirror) -> None:
    assert mirror.channels == (1, 2, 3, 4, 5, 6, 7, 8)
    assert mirror.collimators_m.shape == (8, 3)
    for panel in mirror.panels.values():
        for sx in (-1, 0, 1):
            for sy in (-1, 0, 1):
                place = DeckPose(panel.x_m + sx * panel.half_x_m, panel.y_m + sy * panel.half_y_m, 0.0)
                rays = np.array(mirror.puck_world(place, 0.05)) - mirror.collimators_m
                normal = np.array(mirror.rotate_world_from_deck(mirror.surface.normal(place.x_m, place.y_m)))
                assert (rays @ normal < 0.0).all()  # on the drive side: the mirror does not hide the puck
                jacobian = rays / np.linalg.norm(rays, axis=1)[:, None]
                dop = float(np.sqrt(np.trace(np.linalg.inv(jacobian.T @ jacobian))))
                assert dop < MAX_DOP


def _set(section: str, key: str, value: object) -> Callable[[Raw], None]:
    def change(raw: Raw) -> None:
        raw[section][key] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("panels", "count", 78), "panels_per_row adds up to 77 panels, count says 78"),
        (_set("panels", "panels_per_row", [8, 9, 9, 9, 9, 9, 9, 9, 6]), "row 1 with 8 panels cannot be centred on 9"),
        (_set("panels", "panels_per_row", [11, 9, 9, 9, 9, 9, 9, 9, 3]), "row 1 with 11 panels cannot be centred on 9"),
        (_set("panels", "pitch_x_mm", 680.0), r"pitch_x_mm 680.0 is not size 670.0 \+ gap 1.2"),
        (_set("panels", "size_y_mm", 700.0), r"pitch_y_mm 751.2022 is not size 700.0 \+ gap 1.2"),
        (_set("panels", "points_x_mm", [-220.0, 0.0, 340.0]), r"points_x_mm \(-220.0, 0.0, 340.0\) must ascend"),
        (_set("panels", "points_y_mm", [250.0, 0.0, -250.0]), r"points_y_mm \(250.0, 0.0, -250.0\) must ascend"),
        (_set("base", "col", 1), "base: there is no panel in row 1, column 1"),
        (_set("base", "y_mm", -376.0), r"base: \(-150.0, -376.0\) mm is not on panel \(1, 2\)"),
        (_set("collimators", "channels", [1, 2, 3, 4]), "4 channels, 8 positions"),
        (_set("collimators", "channels", [1, 2, 3, 4, 5, 6, 7, 7]), "are not distinct"),
    ],
)
def test_contradictions_are_refused(raw: Raw, change: Callable[[Raw], None], message: str) -> None:
    change(raw)
    with pytest.raises(LayoutError, match=message):
        build_mirror(MirrorConfig.model_validate(raw))


def test_fewer_than_four_collimators_are_refused(raw: Raw) -> None:
    raw["collimators"] = {"channels": [1, 2, 3], "positions_world_mm": raw["collimators"]["positions_world_mm"][:3]}
    with pytest.raises(LayoutError, match="3 channels; a position needs at least 4"):
        build_mirror(MirrorConfig.model_validate(raw))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("panels", "size_x_mm", -670.0), "size_x_mm"),
        (_set("panels", "size_x", 670.0), "size_x"),
        (_set("frame", "reflecting_side_sign", 0), "reflecting_side_sign"),
        (_set("surface", "normalisation_radius_mm", float("nan")), "normalisation_radius_mm"),
        (_set("collimators", "channels", [0, 2, 3, 4, 5, 6, 7, 8]), "channels"),
    ],
)
def test_malformed_files_name_the_key(raw: Raw, change: Callable[[Raw], None], message: str) -> None:
    change(raw)
    with pytest.raises(ValidationError, match=message):
        MirrorConfig.model_validate(raw)


def test_every_file_names_its_sources_and_what_nobody_confirmed(raw: Raw) -> None:
    cfg = MirrorConfig.model_validate(raw)
    assert len(cfg.provenance) >= 3
    assert any("collimators" in line for line in cfg.unverified)
    assert any("base" in line for line in cfg.unverified)
