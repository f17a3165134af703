"""The operator's web page: views of the run's state, and the HTTP server that publishes them.

``app`` builds the application, ``hub`` streams the state, ``server`` runs it.
"""
