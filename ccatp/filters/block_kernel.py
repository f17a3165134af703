"""The matrix steps of the filters in C, which the compiled build has; elsewhere numpy does them.

Each function answers None where it leaves a case to numpy, see ``packaging/compiled/block_kernel.c``. What they answer
differs from numpy's result by rounding.
"""

from ccatp.core import FloatArray

__all__ = ["IS_COMPILED", "advance", "condition", "spread"]

try:
    from ccatp.filters._kernel import advance, condition, spread

    IS_COMPILED = True
except ImportError:
    IS_COMPILED = False

    def advance(P: FloatArray, F: FloatArray, Q: FloatArray) -> FloatArray | None:
        """F P F^T + Q, all (n, n): nothing without the compiled build."""
        return None

    def condition(
        P: FloatArray, nu: FloatArray, H: FloatArray, R: FloatArray
    ) -> tuple[FloatArray, FloatArray, float] | None:
        """The posterior of ``Conditioner.on_rows``: nothing without the compiled build."""
        return None

    def spread(G: FloatArray, variances: FloatArray, drift: FloatArray) -> FloatArray | None:
        """G diag(variances) G^T + diag(drift), G (n, m): nothing without the compiled build."""
        return None
