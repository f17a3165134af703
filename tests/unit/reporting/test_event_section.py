"""The log on the page: floods are one row, and what matters comes first."""

from ccatp.records.state_log import LogLine
from ccatp.report.html import environment, events_of, gathered


def events_body(lines: list[LogLine]) -> str:
    macros = environment().get_template("macros.html").module
    return str(macros.log_events(events_of(lines)))  # type: ignore[attr-defined]


def line(text: str, level: str = "warning", t_s: float | None = 1.0, process: str = "main") -> LogLine:
    return LogLine("2026-01-01T12:00:00.5Z", t_s, level, process, text)


LATE = [line(f"late frame: lag {0.05 + 0.001 * k:.3f} s, limit 0.05 s", t_s=1.0 * k) for k in range(300)]
GRAVE = (
    line("process main was killed by SIGKILL: restarting it, wheels held meanwhile", t_s=None, process="supervisor"),
    line("operator: abort", level="info", t_s=350.0),
    line("held for 30 s, waiting for an operator: stuck", level="error", t_s=360.0),
)


def test_a_flood_hides_nothing() -> None:
    before, folded = events_body([*LATE, *GRAVE]).split("<details>")
    rows = before.split("<tr>")[2:]
    assert len(rows) == 4
    for row, found in zip(rows, ("held for 30 s", "was killed", "operator: abort", "late frame"), strict=True):
        assert found in row
    assert "<td>300</td>" in rows[3]
    assert '<th scope="row">0.00 s</th><td>299.00 s</td>' in rows[3]
    assert "lag 0.050 to 0.349 s, limit 0.05 s" in rows[3]
    assert "12:00:00" in rows[1]  # the supervisor knows no robot time
    assert folded.count("<tr>") == 1 + 303


def test_kinds_beyond_the_limit_are_counted_and_errors_are_always_there() -> None:
    words = [f"{chr(97 + k // 26)}{chr(97 + k % 26)}" for k in range(60)]
    calm = [line(f"calm {word}", level="info") for word in words]
    before, _ = events_body([*calm, *(line(f"careful {word}") for word in words)]).split("<details>")
    assert before.count("careful") == 40
    assert "and 20 more kinds of warnings" in before
    assert "calm" not in before
    before, _ = events_body([line(f"broken {word}", level="error") for word in words]).split("<details>")
    assert before.count("broken") == 60
    assert "more kinds" not in before


def test_names_of_points_are_no_numbers() -> None:
    texts = [f"measurement of 1-{k}-7 failed: no fix" for k in range(3)]
    (kind,) = gathered([line(text) for text in texts])
    assert kind.text == "measurement of 1-0-7 and 2 others failed: no fix"


def test_few_lines_are_all_there_as_they_are() -> None:
    body = events_body(LATE[:3])
    assert "<details>" not in body
    assert body.count("late frame") == 3
