"""The command ``ccatp plan``: what it tells is what a run would do."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ccatp.cli import main
from ccatp.config.load import available, load_config
from ccatp.mirror.mirror import build_mirror
from ccatp.survey.composition import assemble, make_plan, plan_lines
from ccatp.survey.planning.search import leg_lengths

NAMES = ("fyst-m1", "fyst-m2", "thesis-m1", "thesis-m2")


def planned(capsys: pytest.CaptureFixture[str], *args: str, status: int = 0) -> dict[str, Any]:
    assert main(["plan", "--json", *args]) == status
    result: dict[str, Any] = json.loads(capsys.readouterr().out)
    return result


def test_every_shipped_world_is_named_in_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "--help"]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert set(available("world")) <= set(re.split(r"[ ,]+", told))


def test_one_panel_is_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plan", "--mirror", "fyst-m2", "--panels", "1"]) == 0
    assert "fyst-m2: 9 points of 1 panel, order thesis\n" in capsys.readouterr().out


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("filter_name", ["kf", "ekf"])
def test_the_plan_is_that_of_a_run(name: str, filter_name: str, capsys: pytest.CaptureFixture[str]) -> None:
    found = planned(capsys, "--mirror", name, "--panels", "3", "--filter", filter_name)
    parts = assemble(load_config(overrides={"run.mirror": name, "run.panels": 3, "run.filter": filter_name}))
    assert found["lower_bound_s"] == pytest.approx(parts.lower_bound_s, abs=1e-3)
    length_m = sum(leg_lengths(parts.route.stops, parts.mirror.base_pose, parts.mirror))
    assert found["length_m"] == pytest.approx(length_m, abs=1e-3)
    assert [(s["x_m"], s["y_m"]) for s in found["stops"]] == [
        (round(stop.x_m, 4), round(stop.y_m, 4)) for stop in parts.route.stops
    ]
    assert [tuple(s["point"]) for s in found["stops"] if s["point"]] == [tuple(point) for point in parts.points]
    assert found["points"] == {"total": 27, "reached": 27}
    assert (found["mirror"], found["order"], found["out_of_reach"]) == (name, "thesis", [])


def test_its_times_add_up(capsys: pytest.CaptureFixture[str]) -> None:
    found = planned(capsys, "--panels", "2")
    parts_s = [found[key] for key in ("driving_s", "turning_s", "measuring_s")]
    assert sum(parts_s) == pytest.approx(found["lower_bound_s"], abs=2e-3)
    assert found["measuring_s"] == pytest.approx(0.5 * sum(s["kind"] != "via" for s in found["stops"]))
    # The clock at the last stop, and the measurement there.
    assert found["stops"][-1]["t_s"] + 0.5 == pytest.approx(found["lower_bound_s"], abs=2e-3)
    times_s = [stop["t_s"] for stop in found["stops"]]
    assert times_s == sorted(times_s)
    assert 0.0 < found["any_order_bound_s"] <= found["lower_bound_s"]
    assert found["fits_budget"]


def test_settings_act(capsys: pytest.CaptureFixture[str]) -> None:
    usual = planned(capsys, "--panels", "4")
    faster = planned(capsys, "--panels", "4", "--set", "limits.v_max_m_s=0.2")
    other = planned(capsys, "--panels", "4", "--set", "run.order=optimised", "--set", "run.budget_s=60")
    assert faster["driving_s"] < usual["driving_s"]
    assert other["order"] == "optimised"
    assert other["lower_bound_s"] < usual["lower_bound_s"]
    assert not other["fits_budget"]


def test_points_out_of_reach_are_told(capsys: pytest.CaptureFixture[str]) -> None:
    args = ("--panels", "1", "--set", "mission.leg_clearance_m=0.12")
    found = planned(capsys, *args, status=2)
    # Points lie 115 mm from the rim at least; the first panel of M1 has it below and on its left.
    lost = [tuple(point) for point in found["out_of_reach"]]
    assert lost
    assert all(point[:2] == (1, 2) for point in lost)
    assert (1, 2, 5) not in lost
    assert found["points"] == {"total": 9, "reached": 9 - len(lost)}
    assert main(["plan", *args]) == 2
    out, err = capsys.readouterr()
    assert f"out of reach    {len(lost)} points: 1/2/" in out
    assert err == (
        f"ccatp: {len(lost)} points are out of reach with mission.leg_clearance_m = 0.12 and "
        "turn_clearance_m = 0.005; a run would be refused\n"
    )


def test_many_points_out_of_reach_are_counted() -> None:
    cfg = load_config(overrides={"run.panels": 2})
    found = make_plan(cfg, build_mirror(cfg.mirror))
    *_, line = plan_lines(cfg, replace(found, out_of_reach=found.points))
    assert line.startswith("out of reach    18 points: 1/2/")
    assert line.count("/") == 2 * 10
    assert line.endswith(" ...")


def test_the_text_tells_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    found = planned(capsys, "--panels", "10", "--mirror", "fyst-m2")
    assert main(["plan", "--panels", "10", "--mirror", "fyst-m2"]) == 0
    out = capsys.readouterr().out
    assert "fyst-m2: 90 points of 10 panels, order thesis\n" in out
    assert f"way             {found['length_m']:.1f} m, {len(found['stops'])} stops" in out
    assert out.endswith("out of reach    none\n")
    assert out.splitlines()[1].endswith(" ...")


@pytest.mark.parametrize(("suffix", "magic"), [("png", b"\x89PNG"), ("svg", b"<svg")])
def test_the_figure_is_drawn(suffix: str, magic: bytes, tmp_path: Path) -> None:
    picture = tmp_path / f"plan.{suffix}"
    args = ["--panels", "1", "--set", "mission.leg_clearance_m=0.12", "--figure", str(picture)]
    assert main(["plan", *args]) == 2
    assert picture.read_bytes().startswith(magic)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--mirror", "fyst-m3"], "fyst-m3"),
        (["--panels", "-1"], "run.panels"),
        (["--panels", "999"], "run.panels = 999, but fyst-m1 has 77 panels; 0 takes all of them"),
        (["--set", "limits.v_max_m_s=1e-300"], "limits.v_max_m_s = 1e-300 must be at least 0.001"),
        (["--set", "limits.alpha_max_rad_s2=1e-300"], "limits.alpha_max_rad_s2 = 1e-300 must be at least 0.001"),
        (
            ["--panels", "1", "--set", "mirror.surface.normalisation_radius_mm=1e-300"],
            "mirror.surface.normalisation_radius_mm = 1e-300 must be at least 100",
        ),
        (["--figure", "nowhere/plan.png"], "--figure: no directory nowhere; make it first"),
        (
            ["--panels", "1", "--figure", "plan.tiff7"],
            "--figure: plan.tiff7: no format by that name; the file may end in .png, .pdf, .svg",
        ),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    args: list[str], message: str, tmp_path: Path,
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert main(["plan", *args]) == 2
    out, err = capsys.readouterr()
    assert len(err.splitlines()) == 1
    assert message in err
    assert out == ""
