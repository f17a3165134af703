"""The path of every reader: order and clocks, placeholders, unknown motions at either end, headings that are none."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ccatp.beacons.config.load import load_recordings_config
from ccatp.beacons.datasets.ordering import clock_sets
from ccatp.beacons.datasets.reader import read_run
from ccatp.beacons.datasets.tables import RadioDataError
from ccatp.beacons.estimation.recording import RecordedRun, dead_reckoned
from ccatp.beacons.studies.recordings import estimate, settings_of
from ccatp.core import FloatArray
from tests.unit.beacons.datasets.sets import BEACONS, World, csv_lines, world, write_lines

W = world(seconds=60.0)
LINES = [line for line in csv_lines(W) if not line.startswith("bearing")]
Change = Callable[[list[str]], list[str]]


def in_time_order(lines: list[str]) -> list[str]:
    """The lines as a recorder would write them: all kinds of events by time."""
    head = [line for line in lines if line.split(",")[0] not in {"odom", "range", "truth"}]
    timed = [line for line in lines if line.split(",")[0] in {"odom", "range", "truth"}]
    return head + sorted(timed, key=lambda line: float(line.split(",")[1]))


def read(tmp_path: Path, change: Change, *, turns_heading: bool = True) -> tuple[RecordedRun, str]:
    file = write_lines(tmp_path / "mine.csv", change(in_time_order(LINES)))
    run = read_run(file, None, None, turns_heading=turns_heading)
    return run, " | ".join(run.warnings)


def each(kind: str, change: Callable[[int, list[str]], list[str]]) -> Change:
    """Changes the cells of all lines of a kind, by their number."""

    def changed(lines: list[str]) -> list[str]:
        found, count = [], 0
        for line in lines:
            is_its = line.startswith(f"{kind},")
            found.append(",".join(change(count, line.split(","))) if is_its else line)
            count += is_its
        return found

    return changed


def with_value(kind: str, column: int, value: str, rows: Callable[[int], bool]) -> Change:
    return each(kind, lambda k, cells: [*cells[:column], value, *cells[column + 1 :]] if rows(k) else cells)


def clock_set(back_s: float, at_s: float = 40.0) -> Change:
    def later(lines: list[str]) -> list[str]:
        found = []
        for line in lines:
            cells = line.split(",")
            if cells[0] in {"odom", "range", "truth"} and float(cells[1]) > at_s:
                cells[1] = str(float(cells[1]) - back_s)
            found.append(",".join(cells))
        return found

    return later


def test_a_sound_recording_is_read_without_a_word_about_its_rows(tmp_path: Path) -> None:
    _, said = read(tmp_path, list)
    assert "not used" not in said
    assert "clock" not in said


@pytest.mark.parametrize("by_kind", [False, True])
def test_a_clock_that_was_set_back_leaves_one_of_the_parts(tmp_path: Path, by_kind: bool) -> None:
    def change(lines: list[str]) -> list[str]:
        return (
            sorted(clock_set(15.0)(lines), key=lambda line: line.split(",")[0]) if by_kind else clock_set(15.0)(lines)
        )

    run, said = read(tmp_path, change)
    assert "odom: the clock was set back by 14.9 s at 40 s: of 2 parts only the one of 40 s from 0 s on is used" in said
    assert run.steps.times_s[-1] == pytest.approx(40.0)
    assert run.readings.times_s[-1] <= 40.0
    assert run.readings.times_s.size == np.sum(W.read_s <= 40.0)
    assert run.steps.distance_m.sum() == pytest.approx(W.distance_m[:400].sum())


def test_a_clock_that_was_set_forward_by_days_leaves_the_part_with_most_rows(tmp_path: Path) -> None:
    run, said = read(tmp_path, clock_set(-1e6, at_s=20.0))
    assert "odometry pauses for 1e+06 s at 20 s: was the clock set? Only the part with most rows is used" in said
    assert run.steps.times_s[0] == pytest.approx(1e6 + 20.1)


@pytest.mark.parametrize(
    ("times_s", "sets"),
    [
        (np.arange(100.0), []),
        (np.r_[0:60, 50:100].astype(float), [60]),
        (np.r_[0:60, 40:80, 55:99].astype(float), [60, 100]),
        (np.r_[50:100, 0:50].astype(float), []),  # two halves in the wrong order
        (np.r_[0:20, 25:28, 20:25, 28:50].astype(float), []),  # a block that was written late
        (np.random.default_rng(1).permutation(100).astype(float), []),
        (np.arange(100.0) + np.tile([0.0, 1.5], 50), []),  # two sources, one of them late
    ],
)
def test_only_a_clock_is_set_where_two_ascending_parts_interleave(times_s: np.ndarray, sets: list[int]) -> None:
    assert clock_sets(times_s) == sets


def test_motions_of_equal_times_are_added_up_and_of_the_truth_the_last_counts(tmp_path: Path) -> None:
    x_m = W.poses[-1, 0] + 0.25

    def change(lines: list[str]) -> list[str]:
        row = next(k for k, line in enumerate(lines) if line.startswith("odom,30.0,"))
        return [*lines[: row + 1], "odom,30.0,0.01,0.002", *lines[row + 1 :], f"truth,60.0,{x_m},{W.poses[-1, 1]},9"]

    run, said = read(tmp_path, change)
    assert run.steps.distance_m[299] == pytest.approx(W.distance_m[299] + 0.01)
    assert run.steps.turn_rad.sum() == pytest.approx(W.turn_rad.sum() + 0.002)
    assert "1 row of odometry of the same time as the next (the first here), added up" in said
    assert "1 row of truth of the same time as the next (the first here), the last one counts" in said
    assert run.truth is not None
    assert run.truth.x_m[-1] == pytest.approx(x_m)


@pytest.mark.parametrize(
    ("kind", "value", "rows", "what"),
    [
        ("range", "0", lambda k: k % 20 == 3, "15 ranges of 0 m"),
        ("range", "65.535", lambda k: k % 20 == 3, "15 ranges of 65.535 m, the first at "),
        ("range", "65.535", lambda k: k == 3, "1 range of 65.535 m"),
        ("range", "-1", lambda k: k % 20 == 3, "15 ranges of -1 m"),
        ("range", "40.96", lambda k: k % 20 == 3, "15 ranges of 40.96 m"),
        ("range", "0.35", lambda k: k % 5 == 3, "60 ranges of 0.35 m"),
    ],
)
def test_a_placeholder_is_not_a_range(
    tmp_path: Path, kind: str, value: str, rows: Callable[[int], bool], what: str
) -> None:
    run, said = read(tmp_path, with_value(kind, 3, value, rows))
    assert what in said
    assert "a placeholder" in said
    assert float(value) not in run.readings.range_m
    assert run.readings.range_m.size == len(W.read_s) - sum(rows(k) for k in range(len(W.read_s)))


@pytest.mark.parametrize(
    ("dbm", "what"),
    [("-100", "60 signal strengths of -100 dBm"), ("100", "60 signal strengths of 100 dBm"), ("0", "of 0 dBm")],
)
def test_a_placeholder_is_not_a_signal_strength(tmp_path: Path, dbm: str, what: str) -> None:
    def levels(k: int, cells: list[str]) -> list[str]:
        level = dbm if k % 5 == 3 else f"{-40.0 - 20.0 * np.log10(float(cells[3])):.0f}"
        return ["rssi", cells[1], cells[2], level]

    run, said = read(tmp_path, each("range", levels))
    assert what in said
    assert run.readings.rssi_dbm.max() < 0.0
    assert run.readings.rssi_dbm.min() > -80.0


def test_an_empty_cell_is_a_beacon_without_reception(tmp_path: Path) -> None:
    run, said = read(tmp_path, with_value("range", 3, "", lambda k: k == 10))
    assert run.readings.range_m.size == len(W.read_s) - 1
    assert "1 row not finite" in said


def test_a_frozen_beacon_is_used_once(tmp_path: Path) -> None:
    run, said = read(tmp_path, with_value("range", 3, "3.21", lambda k: k % 4 == 1 and 100 <= k < 200))
    assert "range of beacon 7 repeats 3.21 25 times from" in said
    assert np.sum(run.readings.range_m == 3.21) == 1


def test_ranges_in_whole_metres_are_no_frozen_ones_and_their_rounding_is_noise(tmp_path: Path) -> None:
    run, said = read(tmp_path, each("range", lambda k, cells: [*cells[:3], f"{float(cells[3]):.0f}"]))
    assert run.range_step_m == pytest.approx(1.0)
    assert "repeats" not in said
    cfg = load_recordings_config()
    assert settings_of(run, cfg).radio.range_sigma_m == pytest.approx(np.hypot(0.1, 1.0 / np.sqrt(12.0)))
    track = estimate(run, cfg, "fixed-lag")
    assert any("ranges come in steps of 1 m: their noise is taken as 0.31 m, not" in line for line in track.warnings)
    fine, _ = read(tmp_path, lambda lines: lines)
    assert settings_of(fine, cfg) is cfg.csv


def test_a_step_far_beyond_the_run_is_a_gap(tmp_path: Path) -> None:
    run, said = read(tmp_path, with_value("odom", 2, "655.36", lambda k: k == 300))
    assert "1 step of the odometry forward beyond what the run does otherwise" in said
    assert "the first of 655 m at 30 s: taken as a gap" in said
    assert run.steps.distance_m.sum() == pytest.approx(W.distance_m.sum(), abs=0.05)


def test_single_positions_of_zero_or_elsewhere_are_no_truth(tmp_path: Path) -> None:
    zero = each("truth", lambda k, cells: ["truth", cells[1], "0", "0", "0"] if k % 100 == 0 else cells)
    run, said = read(tmp_path, zero)
    assert "7 rows of truth at zero (the first here, at 0 s), not used" in said
    run, said = read(tmp_path, with_value("truth", 2, "99", lambda k: k == 50))
    assert "1 row of truth that jump away from the others (the first here, at 5 s), not used" in said
    assert run.truth is not None
    assert run.truth.x_m.max() < 20.0


@pytest.mark.parametrize("row", [0, 600])
def test_the_first_and_the_last_position_of_the_truth_may_be_wrong(tmp_path: Path, row: int) -> None:
    run, said = read(tmp_path, with_value("truth", 2, "11.0", lambda k: k == row))
    assert f"1 row of truth that jump away from the others (the first here, at {row / 10:g} s), not used" in said
    assert run.first_pose == pytest.approx(W.poses[0], abs=0.06)  # a tenth of a second later at most


def test_the_run_begins_and_ends_where_its_motion_is_known(tmp_path: Path) -> None:
    lost = with_value("odom", 2, "nan", lambda k: 0 < k <= 20 or k > 580)
    run, said = read(tmp_path, lost)
    assert "the run begins here, at 2 s" in said
    assert "the run ends here, at 58 s" in said
    assert (run.steps.times_s[0], run.steps.times_s[-1]) == (2.0, 58.0)
    assert run.first_pose == pytest.approx(W.poses[20])
    assert np.all(np.asarray(run.steps.guess_m2) == 0.0)


def test_a_short_start_before_a_pause_is_not_used(tmp_path: Path) -> None:
    def paused(lines: list[str]) -> list[str]:
        return [line for line in lines if not (line.startswith("odom") and 0.3 < float(line.split(",")[1]) < 5.0)]

    run, said = read(tmp_path, paused)
    assert "the run begins here, at 5 s" in said
    assert run.first_pose == pytest.approx(W.poses[50])


@pytest.mark.parametrize("turns_heading", [True, False])
def test_a_heading_that_never_changes_is_none(tmp_path: Path, turns_heading: bool) -> None:
    run, said = read(tmp_path, with_value("truth", 4, "0", lambda _: True), turns_heading=turns_heading)
    assert "the truth has no heading: it is 0 rad throughout, while its course turns" in said
    assert run.truth is not None
    assert np.isnan(run.truth.heading_rad).all()
    assert run.first_pose[2] == pytest.approx(W.poses[0, 2], abs=0.02)


def test_the_course_of_a_vehicle_that_drives_sideways_is_no_error_of_its_heading(tmp_path: Path) -> None:
    """The odometry says that the vehicle moves 0.43 rad to the left of its heading, and so says the truth."""

    def sideways(_: int, cells: list[str]) -> list[str]:
        way = float(cells[2])
        return ["odom", cells[1], str(way * np.cos(0.43)), cells[3], str(way * np.sin(0.43))]

    turned = each("truth", lambda _, cells: [*cells[:4], str(float(cells[4]) - 0.43)])
    run, said = read(tmp_path, lambda lines: turned(each("odom", sideways)(lines)))
    assert "truth heading is turned" not in said
    assert run.first_pose[2] == pytest.approx(W.poses[0, 2] - 0.43)


AS_WRITTEN: dict[str, Callable[[FloatArray], FloatArray]] = {
    "in degrees": np.rad2deg,
    "clockwise from the y axis, as those of a compass": lambda h: 0.5 * np.pi - h,
    "in degrees clockwise from the y axis, as those of a compass": lambda h: np.rad2deg(0.5 * np.pi - h) % 360.0,
    "clockwise": lambda h: -h,
    "in degrees clockwise": lambda h: -np.rad2deg(h),
}


def with_truth_headings(w: World, headings: FloatArray) -> list[str]:
    rows = [f"truth,{t},{x},{y},{h}" for t, (x, y, _), h in zip(w.times_s, w.poses, headings, strict=True)]
    return [*(line for line in csv_lines(w) if not line.startswith("truth")), *rows]


@pytest.mark.parametrize("what", AS_WRITTEN)
@pytest.mark.parametrize("turns_heading", [True, False])
def test_headings_of_another_unit_or_direction_are_named_and_converted(
    what: str, turns_heading: bool, tmp_path: Path
) -> None:
    w = world()
    wrapped_rad = (w.poses[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    written = AS_WRITTEN[what](wrapped_rad)
    file = write_lines(tmp_path / "run.csv", with_truth_headings(w, written))
    run = read_run(file, None, None, turns_heading=turns_heading)
    done = "converted" if turns_heading else "used as they are"
    (said,) = (line for line in run.warnings if "headings" in line)
    assert said.startswith(f"headings of the truth fit its course {what}: they ")
    assert said.endswith(done)
    if turns_heading:
        assert run.truth is not None
        np.testing.assert_allclose(np.exp(1j * run.truth.heading_rad), np.exp(1j * w.poses[:, 2]), atol=1e-9)
        assert run.first_pose == pytest.approx((*w.poses[0, :2], wrapped_rad[0]))
        assert not any("true turns" in line or "other way" in line for line in run.warnings)


def test_headings_that_contradict_the_course_are_not_used(tmp_path: Path) -> None:
    w = world()
    headings = np.random.default_rng(1).uniform(-np.pi, np.pi, len(w.poses))
    run = read_run(write_lines(tmp_path / "run.csv", with_truth_headings(w, headings)), None, None)
    assert run.truth is not None
    assert np.isnan(run.truth.heading_rad).all()
    assert "headings of the truth contradict its course, with which the odometry agrees: not used" in run.warnings
    assert run.first_pose == pytest.approx(w.poses[0], abs=0.1)


def test_a_survey_in_another_frame_than_the_truth_is_named(tmp_path: Path) -> None:
    lines = [line for line in csv_lines(world()) if not line.startswith("beacon")]
    lines += [f"beacon,{name},{10.0 - y},{x - 7.0}" for name, (x, y) in BEACONS.items()]
    said = read_run(write_lines(tmp_path / "run.csv", lines), None, None).warnings
    assert any("the survey is in another frame than the truth" in line for line in said)
    assert any("turned by -1.57 rad" in line for line in said)
    assert not any("ranges read" in line or "miss its surveyed place" in line for line in said)


def test_headings_are_not_taken_as_clockwise_if_the_odometry_turns_the_other_way(tmp_path: Path) -> None:
    w = world()
    mirrored = [
        ",".join([*cells[:3], str(-float(cells[3])), *cells[4:]]) if (cells := line.split(","))[0] == "truth" else line
        for line in csv_lines(w)
    ]
    said = " | ".join(read_run(write_lines(tmp_path / "run.csv", mirrored), None, None).warnings)
    assert "headings of the truth fit" not in said


def test_a_turned_heading_can_be_kept(tmp_path: Path) -> None:
    turned = each("truth", lambda _, cells: [*cells[:4], str(float(cells[4]) + 1.0)])
    run, said = read(tmp_path, turned, turns_heading=False)
    assert "truth heading is turned by -1.000 rad against the course; it is used as it is" in said
    assert run.first_pose[2] == pytest.approx(W.poses[0, 2] + 1.0)
    run, said = read(tmp_path, turned)
    assert "it was turned back" in said
    assert run.first_pose[2] == pytest.approx(W.poses[0, 2], abs=0.05)


def scaled(kind: str, column: int, factor: float) -> Change:
    return each(kind, lambda _, cells: [*cells[:column], str(float(cells[column]) * factor), *cells[column + 1 :]])


def without(kind: str, then: Change) -> Change:
    return lambda lines: then([line for line in lines if not line.startswith(f"{kind},")])


def all_times(factor: float) -> Change:
    def change(lines: list[str]) -> list[str]:
        for kind in ("odom", "range", "truth"):
            lines = scaled(kind, 1, factor)(lines)
        return lines

    return change


def moved_clock(kind: str, by_s: float, from_s: float = 0.0) -> Change:
    def change(_: int, cells: list[str]) -> list[str]:
        time_s = float(cells[1])
        return [cells[0], str(time_s + by_s * (time_s > from_s)), *cells[2:]]

    return each(kind, change)


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (all_times(1000.0), "odometry comes every 100 s at 0.00065 m/s: are its times in milliseconds?"),
        (without("truth", scaled("range", 3, 1000.0)), "the odometry travels: are they in millimetres"),
        (without("truth", scaled("range", 3, 100.0)), "the odometry travels: are they in centimetres"),
        (without("truth", scaled("range", 3, 3.2808)), "the odometry travels: are they in feet?"),
        (without("truth", scaled("odom", 3, 57.29578)), "turns 0.0175 times as much: are its turns in degrees?"),
        (scaled("beacon", 2, 1000.0), "are their places in millimetres or centimetres?"),
        (moved_clock("truth", -3.0), "the truth fits the odometry best if taken 3 s later"),
        (without("truth", moved_clock("range", 3.0)), "ranges fit the odometry best if taken 3 s earlier"),
    ],
)  # fmt: skip
def test_a_unit_or_a_clock_of_another_kind_is_named(tmp_path: Path, change: Change, what: str) -> None:
    assert what in read(tmp_path, change)[1]


@pytest.mark.parametrize("kinds", [("range",), ("range", "bearing")])
def test_a_clock_of_readings_that_was_set_on_the_way_is_named(tmp_path: Path, kinds: tuple[str, ...]) -> None:
    left_out = {"truth", "bearing"} - {*kinds}
    lines = [line for line in csv_lines(world(seconds=240.0)) if line.split(",")[0] not in left_out]
    for kind in kinds:
        lines = moved_clock(kind, 1.5, 120.0)(lines)
    said = " | ".join(read_run(write_lines(tmp_path / "mine.csv", lines), None, None).warnings)
    assert re.search(r"in the second half of the run .* fit the odometry best if taken 1\.[456] s earlier", said)


Attack = Callable[[list[str], np.random.Generator], list[str]]


def one_row(kind: str, column: int, change: Callable[[float, np.random.Generator], float]) -> Attack:
    """A changed value in the first, the last or another row; the first odometry has no motion."""

    def attack(lines: list[str], rng: np.random.Generator) -> list[str]:
        count, first = sum(line.startswith(f"{kind},") for line in lines), int(kind == "odom")
        row = int(rng.choice((first, count - 1, int(rng.integers(first + 1, count - 1)))))

        def changed(k: int, cells: list[str]) -> list[str]:
            value = change(float(cells[column]), rng) if k == row else cells[column]
            return [*cells[:column], str(value), *cells[column + 1 :]]

        return each(kind, changed)(lines)

    return attack


def all_rows(kind: str, column: int, *factors: float) -> Attack:
    return lambda lines, rng: scaled(kind, column, float(rng.choice(factors)))(lines)


def set_clock(*kinds: str) -> Attack:
    """The clock of some events is off, in the whole run or from some time on."""

    def attack(lines: list[str], rng: np.random.Generator) -> list[str]:
        by_s, from_s = float(rng.choice((-1.0, 1.0)) * rng.uniform(2.0, 15.0)), float(rng.choice((0.0, 30.0)))
        for kind in kinds:
            lines = moved_clock(kind, by_s, from_s)(lines)
        return lines

    return attack


UNIT_FACTORS = (1000.0, 100.0, 1.0 / 0.3048)
ATTACKS: list[Attack] = [
    one_row("odom", 2, lambda v, rng: v + float(rng.choice((-65.536, 5.0, 1000.0 * v)))),
    one_row("odom", 2, lambda v, rng: float("nan")),
    one_row("odom", 3, lambda v, rng: v + float(rng.choice((-6.2832, 6.2832, 3.0)))),
    one_row("odom", 1, lambda v, rng: float(rng.choice((0.0, 1.7e9, v + 30.0)))),
    one_row("range", 1, lambda v, rng: float(rng.choice((0.0, 1.7e9, v - 20.0)))),
    one_row("range", 3, lambda v, rng: float(rng.choice((0.0, -1.0, 65.535, float("nan"))))),
    one_row("truth", 2, lambda v, rng: v + float(rng.choice((-8.0, 8.0)))),
    one_row("truth", 1, lambda v, rng: float(rng.choice((0.0, 1.7e9)))),
    all_rows("range", 3, *UNIT_FACTORS),
    all_rows("odom", 2, *UNIT_FACTORS),
    all_rows("odom", 3, 57.29578, -1.0),
    all_rows("beacon", 2, 1000.0, 100.0),
    set_clock("range"),
    set_clock("truth"),
    set_clock("odom"),
    lambda lines, rng: [*lines, *lines],
    lambda lines, rng: lines[::-1],
]
# What the reader says of the sound run: its odometry was made from its truth.
SOUND_SAYS = ("odometry distance equals the truth", "odometry turns equal the truth")


@pytest.mark.parametrize("seed", range(50))
def test_a_damage_is_mended_named_or_refused(tmp_path: Path, seed: int) -> None:
    """The run is that without the damage, or a line says what is wrong with it."""
    rng = np.random.default_rng(seed)
    lines = ATTACKS[seed % len(ATTACKS)](in_time_order(LINES), rng)
    try:
        run = read_run(write_lines(tmp_path / "mine.csv", lines), None, None)
    except RadioDataError:  # its text is one line, as of every refusal
        return
    if not all(line.startswith(SOUND_SAYS) for line in run.warnings):
        return
    path = dead_reckoned(run.steps, run.first_pose)
    at = [np.interp(run.steps.times_s, W.times_s, column) for column in W.poses.T]
    assert np.hypot(path[:, 0] - at[0], path[:, 1] - at[1]).max() < 0.05
    where = [np.interp(run.readings.times_s, W.times_s, column) for column in W.poses.T]
    places = np.array([BEACONS[name] for name in run.beacon_ids])[run.readings.beacon]
    expected_m = np.hypot(places[:, 0] - where[0], places[:, 1] - where[1])
    assert np.abs(run.readings.range_m - expected_m).max() < 0.3  # six sigmas


def test_a_check_that_fails_is_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: RecordedRun) -> list[str]:
        raise TypeError("expected non-empty vector")

    monkeypatch.setattr("ccatp.beacons.datasets.checks._gaps", fail)
    run, said = read(tmp_path, list)
    assert "the check of fail cannot be made on these data (expected non-empty vector)" in said
    assert run.readings.range_m.size == W.range_m.size


def test_of_a_beacon_with_ranges_the_levels_at_other_times_are_left_out(tmp_path: Path) -> None:
    """An estimator took a beacon's level for a range."""

    def heard_twice(lines: list[str]) -> list[str]:
        k = next(k for k, line in enumerate(lines) if line.startswith("range,") and float(line.split(",")[1]) > 20.0)
        _, at_s, name, *_ = lines[k].split(",")
        return [*lines[:k], f"rssi,{float(at_s) - 0.004:.3f},{name},-60.0", f"rssi,{at_s},{name},-60.0", *lines[k:]]

    whole, (run, said) = read(tmp_path, list)[0], read(tmp_path, heard_twice)
    assert "1 signal strength of" in said
    assert "not used: their beacons have ranges, too" in said
    assert len(run.readings.times_s) == len(whole.readings.times_s)
    assert np.isfinite(run.readings.rssi_dbm).sum() == 1  # the one beside a range
    assert estimate(run, load_recordings_config(), "ekf-slam").beacons.keys() == set(run.beacon_ids)
