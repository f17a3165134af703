"""Points of other instruments: how files are read, which frames, panels and sigmas they get, and what is refused."""

from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ccatp.cli import main
from ccatp.core import DeckPose, FloatArray, PanelId
from ccatp.mirror.foreign_points import PointsError, fit_frame, panel_of_label, world_from
from ccatp.mirror.misalignment import misaligned_puck_world
from ccatp.mirror.point_file import PointFileError, parse_points
from ccatp.sim.world import draw_misalignments
from tests.support.command import answered
from tests.support.scenario import config_of, world_of
from tests.support.targets import M1, OFFSET_M, PANELS, SIGMA_UM, is_recovered, labels, places, rows


@pytest.fixture
def aligned(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """The JSON of the command on these lines."""

    def run(lines: list[str], *args: str) -> Any:
        (tmp_path / "points.csv").write_text("\n".join(lines), encoding="utf-8")
        usual = () if "--sigma-um" in args else ("--sigma-um", str(SIGMA_UM))
        offset = () if "--offset-mm" in args else ("--offset-mm", str(1e3 * OFFSET_M))
        where = "--points", str(tmp_path / "points.csv"), "--mirror", "fyst-m1"
        return answered(capsys, "align", *where, *usual, *offset, *args)

    return run


# -- files ------------------------------------------------------------------------------------------------------------

ONE = (-1.2345678, 0.001, 3600.5e-3)


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("A1\t-1234.5678\t1\t3600.5\t0.015\t0.015\t0.02", None),
        ("A1\t-1.234,5678\t1,0\t3.600,5\t0,015\t0,015\t0,02", None),
        ("A1;-1234,5678;1,0;3600,5;0,015;0,015;0,02", None),
        ('"A1", -1234.5678, 1.0, 3600.5, 0.015, 0.015, 0.020', None),
        ("A1\t-1,234.5678\t1.0\t3,600.5\t0.015\t0.015\t0.020", None),
        ("A1 -1234.5678 1.0 3600.5 0.015 0.015 0.020", None),
        ("# exported\nz [mm],sx,sy,sz,label,y [mm],x [mm]\n3600.5,0.015,0.015,0.02,A1,1.0,-1234.5678", None),
        ("label,x_m,y_m,z_m,sx,sy,sz\nA1,-1.2345678,0.001,3.6005,1.5e-5,1.5e-5,2e-5", None),
        ("A1 -1.2345678 0.001 3.6005 1.5e-5 1.5e-5 2e-5", "m"),
    ],
)
def test_a_line_is_read_in_every_form(text: str, unit: str | None) -> None:
    (one,) = parse_points(text, "f.csv", unit)
    assert one.label == "A1"
    assert one.place_m == pytest.approx(ONE, abs=1e-12)
    assert one.sigmas_m == pytest.approx((15e-6, 15e-6, 20e-6))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "f.csv: no points in it"),
        ("A1,1,2", "f.csv:1: 3 columns"),
        ("A1,1,2,x3", "f.csv:1: z is 'x3', which is no number"),
        ("A1,1,2,3\nA2,1,nan,3", "f.csv:2: y is 'nan', which is no number"),
        ("A1,1.0,2,3,0,1,1", "f.csv:1: a sigma is not positive"),
    ],
)
def test_a_file_that_is_none_is_refused_with_its_line(text: str, message: str) -> None:
    with pytest.raises(PointFileError, match=message.replace("(", r"\(")):
        parse_points(text, "f.csv")


def test_labels_name_panels_as_ours_and_as_those_of_the_observatory() -> None:
    assert panel_of_label("3/7/4", M1) == panel_of_label("3-7", M1) == PanelId(3, 7)
    # Telescope, mirror, column, row, number.
    assert panel_of_label("11731", M1) == panel_of_label("11731_T04", M1) == PanelId(3, 7)
    assert (
        panel_of_label("11371", M1, row_first=True) == panel_of_label("01-011371", M1, row_first=True) == PanelId(3, 7)
    )
    assert panel_of_label("TARGET 9", M1) is panel_of_label("11001", M1) is None
    with pytest.raises(PointsError, match="label 12281 is of mirror 2"):
        panel_of_label("12281", M1)
    with pytest.raises(PointsError, match="no panel in row 1, column 1"):
        panel_of_label("11111", M1)
    assert panel_of_label("12281", world_of("fyst-m2").mirror) == PanelId(8, 2)


