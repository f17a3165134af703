"""What the table of conditions tells an operator stands on its own."""

import ast
import re
from math import inf
from pathlib import Path
from string import Formatter

import pytest
from msgspec.json import decode, encode
from msgspec.structs import replace

from ccatp import conditions
from ccatp.conditions import Condition, Owner, all_conditions, text_of
from ccatp.conditions.danger import FAN_WEAK, NO_ESTIMATE
from ccatp.conditions.mission import MEASUREMENTS_FAILED
from ccatp.core import NO_CAUSE, Cause

# A reference to another row, which an operator who reads one alarm does not see.
ELSEWHERE = re.compile(r"\b(as above|as for|the same (for|where|but)|see above)\b", re.IGNORECASE)


@pytest.mark.parametrize("row", all_conditions(), ids=lambda row: row.name)
def test_an_advice_refers_to_no_other_row(row: Condition) -> None:
    assert row.advice
    assert not ELSEWHERE.search(row.advice)


def test_the_text_of_a_cause_has_its_numbers_duration_repetition_and_what_is_found_besides() -> None:
    cause = FAN_WEAK.cause(side="left")
    assert text_of(cause) == "the left fan gets weak"
    assert text_of(replace(cause, lasted_s=30.0)) == "the left fan gets weak, for more than 30 s"
    assert text_of(replace(cause, repetition=2, besides=NO_ESTIMATE.cause())) == (
        "the left fan gets weak, on repetition 2; no estimate"
    )
    assert text_of(NO_CAUSE) == ""


def test_a_cause_of_another_version_is_shown_with_its_name_and_its_values() -> None:
    assert text_of(Cause("mirror_on_fire", {"at_m": 1.5})) == "mirror_on_fire (at_m 1.5)"
    assert text_of(Cause("fan_weak", {"which": "left"})) == "fan_weak (which left)"
    assert text_of(Cause("leg_overdue", {"x_m": "far", "y_m": 1.0})) == "leg_overdue (x_m far, y_m 1.0)"


# Numbers in a text that stays while the condition lasts: limits, and measured values of what happened once.
LIMITS = {"limit_s", "limit_ms", "budget_s", "time_s", "least"}
EVENTS = {"late_ms", "charge", "x_m", "y_m", "v_m_s", "omega_rad_s", "distance_m", "ratio", "ms"}
# Faults: nothing is counted after them.
COUNTED = {
    "back_offs", "measurements_failed", "laser_not_following", "target_lost", "map_stalled", "readings_refused",
}  # fmt: skip
RENEWED = {"sensor_much_too_slow", "sensor_too_slow", "metrology_unreliable"}  # found again, with its new number


# What robots of every kind of mission meet: of the main loop, the link and the observatory, and in the safety rules.
OF_EVERY_MISSION = {"operator", "emergency", "earthquake", "no_frame", "encoders_stale"}
OF_A_SURVEY = re.compile(r"\b(survey|points?|panels?|mirror|laser|puck|rim)\b|--resume")


@pytest.mark.parametrize(
    "row",
    [row for row in all_conditions() if row.owner in (Owner.MAIN, Owner.LINK) or row.name in OF_EVERY_MISSION],
    ids=lambda row: row.name,
)
def test_an_advice_for_every_mission_does_not_speak_of_a_survey(row: Condition) -> None:
    assert not OF_A_SURVEY.search(f"{row.advice} {row.then}")


@pytest.mark.parametrize("row", all_conditions(), ids=lambda row: row.name)
def test_no_text_has_a_number_that_grows_while_the_condition_lasts(row: Condition) -> None:
    parts = {name for _, name, _, _ in Formatter().parse(row.message) if name}
    numbers = {name for name in parts - LIMITS - EVENTS if unit_of(ast.Name(name)) or name in NUMBERS}
    assert not numbers or row.name in COUNTED | RENEWED


def test_values_travel_as_numbers_or_text() -> None:
    cause = MEASUREMENTS_FAILED.cause(count=3, why=ValueError("no fix"), share=inf)
    assert cause.values == {"count": 3, "why": "no fix", "share": "inf"}
    assert decode(encode(cause), type=Cause) == cause


NUMBERS = {"count", "rate", "share"}
UNITS = {"_m_s": "m/s", "_rad_s": "rad/s", "_hz": "Hz", "_m": "m", "_rad": "rad", "_s": "s"}
PACKAGE = Path(conditions.__file__).parents[1]
NAMED = (ast.Name, ast.Attribute)
ROWS = {row.name.upper(): row for row in all_conditions()}


def unit_of(value: ast.expr) -> str | None:
    """The unit in the name of a value, or None."""
    name = value.id if isinstance(value, ast.Name) else value.attr if isinstance(value, ast.Attribute) else ""
    return next((unit for suffix, unit in UNITS.items() if name.endswith(suffix)), None)


def rows_found() -> list[tuple[str, str, set[str]]]:
    """Where each row is found: file and line, name of the row, and the units in the names of value and limit."""
    seen: list[tuple[str, str, set[str]]] = []
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if ".found(" not in text and "FoundEdge(" not in text:
            continue  # to parse every module takes seconds
        tree = ast.parse(text)
        functions = [one for one in ast.walk(tree) if isinstance(one, ast.FunctionDef)]
        for function in functions:
            chosen: dict[str, list[str]] = {}  # rows of a variable that is one of several
            for one in ast.walk(function):
                if isinstance(one, ast.Assign) and isinstance(target := one.targets[0], ast.Name):
                    chosen[target.id] = [name for name in names_in(one.value) if name in ROWS]
            for call in ast.walk(function):
                if not isinstance(call, ast.Call) or len(call.args) < 3:
                    continue
                if isinstance(call.func, ast.Attribute) and call.func.attr == "found":
                    row, values = names_in(call.func.value), call.args[1:3]
                elif isinstance(call.func, ast.Name) and call.func.id == "FoundEdge":
                    row, values = names_in(call.args[0]), call.args[1:3]
                else:
                    continue
                units = {unit for value in values if (unit := unit_of(value)) is not None}
                for name in row:
                    seen += [(f"{path.name}:{call.lineno}", one, units) for one in chosen.get(name, [name])]
    return [one for one in seen if one[1] in ROWS]


def names_in(value: ast.expr) -> list[str]:
    return [one.attr if isinstance(one, ast.Attribute) else one.id for one in ast.walk(value) if isinstance(one, NAMED)]


def test_the_unit_of_a_row_is_that_of_the_values_it_is_found_with() -> None:
    found = rows_found()
    wrong = [(where, name) for where, name, units in found if units - {ROWS[name].unit}]
    assert wrong == []
    assert sum(bool(units) for _, _, units in found) > 25
