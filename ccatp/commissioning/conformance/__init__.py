"""Black-box checks of a robot-link server against the interface control document; ``runner`` runs them."""
