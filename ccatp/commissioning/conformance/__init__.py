"""Black-box checks of a robot-link server against the interface control document.

``checks`` is the table, ``runner`` runs it against one server.
"""
