"""The estimate against the simulated truth."""

import pytest

from ccatp.report.dashboard.view import WAITING, Second, TruthCompare


def test_the_worst_of_each_second_is_told_when_the_next_begins() -> None:
    compare = TruthCompare()
    done = []
    for k in range(25):
        seq, t_s = 10 * k, 0.1 * k + 0.05
        error_m = 0.003 if k == 7 else 0.001
        done += compare.estimate(seq, 1.0 + error_m, 2.0, 0.002)
        done += compare.truth([(seq, t_s, 1.0, 2.0)])
    assert [round(second.t_s, 2) for second in done] == [0.75, 1.05]
    assert done[0].error_mm == pytest.approx(3.0)
    assert done[1].error_mm == pytest.approx(1.0)
    assert done[0].three_sigma_mm == pytest.approx(6.0)


def test_either_may_come_first() -> None:
    first, second = TruthCompare(), TruthCompare()
    truth = [(seq, 0.01 * seq, 0.0, 0.0) for seq in range(300)]
    one: list[Second] = first.truth(truth)
    two: list[Second] = []
    for seq in range(0, 300, 10):
        one += first.estimate(seq, 0.001, 0.0, 0.001)
        two += second.estimate(seq, 0.001, 0.0, 0.001)
    two += second.truth(truth)
    assert one == two
    assert len(one) == 2


def test_what_has_no_other_half_is_forgotten() -> None:
    compare = TruthCompare()
    for k in range(WAITING + 1):
        assert compare.estimate(10 * k, 0.0, 0.0, 0.001) == []
    assert compare.truth([(0, 0.0, 0.0, 0.0)]) == []
    assert compare.truth([(10, 0.5, 0.0, 0.0), (20, 1.5, 0.0, 0.0)]) == [Second(0.5, 0.0, 3.0)]


def test_frames_between_are_not_compared() -> None:
    compare = TruthCompare()
    assert compare.truth([(seq, 5.0 * seq, 0.0, 0.0) for seq in range(1, 10)]) == []
    assert not TruthCompare.is_compared(7)
    assert TruthCompare.is_compared(20)
