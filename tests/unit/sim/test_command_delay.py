"""Commands that wait on their way."""

from math import inf, nan

import pytest

from ccatp.sim.rules import CommandDelay, FanRules, MotionRules

DT_S = 0.01


class Rig:
    def __init__(self, frames: int, ttl_s: float = 0.25) -> None:
        self.rules, self.fans = MotionRules(ttl_s, 8.0), FanRules(0.0)
        self.delay = CommandDelay(self.rules, self.fans, frames)

    def moves(self, frame: int) -> bool:
        """Whether the wheels turn in the step after ``frame``."""
        self.delay.release(frame)
        return self.rules.set_points((frame + 1) * DT_S) != (0.0, 0.0)


@pytest.mark.parametrize("frames", [0, 1, 2, 5])
def test_a_drive_takes_effect_to_the_frame(frames: int) -> None:
    rig = Rig(frames)
    for frame in range(10):
        if frame == 3:
            assert rig.delay.drive(frame, 7, 3.0, 3.0, 0.03)
        assert rig.moves(frame) is (frame >= 3 + frames)
        # What is in force is echoed, and its age counts from its arrival.
        seq, age_s, _, _ = rig.rules.echo((frame + 1) * DT_S)
        assert seq == (7 if frame >= 3 + frames else -1)
        if seq == 7:
            assert age_s == pytest.approx((frame - 2) * DT_S, abs=1e-12)


@pytest.mark.parametrize("frames", [0, 2])
def test_a_permit_takes_effect_to_the_frame(frames: int) -> None:
    rig = Rig(frames)
    rig.delay.join_monitor()
    rig.rules.join_monitor()
    for frame in range(8):
        rig.delay.drive(frame, frame, 3.0, 3.0, frame * DT_S)
        if frame in {2, 5}:
            assert rig.delay.permit(frame, frame, (frame == 2, False, False), frame * DT_S)
        assert rig.moves(frame) is (2 + frames <= frame < 5 + frames)


@pytest.mark.parametrize("frames", [0, 3])
def test_fans_follow_to_the_frame(frames: int) -> None:
    rig = Rig(frames)
    assert rig.delay.fans(1, 1, 0.5, 0.6)
    for frame in range(1, 8):
        rig.delay.release(frame)
        assert rig.fans.duty == ((0.5, 0.6) if frame >= 1 + frames else (0.0, 0.0))


def test_the_time_to_live_covers_the_delay() -> None:
    rig = Rig(2, ttl_s=0.05)
    rig.delay.drive(0, 1, 3.0, 3.0, 0.0)
    assert [rig.moves(frame) for frame in range(8)] == [False, False, True, True, True, False, False, False]


@pytest.mark.parametrize("frames", [0, 2])
def test_only_what_is_newer_is_taken(frames: int) -> None:
    delay = Rig(frames).delay
    assert [delay.drive(0, seq, 1.0, 1.0, 0.0) for seq in (5, 5, 4, 6)] == [True, False, False, True]
    assert [delay.permit(0, seq, (True, True, True), 0.0) for seq in (5, 5, 4, 6)] == [True, False, False, True]
    assert [delay.fans(0, seq, 0.5, 0.5) for seq in (5, 5, 4, 6)] == [True, False, False, True]


@pytest.mark.parametrize("frames", [0, 2])
@pytest.mark.parametrize("bad", [nan, inf])
def test_numbers_that_are_not_finite_are_dropped(frames: int, bad: float) -> None:
    delay = Rig(frames).delay
    assert not delay.drive(0, 1, bad, 1.0, 0.0)
    assert not delay.drive(0, 1, 1.0, bad, 0.0)
    assert not delay.fans(0, 1, bad, 0.5)
    assert delay.drive(0, 1, 1.0, 1.0, 0.0)
    assert delay.fans(0, 1, 0.5, 0.5)


def test_what_is_on_its_way_goes_with_its_session() -> None:
    rig = Rig(2)
    rig.rules.join_monitor()
    rig.delay.drive(0, 10, 3.0, 3.0, 0.0)
    rig.delay.permit(0, 10, (True, True, True), 0.0)
    rig.delay.fans(0, 10, 0.7, 0.7)
    rig.delay.lose_controller()
    rig.rules.lose_controller()
    assert not any(rig.moves(frame) for frame in range(5))
    assert rig.fans.duty == (0.7, 0.7)  # fans are not changed by a lost session
    rig.delay.drive(5, 0, 3.0, 3.0, 0.05)  # the next one counts anew
    assert [rig.moves(frame) for frame in range(5, 8)] == [False, False, True]
    rig.delay.permit(7, 11, (False, False, False), 0.07)
    rig.delay.lose_monitor()
    assert rig.moves(9)


def test_fans_of_the_session_before_do_not_outrank_the_next() -> None:
    rig = Rig(2)
    rig.delay.fans(0, 5000, 0.7, 0.7)
    rig.delay.join_controller()
    rig.fans.join_controller()
    assert rig.fans.duty == (0.7, 0.7)  # accepted is accepted
    assert rig.delay.fans(1, 0, 0.3, 0.3)
    rig.delay.release(3)
    assert rig.fans.duty == (0.3, 0.3)
