"""Edge. Changes single keys of a configuration file, with everything else in it, comments included, as it was."""

import difflib
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

import tomlkit
from tomlkit.exceptions import TOMLKitError

from ccatp.errors import ConfigError

# In comments: a stand-in value, and what takes its place.
UNVERIFIED, MEASURED = "UNVERIFIED", "measured by ccatp calibrate"


def with_values(text: str, values: Mapping[str, float], file: Path) -> str:
    """The text with other values of some keys.

    A key that is there keeps its comment, but for the mark of values that nobody has measured; one that is not is
    added to its section.

    Args:
        text: TOML.
        values: by dotted key, ``section.key``.
        file: where the text is from, for errors.

    Raises:
        ConfigError: the text is not TOML, or a key stands where no key can be.
    """
    try:
        document = tomlkit.parse(text)
        for dotted, value in values.items():
            section, _, key = dotted.rpartition(".")
            if section not in document:
                if document.as_string().strip():
                    document.add(tomlkit.nl())
                document.add(section, tomlkit.table())
            table = document[section]
            if not isinstance(table, dict):
                raise ConfigError(f"{file}: {section} is a value, not a section; {dotted} cannot be set there")
            table[key] = value
            trivia = table[key].trivia
            trivia.comment = trivia.comment.replace(UNVERIFIED, MEASURED)
        return tomlkit.dumps(document)
    except TOMLKitError as error:
        raise ConfigError(f"{file}: is not TOML: {error}") from error


def difference(before: str, after: str, file: Path) -> str:
    """What would change, as a unified diff; empty where nothing does."""
    old, new = before.splitlines(keepends=True), after.splitlines(keepends=True)
    return "".join(difflib.unified_diff(old, new, fromfile=str(file), tofile=f"{file} (new)"))


def write_in_place(file: Path, text: str) -> None:
    """Replace a file's contents at once: whoever reads it finds the old ones or the new ones, also after a power cut.

    Its mode stays as it is; where it is a link, what it points to is replaced.

    Raises:
        ConfigError: it cannot be written.
    """
    file = file.resolve()
    try:
        handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.")
    except OSError as error:
        raise ConfigError(f"{file}: cannot be written: {error.strerror or error}") from error
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as out:
            out.write(text)
            out.flush()
            os.fchmod(out.fileno(), file.stat().st_mode & 0o7777)
            os.fsync(out.fileno())
        Path(name).replace(file)
        folder = os.open(file.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        Path(name).unlink(missing_ok=True)
        raise ConfigError(f"{file}: cannot be written: {error.strerror or error}") from error