# -- frames -----------------------------------------------------------------------------------------------------------


def test_frames_are_right_handed_and_the_mirrors_lie_where_the_manufacturer_says() -> None:
    for frame in ("world", "mirror", "telescope"):
        axes = world_from(frame, M1, np.eye(3)) - world_from(frame, M1, np.zeros((3, 3)))
        assert np.linalg.det(axes) == pytest.approx(1.0)
    # The manufacturer's drawing has the origins of M1 and M2 at (-120, 0, -3600) and (-4920, 0, 0) mm.
    found = world_from("telescope", M1, np.array([[-0.12, 0.0, -3.6], [-4.92, 0.0, 0.0]]))
    assert found == pytest.approx(np.array([[0.0, 0.0, 3.6], [0.0, -4.8, 0.0]]), abs=1e-12)


REFERENCES = [f"R{k}" for k in range(8)]


def turned(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    a, b = 0.7, -0.4
    first = np.array([[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]])
    second = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(b), -np.sin(b)], [0.0, np.sin(b), np.cos(b)]])
    rotation, shift = second @ first, np.array([2.0, -1.0, 0.5])
    return (points - shift) @ rotation, rotation, shift


def test_the_frame_of_an_instrument_is_fitted_with_its_covariance() -> None:
    world = np.random.default_rng(2).uniform(-3.0, 3.0, size=(8, 3))
    own, rotation, shift = turned(world)
    exact = fit_frame(own, world, REFERENCES)
    assert exact.rotation == pytest.approx(rotation, abs=1e-12)
    assert exact.shift_m == pytest.approx(shift, abs=1e-12)
    rng, pulls = np.random.default_rng(3), []
    for _ in range(200):
        fitted = fit_frame(own, world + 20e-6 * rng.normal(size=world.shape), REFERENCES)
        error = fitted.rotation @ (rotation.T) - np.eye(3)
        vector = np.array([error[2, 1], error[0, 2], error[1, 0]])
        pulls.append(vector @ np.linalg.solve(fitted.covariance[:3, :3], vector))
    # Three degrees of freedom with an estimated variance of 18: mean 3 x 18 / 16; four sigmas.
    assert np.mean(pulls) == pytest.approx(3.4, abs=0.8)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda own: own * [1.0, -1.0, 1.0], "left-handed"),
        (lambda own: own[:2], "2 reference points"),
        (lambda own: own[[0, 1, 3, 2, 4, 5, 6, 7]], "the largest at R[23]; check labels and units"),
        (lambda own: own + 0.02 * (np.arange(8) == 5)[:, None], "the largest at R5"),
        (lambda own: 1e3 * own, "do not fit the points of the file"),
        (lambda own: np.outer(np.arange(8.0), [1.0, 2.0, 3.0]), "lie on one line"),
    ],
)
def test_references_that_give_no_frame_are_refused(change: Callable[[FloatArray], FloatArray], message: str) -> None:
    world = np.random.default_rng(2).uniform(-3.0, 3.0, size=(8, 3))
    own = change(turned(world)[0])
    with pytest.raises(PointsError, match=message):
        fit_frame(own, world[: len(own)], REFERENCES)


# -- panels -----------------------------------------------------------------------------------------------------------


def test_points_of_a_tracker_give_the_panels_by_label_and_by_position(aligned: Callable[..., Any]) -> None:
    points = places()
    by_label = aligned(rows(points, labels()))
    assert is_recovered(by_label)
    assert by_label["points"]["measured"] == 27
    by_place = aligned(rows(points, [f"T{k}" for k in range(27)]))
    assert by_place["panels"] == by_label["panels"]


@pytest.mark.parametrize("per_side", [2, 5])
def test_more_and_fewer_than_nine_points_of_a_panel(aligned: Callable[..., Any], per_side: int) -> None:
    assert is_recovered(aligned(rows(places(per_side), labels(per_side))))


@pytest.mark.parametrize("frame", ["mirror", "telescope"])
def test_coordinates_of_another_frame(aligned: Callable[..., Any], frame: str) -> None:
    zero, axes = world_from(frame, M1, np.zeros((1, 3))), world_from(frame, M1, np.eye(3))  # type: ignore[arg-type]
    there = 1e3 * (places() / 1e3 - zero) @ np.linalg.inv(axes - zero)
    assert is_recovered(aligned(rows(there, labels()), "--frame", frame))


