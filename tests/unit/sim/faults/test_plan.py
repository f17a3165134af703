"""Plans: the one that is shipped, and what is said of mistakes."""

from pathlib import Path

import pytest

from ccatp.cli import main
from ccatp.config.package import configs_dir
from ccatp.errors import ConfigError
from ccatp.sim.fault_plan import LINK_TYPES, TYPES, FaultPlan, Intermittent, check_pacing, parse_plan, read_plan

FAULT = '[[fault]]\nsignal = "imu_wz"\nat_s = 1.0\n'
LINK = "[[link]]\nat_s = 1.0\n"


def test_the_example_loads() -> None:
    plan = read_plan(configs_dir() / "faults" / "example.toml", lockstep=False)
    assert [fault.type for fault in plan.faults] == ["stuck", "intermittent", "drop", "slip"]
    assert [fault.type for fault in plan.link] == ["fragment", "delay"]
    edge = plan.faults[1]
    assert isinstance(edge, Intermittent)
    assert (edge.signal, edge.at_s, edge.end_s, edge.duty) == ("edge_front_left", 60.0, 60.3, 0.8)


def test_nothing_goes_wrong_by_an_empty_plan() -> None:
    assert parse_plan("", "plan") == FaultPlan()


def test_the_page_names_every_signal_and_type() -> None:
    page = (Path(__file__).parents[4] / "docs" / "faults.md").read_text(encoding="utf-8")
    for signal, types in TYPES.items():
        assert f"`{signal}`" in page
        for name, model in types.items():
            assert f"`{name}`" in page
            for key in set(model.model_fields) - {"signal", "type", "at_s", "for_s"}:
                assert f"`{key}`" in page
    for name, link in LINK_TYPES.items():
        assert f"`{name}`" in page
        for key in link.model_fields:
            assert f"`{key}`" in page


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[[fault]", "plan: is not TOML: "),
        ("[[faults]]\nat_s = 1.0", "plan:1: faults is unknown; did you mean fault? available: fault, link"),
        ("fault = 3", "plan: fault must be a list of tables; begin each with [[fault]]"),
        ("[link]\nat_s = 1.0", "plan: link must be a list of tables; begin each with [[link]]"),
        ('[[fault]]\ntype = "off"', "plan:1: fault[0].signal is missing; available: body, clock, edge_front_left"),
        ('[[fault]]\nsignal = 3\ntype = "off"', "plan:2: fault[0].signal = 3 must be text in quotes"),
        (
            '[[fault]]\nsignal = "imu_wx"\ntype = "off"',
            'plan:2: fault[0].signal = "imu_wx" is no signal; did you mean imu_wz? available: ',
        ),
        (FAULT, "plan:1: fault[0].type is missing; available: delayed, garbage, intermittent, non_finite, off"),
        (
            FAULT + 'type = "stcuk"\n',
            'plan:4: fault[0].type = "stcuk" is no type of imu_wz; did you mean stuck? available: ',
        ),
        (
            '[[fault]]\nsignal = "body"\ntype = "stuck"',
            'plan:3: fault[0].type = "stuck" is no type of body; available: drift, kidnap, slip',
        ),
        (FAULT + 'type = "stuck"\nvaleu = 1.0', "plan:5: fault[0].valeu is unknown; did you mean value?"),
        (FAULT + 'type = "off"\nxyz = 1', "plan:5: fault[0].xyz is unknown; known here: signal, type, at_s, for_s"),
        ('[[fault]]\nsignal = "soc"\ntype = "off"', "plan:1: fault[0].at_s is missing"),
        (FAULT + 'type = "slow"\nevery = 1', "plan:5: fault[0].every = 1 must be at least 2"),
        (FAULT + 'type = "off"\nfor_s = 0.0', "plan:5: fault[0].for_s = 0.0 must be greater than 0"),
        (FAULT + 'type = "off"\nfor_s = nan', "plan:5: fault[0].for_s = nan must be a finite number"),
        (FAULT + 'type = "stuck"\nvalue = "1"', 'plan:5: fault[0].value = "1" must be a number'),
        (FAULT + 'type = "wrong"', 'plan:4: fault[0].type = "wrong" needs an offset, a factor or a sign'),
        (FAULT + 'type = "wrong"\nsign = 2', "plan:5: fault[0].sign = 2 must be 1 or -1"),
        (FAULT + 'type = "saturated"', 'plan:4: fault[0].type = "saturated" needs low or high, and low below high'),
        (FAULT + 'type = "saturated"\nlow = 2.0\nhigh = 1.0', "needs low or high, and low below high"),
        (
            '[[fault]]\nsignal = "faults"\ntype = "raise"\nat_s = 1.0\nnames = ["imu", "wheel"]',
            "plan:5: fault[0].names[1] = \"wheel\" must be 'imu', 'encoder_left'",
        ),
        (
            FAULT + 'type = "off"\n\n' + FAULT + 'type = "of"',
            'plan:9: fault[1].type = "of" is no type of imu_wz; did you mean off?',
        ),
        (LINK, "plan:1: link[0].type is missing; available: black_hole, close, corrupt"),
        (LINK + 'type = "rest"', 'plan:3: link[0].type = "rest" is no type; did you mean reset?'),
        ('[[link]]\ntype = "reset"', 'plan:2: link[0].type = "reset" needs one of at_s, after_lines, after_bytes'),
        (LINK + 'type = "reset"\nafter_lines = 3', "needs one of at_s, after_lines, after_bytes"),
        (
            LINK + 'type = "stall"\ndirection = "up"',
            "plan:4: link[0].direction = \"up\" must be 'to_client', 'to_robot'",
        ),
    ],
)
def test_a_mistake_is_one_line_with_its_place(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_plan(text, "plan")
    assert message in caught.value.problems[0]
    assert all("\n" not in problem for problem in caught.value.problems)


def test_every_mistake_is_told() -> None:
    with pytest.raises(ConfigError, match=r"\(and 2 more") as caught:
        parse_plan(FAULT + 'type = "off"\na = 1\nb = 2\n' + LINK + 'type = "x"', "plan")
    assert len(caught.value.problems) == 3


def test_lockstep_refuses_what_would_only_stall_it() -> None:
    plan = parse_plan(LINK + 'type = "reset"\n' + LINK + 'type = "stall"\ndirection = "both"', "plan")
    check_pacing(plan, "plan", lockstep=False)
    message = (
        r'plan: link\[1\].type = "stall" makes no sense in lockstep, .* add --realtime, or take one of reset, close'
    )
    with pytest.raises(ConfigError, match=message):
        check_pacing(plan, "plan", lockstep=True)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: no such file or directory; name a TOML file that exists"):
        read_plan(tmp_path / "none.toml", lockstep=True)
    (tmp_path / "latin.toml").write_bytes(b"# \xe9")
    with pytest.raises(ConfigError, match=r"latin\.toml: is not UTF-8 text \(byte 2\); save it as UTF-8"):
        read_plan(tmp_path / "latin.toml", lockstep=True)


@pytest.mark.parametrize("command", [["run", "--sim"], ["sim", "robot", "--lockstep"]])
def test_the_commands_refuse_it_before_anything_starts(
    command: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "plan.toml"
    file.write_text(LINK + 'type = "stall"\ndirection = "both"')
    assert main([*command, "--faults", str(file)]) == 2
    error = capsys.readouterr().err
    assert 'link[0].type = "stall" makes no sense in lockstep' in error
    assert error.count("\n") == 1
