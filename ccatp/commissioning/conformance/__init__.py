"""Black-box checks of a robot-link server against the interface control document.

``runner`` has the list of all checks and runs it against one server; ``checks`` says what a check is.
"""
