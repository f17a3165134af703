"""The operator's web page: what it shows (pure), and how it gets out (edge)."""
