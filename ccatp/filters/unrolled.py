"""Four states in plain floats: the steps of a linear filter written out, without a loop over states.

The covariance is kept as its factors, P = U D U^T, U with units on its diagonal and zeros below, D diagonal
(Bierman 1977): what they stand for is symmetric and positive definite whatever the rounding.
"""

from collections.abc import Sequence
from typing import NamedTuple

Four = tuple[float, float, float, float]
"""A vector of four states."""
Ten = tuple[float, float, float, float, float, float, float, float, float, float]
"""The upper half of a symmetric (4, 4), row by row, 00 01 02 03 11 12 13 22 23 33; or factors in the same places, D on
the diagonal."""
Row = tuple[float, ...]
"""What a reading measures of four states, and the variance of its noise: five numbers."""
Matrix = Sequence[Sequence[float]]
"""Rows of a (k, 4)."""


class Integrators(NamedTuple):
    """F and Q of thesis eq. 2.11 with the states as they stand here, heading, speed, acceleration, rate.

    The last drives the first and the third the second; nothing else is in F but units, and Q knows the two pairs.
    """

    f03: float
    f12: float
    q00: float
    q03: float
    q11: float
    q12: float
    q22: float
    q33: float


class Full(NamedTuple):
    """Any F, and the upper half of Q."""

    F: Matrix
    Q: Ten


def upper(P: Matrix) -> Ten:
    """The upper half of a (4, 4)."""
    (p00, p01, p02, p03), (_, p11, p12, p13), (_, _, p22, p23), (_, _, _, p33) = P
    return p00, p01, p02, p03, p11, p12, p13, p22, p23, p33


