"""Links in virtual time, what grows during a run, and the estimate against the simulated truth."""

from itertools import pairwise

import pytest

from ccatp.links.topics import Heartbeat
from ccatp.report.dashboard.view import WAITING, Growing, Lines, Links, Second, Trail, TruthCompare


def presence(process: str, t_s: float, *, pid: int = 1, phase: str = "joined", age_s: float | None = 0.01) -> Heartbeat:
    return Heartbeat(seq=0, t_s=t_s, process=process, pid=pid, phase=phase, frame_age_s=age_s)


@pytest.fixture
def links() -> Links:
    links = Links()
    links.presence(presence("main", 10.0))
    links.presence(presence("danger", 10.0))
    return links


def whats(links: Links, now_s: float) -> list[str]:
    return [loss.what for loss in links.losses(now_s)]


def test_before_anybody_spoke_nothing_is_lost_but_it_is_not_well() -> None:
    links = Links()
    assert links.losses(10.0) == []
    assert links.trouble(10.0) == "main has sent no heartbeat"
    assert [link.phase for link in links.shown(10.0)] == [
        "no heartbeat yet",
        "no heartbeat yet",
        "no frame yet",
        "no fix yet",
    ]


def test_all_is_well(links: Links) -> None:
    assert links.losses(10.1) == []
    assert links.trouble(10.1) == ""
    links.fix_s = 9.0
    shown = {link.name: link for link in links.shown(10.1)}
    assert all(link.is_well for link in shown.values())
    assert shown["robot"].age_s == pytest.approx(0.11)
    assert shown["laser"].age_s == pytest.approx(1.1)


def test_a_loop_that_says_nothing(links: Links) -> None:
    links.presence(presence("danger", 10.9))
    assert whats(links, 10.95) == []
    assert whats(links, 11.05) == ["the main loop has not reported"]
    assert links.trouble(11.05) == "the main loop has not reported for 1.1 s"
    assert whats(links, 12.0) == ["the main loop has not reported", "the danger loop has not reported"]


def test_pictures_that_were_wanted_and_do_not_come_show_it_sooner(links: Links) -> None:
    links.picture_s = 10.0
    assert whats(links, 10.75) == []
    assert whats(links, 10.85) == ["the main loop has not reported"]
    links.picture_s = None
    assert whats(links, 10.85) == []


def test_a_loop_that_is_gone_shows_at_once_and_until_another_one_speaks(links: Links) -> None:
    links.cut("main", 10.2)
    assert str(links.losses(10.3)[0]) == "the main loop is gone for 0.1 s"
    links.cut("main", 10.3)
    links.presence(presence("main", 10.15))  # one of its last words, which was on its way
    assert links.losses(10.7)[0].for_s == pytest.approx(0.5)
    links.picture_s = 10.1
    links.presence(presence("main", 11.0, pid=2, phase="starting", age_s=None))
    assert links.losses(11.0) == []
    assert links.restarts == {"main": 1, "danger": 0}


def test_a_connection_that_came_back_is_no_loss(links: Links) -> None:
    links.cut("danger", 10.2)
    links.presence(presence("danger", 10.4))
    assert links.losses(10.45) == []
    assert links.restarts["danger"] == 0


def test_the_robot_is_away(links: Links) -> None:
    links.presence(presence("main", 10.5, phase="rejoining", age_s=0.5))
    links.presence(presence("danger", 10.5))
    assert whats(links, 10.6) == ["the robot has been away"]
    assert not next(link for link in links.shown(10.6) if link.name == "robot").is_well


def test_the_robot_sends_nothing(links: Links) -> None:
    links.presence(presence("main", 11.0, age_s=0.95))
    links.presence(presence("danger", 11.0))
    assert whats(links, 11.04) == []
    assert whats(links, 11.1) == ["the robot has sent no frame"]


def test_after_the_end_nothing_is_lost(links: Links) -> None:
    assert whats(links, 20.0) != []
    links.is_over = True
    assert links.losses(20.0) == []
    assert links.trouble(20.0) == ""


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


def test_the_worst_of_each_second_is_told_when_the_next_begins() -> None:
    compare = TruthCompare()
    found: list[Second | None] = []
    for k in range(25):
        error_m = 0.003 if k == 7 else 0.001
        found += [compare.estimate(10 * k, 1.0 + error_m, 2.0, 0.002), compare.truth(10 * k, 0.1 * k + 0.05, 1.0, 2.0)]
    done = [second for second in found if second is not None]
    assert [round(second.t_s, 2) for second in done] == [0.75, 1.05]
    assert done[0].error_mm == pytest.approx(3.0)
    assert done[1].error_mm == pytest.approx(1.0)
    assert done[0].three_sigma_mm == pytest.approx(6.0)


def test_either_may_come_first() -> None:
    first, second = TruthCompare(), TruthCompare()
    one = [first.truth(seq, 0.01 * seq, 0.0, 0.0) for seq in range(300)]
    two = []
    for seq in range(0, 300, 10):
        one.append(first.estimate(seq, 0.001, 0.0, 0.001))
        two.append(second.estimate(seq, 0.001, 0.0, 0.001))
    two += [second.truth(seq, 0.01 * seq, 0.0, 0.0) for seq in range(300)]
    assert [found for found in one if found] == [found for found in two if found]
    assert len([found for found in one if found]) == 2


def test_what_has_no_other_half_is_forgotten() -> None:
    compare = TruthCompare()
    for k in range(WAITING + 1):
        assert compare.estimate(10 * k, 0.0, 0.0, 0.001) is None
    assert compare.truth(0, 0.0, 0.0, 0.0) is None
    assert compare.truth(10, 0.1, 0.0, 0.0) is None
    assert compare.truth(10 * WAITING, 1.5, 0.0, 0.0) == Second(0.1, 0.0, 3.0)


def test_frames_between_are_not_compared() -> None:
    compare = TruthCompare()
    for seq in range(1, 10):
        compare.estimate(seq, 0.0, 0.0, 0.001)
        assert compare.truth(seq, 5.0 * seq, 0.0, 0.0) is None
    assert [TruthCompare.is_compared(seq) for seq in (7, 20)] == [False, True]
