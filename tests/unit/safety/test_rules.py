"""The danger rules of a robot that nothing but an emergency endangers."""

from ccatp.conditions.danger import NO_FRAME
from ccatp.core import EventCode, Verdict
from ccatp.links.topics import EstimateMessage
from ccatp.safety.rules import SafetyRules, emergency_rules
from tests.unit.test_danger import frame_of

NOTHING, ALL = (False, False, False), (True, True, True)


def judged(rules: SafetyRules, seq: int, state: str = "driving") -> Verdict:
    estimate = EstimateMessage(0.0, 0.0, 0.0, 0.0, state, seq=seq, t_s=0.01 * seq)
    return rules.judge(frame_of(seq, 0.01 * seq, [], []), b"", estimate)


def permits(verdict: Verdict | None) -> tuple[bool, bool, bool]:
    assert verdict is not None
    return verdict.forward, verdict.reverse, verdict.turn


def test_a_fresh_frame_permits_and_no_other() -> None:
    rules = emergency_rules(None)
    verdict = judged(rules, 5)
    assert (permits(verdict), verdict.code, bool(verdict.cause)) == (ALL, EventCode.NORMAL, False)
    assert verdict.seq == 5
    for denied in (judged(rules, 5), judged(rules, 4), rules.stale(5, 0.05), rules.garbled(5, 0.05, 0.06)):
        assert permits(denied) == NOTHING
        assert denied is not None
        assert denied.cause.condition == NO_FRAME.name
    assert permits(judged(rules, 6)) == ALL
    rules.reset()
    assert permits(judged(rules, 0)) == ALL


def test_an_emergency_leads_home_and_an_earthquake_holds_until_it_is_cleared() -> None:
    rules = emergency_rules(None)
    judged(rules, 1)
    assert rules.emergency("fire", "one") is None
    verdict = judged(rules, 2)
    assert (permits(verdict), verdict.code, rules.code) == (ALL, EventCode.ABORTED, EventCode.ABORTED)
    assert rules.emergency("earthquake", "two") is None
    verdict = judged(rules, 3)
    assert (permits(verdict), verdict.is_shaking) == (NOTHING, True)
    assert permits(rules.stale(3, 0.03)) == NOTHING
    assert not rules.at_base_or_held  # the estimate may be of before
    for seq in range(4, 40):
        judged(rules, seq, "held")
    assert rules.at_base_or_held
    assert [rules.clear(one, rules.at_base_or_held) for one in ("one", "two")] == [None, None]
    assert judged(rules, 40).code is EventCode.NORMAL
    assert rules.counts == {}
