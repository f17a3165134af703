"""Configuration: frozen pydantic models, which other packages import, and ``load``, which processes call."""