def transition(F: Matrix, Q: Matrix) -> Integrators | Full:
    """A transition (4, 4) and the covariance of its noise (4, 4), of which the upper half is read."""
    q00, q01, q02, q03, q11, q12, q13, q22, q23, q33 = half = upper(Q)
    f03, f12 = F[0][3], F[1][2]
    driven = [[1.0, 0.0, 0.0, f03], [0.0, 1.0, f12, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    if driven == F and q01 == q02 == q13 == q23 == 0.0:
        return Integrators(f03, f12, q00, q03, q11, q12, q22, q33)
    return Full(F, half)


def factored(P: Ten) -> Ten | None:
    """U and D of P; None where P is not positive definite or not finite."""
    p00, p01, p02, p03, p11, p12, p13, p22, p23, d3 = P
    if not d3 > 0.0:
        return None
    u03, u13, u23 = p03 / d3, p13 / d3, p23 / d3
    d2 = p22 - u23 * p23
    if not d2 > 0.0:
        return None
    e02, e12 = p02 - u03 * p23, p12 - u13 * p23
    u02, u12 = e02 / d2, e12 / d2
    d1 = p11 - u13 * p13 - u12 * e12
    if not d1 > 0.0:
        return None
    e01 = p01 - u03 * p13 - u02 * e12
    u01 = e01 / d1
    d0 = p00 - u03 * p03 - u02 * e02 - u01 * e01
    return (d0, u01, u02, u03, d1, u12, u13, d2, u23, d3) if d0 > 0.0 else None


def product(UD: Ten) -> Ten:
    """P = U D U^T."""
    d0, u01, u02, u03, d1, u12, u13, d2, u23, d3 = UD
    p03, p13, p23 = u03 * d3, u13 * d3, u23 * d3
    e02, e12, e01 = u02 * d2, u12 * d2, u01 * d1
    return (
        d0 + u01 * e01 + u02 * e02 + u03 * p03,
        e01 + u02 * e12 + u03 * p13,
        e02 + u03 * p23,
        p03,
        d1 + u12 * e12 + u13 * p13,
        e12 + u13 * p23,
        p13,
        d2 + u23 * p23,
        p23,
        d3,
    )


def propagate(x: Four, UD: Ten, step: Integrators | Full) -> tuple[Four, Ten] | None:
    """F x and the factors of F P F^T + Q, thesis eqs 2.5 and 2.6; None where that is not positive definite or finite.

    Of ``Integrators`` F U is again what U is, and its product with D as cheap as ``product``; any other F costs three
    times as much.
    """
    if len(step) == 2:
        y, P = _propagate_full(x, product(UD), *step)
        again = factored(P)
        return None if again is None else (y, again)
    f03, f12, q00, q03, q11, q12, q22, q33 = step
    x0, x1, x2, x3 = x
    d0, u01, u02, u03, d1, u12, u13, d2, u23, d3 = UD
    u03 += f03
    u12 += f12
    u13 += f12 * u23
    g03, g13, g23, g02, g12, g01 = u03 * d3, u13 * d3, u23 * d3, u02 * d2, u12 * d2, u01 * d1
    # As ``product`` and then ``factored``, each entry when its turn has come.
    p33 = d3 + q33
    if not p33 > 0.0:
        return None
    p03 = g03 + q03
    v03, v13, v23 = p03 / p33, g13 / p33, g23 / p33
    p22 = d2 + q22 + (u23 - v23) * g23
    if not p22 > 0.0:
        return None
    p02, p12 = g02 + u23 * g03 - v03 * g23, g12 + q12 + (u23 - v23) * g13
    v02, v12 = p02 / p22, p12 / p22
    p11 = d1 + q11 + (u13 - v13) * g13 + u12 * g12 - v12 * p12
    if not p11 > 0.0:
        return None
    p01 = g01 + u12 * g02 + u13 * g03 - v03 * g13 - v02 * p12
    v01 = p01 / p11
    p00 = d0 + q00 + u01 * g01 + u02 * g02 + u03 * g03 - v03 * p03 - v02 * p02 - v01 * p01
    if not p00 > 0.0:
        return None
    return (
        (x0 + f03 * x3, x1 + f12 * x2, x2, x3),
        (p00, v01, v02, v03, p11, v12, v13, p22, v23, p33),
    )


def _propagate_full(x: Four, P: Ten, F: Matrix, Q: Ten) -> tuple[Four, Ten]:
    x0, x1, x2, x3 = x
    p00, p01, p02, p03, p11, p12, p13, p22, p23, p33 = P
    moved, rows = [], []
    for a, b, c, d in F:
        moved.append(a * x0 + b * x1 + c * x2 + d * x3)
        rows.append(
            (
                a * p00 + b * p01 + c * p02 + d * p03,
                a * p01 + b * p11 + c * p12 + d * p13,
                a * p02 + b * p12 + c * p22 + d * p23,
                a * p03 + b * p13 + c * p23 + d * p33,
            )
        )
    (a0, a1, a2, a3), (b0, b1, b2, b3), (c0, c1, c2, c3), (d0, d1, d2, d3) = rows
    (e0, e1, e2, e3), (f0, f1, f2, f3), (g0, g1, g2, g3), (h0, h1, h2, h3) = F
    q00, q01, q02, q03, q11, q12, q13, q22, q23, q33 = Q
    y0, y1, y2, y3 = moved
    return (
        (y0, y1, y2, y3),
        (
            a0 * e0 + a1 * e1 + a2 * e2 + a3 * e3 + q00,
            a0 * f0 + a1 * f1 + a2 * f2 + a3 * f3 + q01,
            a0 * g0 + a1 * g1 + a2 * g2 + a3 * g3 + q02,
            a0 * h0 + a1 * h1 + a2 * h2 + a3 * h3 + q03,
            b0 * f0 + b1 * f1 + b2 * f2 + b3 * f3 + q11,
            b0 * g0 + b1 * g1 + b2 * g2 + b3 * g3 + q12,
            b0 * h0 + b1 * h1 + b2 * h2 + b3 * h3 + q13,
            c0 * g0 + c1 * g1 + c2 * g2 + c3 * g3 + q22,
            c0 * h0 + c1 * h1 + c2 * h2 + c3 * h3 + q23,
            d0 * h0 + d1 * h1 + d2 * h2 + d3 * h3 + q33,
        ),
    )


def condition(  # noqa: PLR0915 - written out, that no step of it costs a loop
    x: Four, UD: Ten, z: Sequence[float], rows: Sequence[Row]
) -> tuple[Four, Ten, float]:
    """Condition N(x, P) on rows z = h x + noise one after the other (thesis eqs 2.7 to 2.10 for one row).

    With f = U^T h and v = D f a row changes the factors by

        alpha_j = alpha_(j-1) + f_j v_j,   alpha_0 = r
        d_j <- d_j alpha_(j-1) / alpha_j,   U_j <- U_j - (f_j / alpha_(j-1)) b,   b <- b + v_j U_j (old)

    and b / alpha_4 is the gain, alpha_4 the variance of the innovation. Nothing is subtracted from a variance, so D
    stays positive however much more exact the row is than the state.

    Args:
        x: mean.
        UD: factors of the covariance.
        z: readings of the m rows.
        rows: of the measurement matrix, each with the variance of its noise, above zero.

    Returns:
        Mean, factors, normalised innovation squared; not finite if anything given is not.
    """
    x0, x1, x2, x3 = x
    d0, u01, u02, u03, d1, u12, u13, d2, u23, d3 = UD
    nis = 0.0
    for reading, (h0, h1, h2, h3, r) in zip(z, rows, strict=True):
        # What a row does not measure before what it measures keeps its factors: f and b are zero there.
        if h0:
            e = reading - h0 * x0 - h1 * x1 - h2 * x2 - h3 * x3
            f1 = h1 + u01 * h0
            f2 = h2 + u02 * h0 + u12 * h1
            f3 = h3 + u03 * h0 + u13 * h1 + u23 * h2
            b0, b1, b2, b3 = d0 * h0, d1 * f1, d2 * f2, d3 * f3
            s0 = r + b0 * h0
            s1 = s0 + b1 * f1
            d0 *= r / s0
            d1 *= s0 / s1
            k = f1 / s0
            u01, b0 = u01 - k * b0, b0 + b1 * u01
        elif h1:
            e = reading - h1 * x1 - h3 * x3
            f2, f3 = u12 * h1, h3 + u13 * h1
            if h2:
                e, f2, f3 = e - h2 * x2, f2 + h2, f3 + u23 * h2
            b1, b2, b3 = d1 * h1, d2 * f2, d3 * f3
            s1 = r + b1 * h1
            d1 *= r / s1
            b0 = b1 * u01
        elif h2:
            e = reading - h2 * x2 - h3 * x3
            f3 = h3 + u23 * h2
            b2, b3 = d2 * h2, d3 * f3
            s2 = r + b2 * h2
            s3 = s2 + b3 * f3
            d2 *= r / s2
            d3 *= s2 / s3
            b0, b1 = b2 * u02, b2 * u12
            k = f3 / s2
            u03, b0 = u03 - k * b0, b0 + b3 * u03
            u13, b1 = u13 - k * b1, b1 + b3 * u13
            u23, b2 = u23 - k * b2, b2 + b3 * u23
            k = e / s3
            nis += e * k
            x0 += k * b0
            x1 += k * b1
            x2 += k * b2
            x3 += k * b3
            continue
        else:
            e = reading - h3 * x3
            b3 = d3 * h3
            s3 = r + b3 * h3
            d3 *= r / s3
            k = e / s3
            nis += e * k
            k *= b3
            x0 += k * u03
            x1 += k * u13
            x2 += k * u23
            x3 += k
            continue
        s2 = s1 + b2 * f2
        s3 = s2 + b3 * f3
        d2 *= s1 / s2
        d3 *= s2 / s3
        k = f2 / s1
        u02, b0 = u02 - k * b0, b0 + b2 * u02
        u12, b1 = u12 - k * b1, b1 + b2 * u12
        k = f3 / s2
        u03, b0 = u03 - k * b0, b0 + b3 * u03
        u13, b1 = u13 - k * b1, b1 + b3 * u13
        u23, b2 = u23 - k * b2, b2 + b3 * u23
        k = e / s3
        nis += e * k
        x0 += k * b0
        x1 += k * b1
        x2 += k * b2
        x3 += k * b3
    return (x0, x1, x2, x3), (d0, u01, u02, u03, d1, u12, u13, d2, u23, d3), nis
