"""What the processes make is nobody else's to write to, whatever the user's umask."""

import os
from pathlib import Path

from ccatp.config.load import dump_config, load_config
from ccatp.daemon.process import parse_args


def test_sockets_are_for_their_owner_alone(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text(dump_config(load_config()), encoding="utf-8")
    before = os.umask(0)
    try:
        parse_args(["--run-dir", str(tmp_path), "--runtime-dir", str(tmp_path)])
        assert os.umask(0) == 0o022
    finally:
        os.umask(before)