def test_the_own_frame_of_a_tracker_with_references(aligned: Callable[..., Any], tmp_path: Path) -> None:
    known = np.random.default_rng(5).uniform(-3000.0, 3000.0, size=(6, 3))
    (tmp_path / "references.csv").write_text("\n".join(rows(known, [f"R{k}" for k in range(6)])), encoding="utf-8")
    measured = known + 0.02 * np.random.default_rng(6).normal(size=known.shape)
    own = 1e3 * turned(np.vstack([places(), measured]) / 1e3)[0]
    found = aligned(
        rows(own, [*labels(), *(f"R{k}" for k in range(6))]),
        "--frame", "own", "--references", str(tmp_path / "references.csv"),
    )  # fmt: skip
    assert is_recovered(found)
    # The frame adds to the standard deviation of the piston, 15 um / 3.
    assert all(panel["sigma"][0] > 6.0 for panel in found["panels"])
    assert len(found["instrument"]["reference_residuals_um"]) == 6
    assert any("um rms in a coordinate, the largest" in line for line in found["warnings"])


def test_repeated_readings_that_scatter_more_than_claimed_scale_the_sigmas(aligned: Callable[..., Any]) -> None:
    twice = [places(noise_um=40.0, seed=seed) for seed in (1, 2, 3)]
    found = aligned([line for one in twice for line in rows(one, labels())])
    assert found["instrument"]["repeated"] == 54
    assert found["instrument"]["repeat_sigma_um"] == pytest.approx(40.0, rel=0.3)
    assert found["instrument"]["sigma_factor"] == pytest.approx(40.0 / SIGMA_UM, rel=0.35)
    assert is_recovered(found, 4.0)
    assert found["instrument"]["repeat_shift_um"] == 0.0
    assert any("standard deviations are multiplied by" in line for line in found["warnings"])


def with_errors(errors_um: dict[int, float], seed: int = 4) -> list[str]:
    """The lines of the first panel with its points off by so much along the normal, and of the others as they are."""
    points = places(noise_um=2.0, seed=seed)
    for number, error_um in errors_um.items():
        points[number - 1] += 1e-3 * error_um * np.array(M1.rotate_world_from_deck(M1.panel(PANELS[0]).axes[2]))
    return rows(points, labels())


def test_a_point_that_is_measured_again_is_judged_by_the_other_points(aligned: Callable[..., Any]) -> None:
    """A wrong reading, then the right one: only the wrong one is left out, and no standard deviation is larger."""
    again = with_errors({}, seed=7)
    for number in range(1, 10):
        found = aligned([*with_errors({number: 50.0}), again[number - 1]], "--sigma-um", "2")
        assert found["instrument"]["sigma_factor"] == 1.0
        panel = found["panels"][0]
        assert [one["is_outlier"] for one in panel["deviations"]].count(True) == 1
        assert panel["deviations"][number - 1]["is_outlier"]
        assert is_recovered(found)
        (line,) = [line for line in found["warnings"] if "contradict each other" in line]
        assert f"4/5/{number} by " in line
        assert f"(lines {number}, 28; not used: {number})" in line
        assert not any("again" in one for one in found["warnings"])


def test_many_points_that_are_measured_again_do_not_change_the_sigmas(aligned: Callable[..., Any]) -> None:
    again = with_errors({}, seed=7)
    found = aligned([*with_errors({1: 50.0, 9: -70.0}), again[0], again[8]], "--sigma-um", "2")
    assert found["instrument"]["sigma_factor"] == 1.0
    assert len(found["instrument"]["contradictions"]) == 2
    assert is_recovered(found)


def test_what_the_program_asks_for_ends_the_question(aligned: Callable[..., Any]) -> None:
    """Two equal errors, of which the points do not decide: the points that it asks for are measured again."""
    again = with_errors({}, seed=7)
    for pair in ((2, 3), (3, 6), (5, 6), (2, 8)):
        lines = with_errors(dict.fromkeys(pair, 50.0))
        asked = list[int]()
        while (point := (found := aligned(lines, "--sigma-um", "2"))["panels"][0]["deciding_point"]) is not None:
            assert point not in asked
            asked.append(point)
            lines.append(again[point - 1])
        assert is_recovered(found)
        assert len(asked) <= 4


