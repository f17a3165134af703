"""One panel that the simulated robot surveys with errors of the network: what is injected is in the lengths."""

import numpy as np
import pytest

from ccatp.mirror.network_model import Effect, EffectKind
from tools.network_surveys import Change, Drawn, Surveyed, draw, judge, rows, survey, totals


@pytest.fixture(scope="module")
def surveyed() -> Surveyed:
    drawn = draw(0, 1)
    change = Change(Effect(EffectKind.OFFSET, 3), 0.0, np.array([8e-4]))
    return survey(drawn._replace(kind="offset", changes=(change,)), panels=1)


def test_a_survey_is_judged_by_what_was_injected(surveyed: Surveyed) -> None:
    found = judge(surveyed)
    assert (found.panels, found.planned) == (1, 1)
    # The directions to a collimator hardly differ on one panel: offset, or a move along the beam.
    assert "channel 4 reads" in found.said
    assert (found.false, found.missed) == (0, 0)
    assert found.after_m < 4.0 * found.stated_m
    (line,) = rows([found])[2:]
    assert "offset 4 +800.0 um" in line
    assert "1 changes injected" in totals([found])[2]


def test_each_survey_is_its_own_and_the_same_again() -> None:
    def text(drawn: Drawn) -> str:
        return repr(drawn)

    texts = [text(draw(number, 1)) for number in range(20)]
    assert len(set(texts)) == 20
    assert texts[7] == text(draw(7, 1))
