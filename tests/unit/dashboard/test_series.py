"""What grows, and what of it is new."""

from itertools import pairwise

from ccatp.report.dashboard.view import Growing, Lines, Trail


def test_what_is_new_is_told_once() -> None:
    grown = Growing(100)
    grown.add(1.0, 2.0)
    grown.add(2.0, 3.0)
    assert grown.take_new() == [(1.0, 2.0), (2.0, 3.0)]
    assert grown.take_new() == []
    grown.add(3.0, 4.0)
    assert grown.take_new() == [(3.0, 4.0)]
    assert grown.rows == [(1.0, 2.0), (2.0, 3.0), (3.0, 4.0)]


def test_the_older_half_gets_thin_and_the_newer_stays() -> None:
    grown = Growing(100)
    for k in range(1000):
        grown.add(k)
        assert len(grown.rows) <= 100
    kept = [row[0] for row in grown.rows]
    assert kept[-40:] == list(range(960, 1000))
    assert kept[0] < 100  # and it still begins where it began
    assert kept == sorted(kept)


def test_nobody_takes_for_long() -> None:
    grown = Growing(10)
    for k in range(100):
        grown.add(k)
    assert grown.take_new() == [(k,) for k in range(90, 100)]


def test_the_trail_leaves_out_what_nobody_sees() -> None:
    trail = Trail(100)
    for k in range(101):
        trail.add(0.001 * k, 1.0)
    steps_m = [b[0] - a[0] for a, b in pairwise(trail.rows)]
    assert len(steps_m) >= 4
    assert min(steps_m) > 0.0199  # rounded to 1 mm
    assert max(steps_m) < 0.0221


def test_lines_are_the_last_ones() -> None:
    lines = Lines(3)
    for k in range(5):
        lines.add(k, "info", "text" + "x" * k)
    assert [row[0] for row in lines.rows] == [2, 3, 4]
    assert [row[0] for row in lines.take_new()] == [2, 3, 4]
    assert lines.take_new() == []


def test_a_line_that_comes_again_is_one_row_with_its_newest_text() -> None:
    lines = Lines(200)
    lines.add(0.5, "warning", "process main was killed")
    for k in range(300):
        lines.add(k, "warning", f"held: a frame was served {k} ms late")
        lines.add(k, "warning", "going on: turning")
        if k == 9:
            lines.take_new()
    late = (299, "warning", "held: a frame was served 299 ms late", 300, 2)
    assert lines.rows == [
        (0.5, "warning", "process main was killed", 1, 1),
        late,
        (299, "warning", "going on: turning", 300, 3),
    ]
    assert lines.take_new() == lines.rows[1:]
