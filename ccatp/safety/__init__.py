"""Rules of the danger loop: edge detector, emergency latch, health monitors and their escalation.

``ccatp.danger`` arbitrates them into one verdict per frame. Imports nothing of ``ccatp.estimation``.
"""
