"""Rules of the danger loop, which ``ccatp.danger`` arbitrates. Imports nothing of ``ccatp.estimation``."""
