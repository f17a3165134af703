"""Configuration: frozen pydantic models, and the loader that reads them from TOML files and the command line.

``models`` and ``beacon_models`` are what other packages import; ``load`` reads files and is called by processes only.
"""