def test_copies_of_readings_count_once(aligned: Callable[..., Any]) -> None:
    once, thrice = (aligned(rows(places(), labels()) * times) for times in (1, 3))
    assert thrice["panels"] == once["panels"]
    assert any("54 readings are copies of others" in line for line in thrice["warnings"])


def test_readings_of_two_nights_that_differ_are_no_better_by_their_number(aligned: Callable[..., Any]) -> None:
    second = places(seed=2) + np.array([0.0, 0.0, 0.1])
    found = aligned([line for one in (places(seed=1), second) for line in rows(one, labels())])
    # Along the normals, which are some 30 degrees from z; a standard deviation of two values.
    assert found["instrument"]["repeat_shift_um"] == pytest.approx(100.0 * 0.87 / 2**0.5, rel=0.25)
    assert found["instrument"]["sigma_factor"] == 1.0
    assert all(panel["sigma"][0] > 35.0 for panel in found["panels"])
    assert is_recovered(found, 3.0)
    assert any("two nights, or two frames" in line for line in found["warnings"])


def of_mirror(error: Callable[[FloatArray], FloatArray]) -> list[str]:
    """Lines of a target at each corner of each panel, which lie anyhow; ``error`` of their coordinates, mm."""
    rng, found, names = np.random.default_rng(9), [], []
    for panel, lies in draw_misalignments(M1.panels, config_of(), rng).items():
        body = M1.panel(panel)
        for k, (x, y) in enumerate(product((-0.28, 0.28), (-0.3, 0.3))):
            pose = DeckPose(body.x_m + x, body.y_m + y, 0.0)
            found.append(misaligned_puck_world(M1, panel, lies, pose, OFFSET_M))
            names.append(f"{panel.row}/{panel.col}/{k + 1}")
    points = 1e3 * np.array(found) + 0.01 * rng.normal(size=(len(found), 3))
    return rows(points + error(points), names)


COMMON: dict[str, tuple[Callable[[FloatArray], FloatArray], float]] = {
    "none": (lambda points: 0.0 * points, 0.0),
    "offset": (lambda points: 0.0 * points, 0.2),
    "shift": (lambda points: 0.0 * points + [0.1, 0.0, 0.2], 0.0),
    "turn": (lambda points: np.cross([1e-4, 0.0, 0.0], points), 0.0),
    "scale": (lambda points: 3e-5 * points, 0.0),
}


@pytest.mark.parametrize(("error", "offset_mm"), COMMON.values(), ids=[*COMMON])
def test_what_all_panels_have_in_common_is_said(
    error: Callable[[FloatArray], FloatArray], offset_mm: float, aligned: Callable[..., Any]
) -> None:
    """Errors of frame, scale and offset that no residual shows."""
    found = aligned(of_mirror(error), "--offset-mm", str(1e3 * OFFSET_M + offset_mm))
    said = [line for line in found["warnings"] if "the panels have in common" in line]
    middles = 1e3 * np.array([M1.world_from_deck(body.origin) for body in M1.panels.values()])
    normals = np.array([M1.rotate_world_from_deck(body.axes[2]) for body in M1.panels.values()])
    expected_mm = float(np.sqrt(np.mean((np.sum(error(middles) * normals, axis=1) - offset_mm) ** 2)))
    if not expected_mm:
        assert said == []
        return
    (line,) = said
    # The panels lie anyhow, by 0.05 mm rms: a tenth of that is common by chance.
    assert float(line.split("in common ")[1].split(" mm")[0]) == pytest.approx(expected_mm, abs=0.03)


LOWER = "6.23 mm lower than the target's offset says: "
HIGHER = "2.12 mm higher than the target's offset says: "
NESTS: dict[str, tuple[FloatArray, list[str]]] = {
    "a panel": (np.where(np.arange(27) < 9, -6.35, 0.0), [LOWER + "panel 4/5;"]),
    "two of three": (np.where(np.arange(27) < 18, 2.0, 0.0), [HIGHER + "panels 4/5, 5/4;"]),
    "two nests": (np.repeat([-6.35, 2.0, 0.0], 9), [LOWER + "panel 4/5;", HIGHER + "panel 5/4;"]),
    "points": (
        np.where(np.isin(np.arange(27), [1, 5, 7]), -2.0, 0.0),
        ["1.87 mm lower than the target's offset says: points 4/5/2, 4/5/6, 4/5/8;"],
    ),
    "tenths of a millimetre": (np.where(np.arange(27) < 9, -0.6, 0.0), []),
}


