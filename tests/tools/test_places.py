"""Tests and programs lie where CONTRIBUTING.md and `make help` say."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE, TESTS, TOOLS = ROOT / "ccatp", ROOT / "tests", ROOT / "tools"
UNIT = TESTS / "unit"
# Files of tests that are about no one module of the folder, or of those below it.
OF_SEVERAL_MODULES = {
    "beacons/onboard/test_package", "beacons/report/test_beacon_report", "beacons/studies/test_beacon_studies",
    "beacons/test_driving", "beacons/estimation/test_moving_beacons", "beacons/estimation/test_radios",
    "beacons/estimation/test_invariance", "cli/test_cli_commands", "cli/test_outputs", "cli/test_refusals",
    "daemon/test_service", "daemon/test_telemetry",
    "beacons/cli/test_radio_map", "control/test_tracker_pid", "estimation/test_replay_buffer",
    "estimation/test_sample_validation", "mirror/test_length_judgement", "report/test_pages",
    "report/dashboard/test_views", "safety/test_columns_act", "safety/test_conditions", "safety/test_united_findings",
    "studies/test_mission_studies", "survey/test_mission", "test_constructors", "test_names_decide",
}  # fmt: skip


def folders_of(root: Path) -> set[Path]:
    """Folders with Python files somewhere below, relative to the root."""
    return {folder for path in root.rglob("*.py") for folder in path.relative_to(root).parents}


def test_unit_tests_have_the_folders_of_the_package() -> None:
    assert folders_of(UNIT) - folders_of(PACKAGE) == set()


def test_a_unit_test_has_the_name_of_a_module_in_its_folder_or_is_listed() -> None:
    modules = [path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py")]
    places = {(folder, name) for path in modules for folder in path.parents for name in (path.stem, path.parent.name)}
    tests = [path.relative_to(UNIT).with_suffix("") for path in UNIT.rglob("test_*.py")]
    others = {str(path) for path in tests if (path.parent, path.name.removeprefix("test_")) not in places}
    assert others == OF_SEVERAL_MODULES


def test_each_folder_of_tests_is_described() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    described = re.findall(r"^\| `tests/(\w+)` \|", text, re.MULTILINE)
    with_tests = {path.relative_to(TESTS).parts[0] for path in TESTS.rglob("test_*.py")}
    assert sorted(described) == sorted(with_tests)


def test_make_help_names_each_program_and_no_other() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    shown = set(re.findall(r"@echo \".*?python -m (tools[.\w]+)", makefile))
    targets = set(re.findall(r"^\t.*-m (tools[.\w]+)", re.sub(r"@echo.*", "", makefile), re.MULTILINE))
    programs = set()
    for path in TOOLS.rglob("*.py"):
        if 'if __name__ == "__main__":' in path.read_text(encoding="utf-8"):
            programs.add(".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__main__"))
    assert shown | targets == programs
    assert shown & targets == set()
