"""Checks of any robot-link server against the interface control document; knows nothing but that page."""