@pytest.mark.parametrize(("off_mm", "said"), NESTS.values(), ids=[*NESTS])
def test_points_on_another_nest_are_named(off_mm: FloatArray, said: list[str], aligned: Callable[..., Any]) -> None:
    """The panels lie 0.12 mm higher."""
    normals = np.array([M1.rotate_world_from_deck(M1.panel(panel).axes[2]) for panel in PANELS])
    found = aligned(rows(places(noise_um=1.0) + off_mm[:, None] * np.repeat(normals, 9, axis=0), labels()))
    lines = [line for line in found["warnings"] if "another target nest" in line]
    assert len(lines) == len(said) == len(found["instrument"]["off_height"])
    for line, begin in zip(lines, said, strict=True):
        assert line.startswith(begin)


def test_points_of_two_frames_on_every_panel_are_no_outliers(aligned: Callable[..., Any]) -> None:
    """Every second target by another instrument: the middle one and the corners of each panel are 0.2 mm higher."""
    points = places() + np.where(np.arange(27) % 2 == 0, 0.2, 0.0)[:, None] * [0.0, 0.0, 1.0]
    found = aligned(rows(points, labels()))
    assert not any(panel["outliers"] for panel in found["panels"])
    assert found["instrument"]["sigma_factor"] > 4.0
    assert is_recovered(found, 4.0)


def test_good_readings_keep_their_sigmas(aligned: Callable[..., Any]) -> None:
    found = aligned(rows(places(noise_um=10.0), labels()))
    assert found["instrument"]["sigma_factor"] == 1.0


# -- what is refused --------------------------------------------------------------------------------------------------


def mixed(lines: list[str]) -> list[str]:
    name, *numbers = lines[4].split(",")
    return [*lines[:4], ",".join([name, *(str(float(one) / 1e3) for one in numbers)]), *lines[5:]]


def swapped(lines: list[str]) -> list[str]:
    return [f"{name},{y},{x},{z}" for name, x, y, z in (line.split(",") for line in lines)]


def mirrored(lines: list[str]) -> list[str]:
    return [",".join((name, str(-float(x)), y, z)) for name, x, y, z in (line.split(",") for line in lines)]


def one_name(lines: list[str]) -> list[str]:
    return [line.replace("5/4/", "4/5/") for line in lines]


REFUSED: dict[str, tuple[Callable[[list[str]], list[str]], tuple[str, ...], str]] = {
    "mixed units": (mixed, (), "mixed units, 1 of 27 points are in metres"),
    "all in metres": (lambda lines: lines, ("--unit", "um"), "is not on fyst-m1"),
    "swapped axes": (swapped, (), "with (y, x, z) in place of (x, y, z) the points lie on it"),
    "left-handed": (mirrored, (), "names panel 5/4, and lies on 5/6, as 18 of 27 points do: a left-handed frame"),
    "two panels with one name": (one_name, (), "names panel 4/5, and lies on 5/4"),
    "offset of the wrong sign": (lambda lines: lines, ("--offset-mm", "-19.05"), "seems to have the wrong sign"),
    "no sigma": (lambda lines: lines, ("--sigma-um", ""), "no sigma; add columns sx, sy, sz, or give --sigma-um"),
}


@pytest.mark.parametrize(("change", "args", "message"), REFUSED.values(), ids=[*REFUSED])
def test_points_that_cannot_be_are_refused_in_one_line(
    change: Callable[[list[str]], list[str]], args: tuple[str, ...], message: str,
    tmp_path: Path, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    file = tmp_path / "points.csv"
    file.write_text("\n".join(change(rows(places(), labels()))), encoding="utf-8")
    usual = {"--sigma-um": "15", "--offset-mm": "19.05"} | dict(zip(args[::2], args[1::2], strict=True))
    options = [part for pair in usual.items() if pair[1] for part in pair]
    assert main(["align", "--points", str(file), "--mirror", "fyst-m1", *options]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = err.splitlines()
    assert message in line


def test_collinear_points_determine_no_panel(aligned: Callable[..., Any]) -> None:
    lines = rows(places(), labels())
    found = aligned([line for k, line in enumerate(lines) if k > 8 or k < 3])
    assert len(found["panels"]) == 2
    assert [one["why"] for one in found["undetermined"]] == ["its points lie on one line"]
