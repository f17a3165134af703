"""Views of a run: HTML report, comparison, figures, dashboard, Foxglove and PlotJuggler streams.

Reads what ``ccatp.records`` gives; decides nothing about a mission.
"""
