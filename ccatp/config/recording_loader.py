"""Edge. Reads what is assumed of recorded radio data: the shipped file, the user's, the command line."""

import json
from collections.abc import Mapping
from pathlib import Path

from pydantic import ValidationError

from ccatp.config.loader import shipped_config_dir
from ccatp.config.messages import faults_of
from ccatp.config.recording_models import RecordingsConfig
from ccatp.config.sources import Source, Tree, fault_line, merged, nested, read_source
from ccatp.errors import ConfigError

BASE_FILE = "recordings.toml"


def load_recordings_config(file: Path | None = None, overrides: Mapping[str, object] | None = None) -> RecordingsConfig:
    """What is assumed of recordings, by format.

    Args:
        file: the user's configuration, or ``None``; it needs only its own differences.
        overrides: dotted keys, stronger than the file, as in ``plaza.priors.range_scale``.

    Raises:
        ConfigError: one line with file, line, key, what is wrong and what to do.
    """
    base = read_source(shipped_config_dir() / BASE_FILE)
    user = read_source(file) if file else Source("", "", {})
    command = Source("command line", "", nested(overrides or {}))
    tree: Tree = {}
    for source in (base, user, command):
        tree = merged(tree, source.tree)
    try:
        return RecordingsConfig.model_validate_json(json.dumps(tree, default=str), strict=True)
    except ValidationError as error:
        sources = [command, user, base]
        faults = faults_of(error.errors(), RecordingsConfig)
        raise ConfigError(*(fault_line(fault, sources) for fault in faults)) from error
