"""Tables, and the time that is left."""

import pytest

from ccatp.studies.campaign import Column
from ccatp.studies.job_store import table, time_left


def test_a_table_has_the_factors_first() -> None:
    rows = [
        {
            "world": "hard",
            "runs": 2,
            "error": {"mean": 1.2345, "band": [0.5, 2.0]},
            "ratio": None,
            "causes": ["a", "b"],
        },
        {"world": "thesis", "runs": 1, "error": {"mean": 2, "band": None}, "ratio": 1.5, "causes": []},
    ]
    columns = [Column("mean, mm", "error.mean", ".2f"), Column("band", "error.band", ".1f"), Column("ratio", "ratio")]
    assert table(rows, [*columns, Column("gone", "error.gone"), Column("by", "causes")]).splitlines() == [
        "| world | runs | mean, mm | band | ratio | gone | by |",
        "|---|---|---|---|---|---|---|",
        "| hard | 2 | 1.23 | 0.5 to 2.0 | - | - | a; b |",
        "| thesis | 1 | 2.00 | - | 1.5 | - | - |",
    ]


@pytest.mark.parametrize(
    ("elapsed_s", "done_s", "left_s", "text"),
    [(10.0, 20.0, 40.0, "0:00:20 left"), (3600.0, 1.0, 1.5, "1:30:00 left"), (1.0, 0.0, 5.0, "0:00:00 left")],
)
def test_the_time_left_follows_the_pace(elapsed_s: float, done_s: float, left_s: float, text: str) -> None:
    assert time_left(elapsed_s, done_s, left_s) == text
