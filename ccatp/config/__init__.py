"""Pure but for the loader. The configuration: frozen models and the one place that reads them from files."""
