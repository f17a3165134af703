"""The command ``ccatp radio``."""
