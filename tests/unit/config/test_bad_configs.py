"""Each file of tests/configs is named for its fault; its first line says what the reader must be told."""

from pathlib import Path

import pytest

from ccatp.config.load import load_config
from ccatp.errors import ConfigError

FOLDER = Path(__file__).parents[2] / "configs"
FILES = sorted(FOLDER.glob("*.toml"))


def test_there_are_bad_configs() -> None:
    assert len(FILES) > 50


@pytest.mark.fault("P20")
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_the_fault_is_told_in_one_line(file: Path) -> None:
    expected = file.read_text().splitlines()[0].removeprefix("# fault: ").replace("<folder>", str(FOLDER))
    with pytest.raises(ConfigError) as caught:
        load_config(file)
    assert caught.value.problems[0] == f"{file}:{expected}"
    assert "\n" not in str(caught.value)
    assert caught.value.exit_status == 2
