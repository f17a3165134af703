"""Hints in complaints about a configuration."""

from ccatp.config.messages import choice_hint, faults_of, slip_hint


def test_the_longest_suffix_tells_the_unit() -> None:
    assert slip_hint(("limits", "v_max_m_s"), 100.0, 0.3) == "; looks like mm/s: 100 mm/s are 0.1 m/s"
    assert slip_hint(("limits", "omega_max_rad_s"), 60.0, 5.0) == "; looks like deg/s: 60 deg/s are 1.0472 rad/s"
    assert slip_hint(("robot", "edge_sensors_m", 0, 1), 90.0, 2.0).endswith("are 0.09 m")


def test_no_unit_is_guessed_that_would_not_fit_either() -> None:
    assert slip_hint(("robot", "wheel_radius_m"), 3000.0, 0.2) == ""
    assert slip_hint(("robot", "port"), 70000.0, 65535.0) == ""


def test_a_choice_names_the_nearest_and_all() -> None:
    assert choice_hint("fyst-m1x", ["fyst-m2", "fyst-m1"]) == "did you mean fyst-m1? available: fyst-m1, fyst-m2"
    assert choice_hint("x", []) == "available: none"


def test_a_finding_of_unknown_kind_keeps_pydantics_words() -> None:
    (fault,) = faults_of([{"type": "new", "loc": ("run", "seed"), "input": "x" * 100, "msg": "is odd"}])
    assert fault.what == f'= "{"x" * 59}... is odd'
