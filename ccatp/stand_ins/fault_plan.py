"""Edge. Reads a fault plan: what shall go wrong in a simulated run."""

from pathlib import Path

from ccatp.errors import ConfigError
from ccatp.sim.faults.plan import FaultPlan, check_pacing, parse_plan


def read_plan(file: Path, *, lockstep: bool) -> FaultPlan:
    """The plan in a file.

    Args:
        file: TOML.
        lockstep: simulated time waits for the clients; not every fault of the link makes sense then.

    Raises:
        ConfigError: one line per problem with file, line, key, what is wrong and what to do.
    """
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{file}: {(error.strerror or str(error)).lower()}; name a TOML file that exists") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{file}: is not UTF-8 text (byte {error.start}); save it as UTF-8") from error
    plan = parse_plan(text, str(file))
    check_pacing(plan, str(file), lockstep=lockstep)
    return plan
