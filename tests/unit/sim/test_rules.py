"""The robot's own rules, as stories in virtual time. Every test starts from "held"."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ccatp.sim.rules import HELD, FanRules, MotionRules

TTL_S, FASTEST = 0.25, 8.0


def rules(*, monitor: bool = False) -> MotionRules:
    made = MotionRules(TTL_S, FASTEST)
    made.join_controller()
    if monitor:
        made.join_monitor()
    return made


def test_nothing_moves_without_a_drive() -> None:
    r = rules()
    assert r.set_points(0.01) == HELD
    assert r.is_held
    assert r.echo(0.5) == (-1, 0.5, 0.5, True)


def test_one_key_is_enough_until_a_monitor_has_joined() -> None:
    r = rules()
    assert r.drive(1, 3.0, 2.0, 0.0)
    assert r.set_points(0.01) == (3.0, 2.0)
    r.join_monitor()
    assert r.set_points(0.01) == HELD
    assert r.permit(1, True, False, True, 0.0)
    assert r.set_points(0.01) == (3.0, 2.0)
    r.lose_monitor()
    assert r.set_points(0.01) == HELD  # for the rest of this boot
    r.join_monitor()
    assert r.set_points(0.01) == HELD


def test_a_drive_dies_with_its_time_to_live() -> None:
    r = rules()
    r.drive(1, 3.0, 3.0, 1.0)
    assert r.set_points(1.25) == (3.0, 3.0)
    assert r.set_points(1.2501) == HELD
    seq, age_s, permit_age_s, is_held = r.echo(1.26)
    assert (seq, is_held) == (1, True)
    assert (age_s, permit_age_s) == pytest.approx((0.26, 1.26))
    r.drive(2, 3.0, 3.0, 1.26)
    assert r.set_points(1.27) == (3.0, 3.0)


def test_a_permit_dies_with_its_time_to_live() -> None:
    r = rules(monitor=True)
    r.permit(1, True, True, True, 0.0)
    for k in range(1, 40):
        t = 0.01 * k
        r.drive(k, 3.0, 3.0, t - 0.01)
        assert (r.set_points(t) == HELD) == (k > 25)


@pytest.mark.parametrize(
    ("drive", "needs"),
    [
        ((3.0, 3.0), "forward"),
        ((-3.0, -3.0), "reverse"),
        ((3.0, -3.0), "turn"),
        ((3.0, 2.0), "forward turn"),
        ((-3.0, 2.0), "reverse turn"),
        ((0.0, 1e-9), "forward turn"),
        ((0.0, 0.0), ""),
    ],
)
def test_directions(drive: tuple[float, float], needs: str) -> None:
    for bits in range(8):
        allowed = {name for k, name in enumerate(("forward", "reverse", "turn")) if bits >> k & 1}
        r = rules(monitor=True)
        r.drive(1, *drive, 0.0)
        r.permit(1, "forward" in allowed, "reverse" in allowed, "turn" in allowed, 0.0)
        may = set(needs.split()) <= allowed
        assert r.set_points(0.01) == (drive if may else HELD)
        assert r.is_held is not may


def test_only_newer_sequence_numbers_count() -> None:
    r = rules(monitor=True)
    assert r.permit(5, True, False, False, 0.0)
    assert r.drive(5, 3.0, 3.0, 0.0)
    for old in (5, 4, 0):
        assert not r.drive(old, -3.0, -3.0, 0.1)
        assert not r.permit(old, False, True, True, 0.1)
    assert r.set_points(0.2) == (3.0, 3.0)
    assert r.set_points(0.26) == HELD  # the old ones refreshed nothing
    assert r.echo(0.26)[0] == 5
    assert r.echo(0.26)[1] == pytest.approx(0.26)


def test_a_new_session_starts_anew() -> None:
    r = rules()
    r.drive(1000, 3.0, 3.0, 0.0)
    r.lose_controller()
    assert r.set_points(0.01) == HELD
    r.join_controller()
    assert r.set_points(0.01) == HELD
    assert r.drive(0, 1.0, 1.0, 0.01)
    assert r.set_points(0.02) == (1.0, 1.0)


def test_a_drive_that_is_too_fast_keeps_its_path() -> None:
    r = rules()
    r.drive(1, 16.0, -8.0, 0.0)
    assert r.set_points(0.01) == (8.0, -4.0)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_numbers_that_are_not_finite_are_dropped(value: float) -> None:
    r, fans = rules(), FanRules(0.0)
    r.drive(1, 3.0, 3.0, 0.0)
    assert not r.drive(2, value, 0.0, 0.1)
    assert not r.drive(2, 0.0, value, 0.1)
    assert r.set_points(0.2) == (3.0, 3.0)
    assert not fans.command(1, value, 0.5)
    assert not fans.command(1, 0.5, value)
    assert fans.duty == (0.0, 0.0)


def test_fans_keep_their_floor_and_their_duty() -> None:
    fans = FanRules(0.6)
    assert fans.duty == (0.6, 0.6)
    assert fans.command(1, 0.0, 0.9)
    assert fans.duty == (0.6, 0.9)
    assert not fans.command(1, 1.0, 1.0)
    assert not fans.command(0, 1.0, 1.0)
    fans.join_controller()
    assert fans.duty == (0.6, 0.9)
    assert fans.command(0, 2.0, 0.7)
    assert fans.duty == (1.0, 0.7)
    fans.health = (1.0, 0.0)
    assert fans.thrust == 0.5


EVENTS = st.one_of(
    st.tuples(st.just("drive"), st.integers(0, 20), st.floats(-20, 20), st.floats(-20, 20)),
    st.tuples(st.just("permit"), st.integers(0, 20), st.booleans(), st.booleans(), st.booleans()),
    st.sampled_from([("join_controller",), ("join_monitor",), ("lose_controller",), ("lose_monitor",)]),
    st.tuples(st.just("wait"), st.floats(0.0, 0.3)),
)


@given(st.lists(EVENTS, max_size=40))
def test_wheels_turn_only_with_both_keys(events: list[tuple[object, ...]]) -> None:
    """Invariant I1 against a plain model that remembers the newest of each kind."""
    r = MotionRules(TTL_S, FASTEST)
    now, needs_permit = 0.0, False
    drive: tuple[int, float, float, float] | None = None
    permit: tuple[int, bool, bool, bool, float] | None = None
    drive_seq = permit_seq = -1
    for name, *args in events:
        if name == "wait":
            now += float(args[0])  # type: ignore[arg-type]
        elif name in ("drive", "permit"):
            getattr(r, str(name))(*args, now)
            if name == "drive" and args[0] > drive_seq:  # type: ignore[operator]
                drive = (*args, now)  # type: ignore[assignment]
                drive_seq = args[0]  # type: ignore[assignment]
            elif name == "permit" and args[0] > permit_seq:  # type: ignore[operator]
                permit = (*args, now)  # type: ignore[assignment]
                permit_seq = args[0]  # type: ignore[assignment]
        else:
            getattr(r, str(name))()
            if str(name).endswith("controller"):
                drive, drive_seq = None, -1 if name == "join_controller" else drive_seq
            else:
                permit, permit_seq = None, -1 if name == "join_monitor" else permit_seq
                needs_permit |= name == "join_monitor"
        right, left = r.set_points(now + 0.01)
        assert max(abs(right), abs(left)) <= FASTEST * (1 + 1e-12)
        if (right, left) != HELD:
            assert drive is not None
            assert now + 0.01 - drive[3] <= TTL_S + 1e-8
            assert (right + left > 0) == (drive[1] + drive[2] > 0)
            if needs_permit:
                assert permit is not None
                assert now + 0.01 - permit[4] <= TTL_S + 1e-8
                assert permit[1] or right + left <= 0
                assert permit[2] or right + left >= 0
                assert permit[3] or right == left
