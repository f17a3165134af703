"""The command ``ccatp radio``."""

import ccatp.cli  # noqa: F401 - first, because its table of commands imports this one, whoever is imported first
