"""Programs for those who work on the project; `make help` lists them.

They use `tests.support`; nothing in `ccatp` uses them. Tests run a small, seeded part of the campaigns.
"""
