"""Monte Carlo campaigns, comparisons with published results and with peers, replay of recorded runs.

``registry`` is the table of studies; ``campaign`` and ``engine`` run them.
"""
