"""Glue. Studies: campaigns and analyses that answer a question with a table, figures and a machine-readable result."""
