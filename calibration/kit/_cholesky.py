"""Compiled solution of small symmetric systems, for the loops of both packages."""

import math

from calibration.kit.compiled import part


@part
def substitute(L, x):  # type: ignore[no-untyped-def]
    """Replace the right-hand side x by (L L^T)^-1 x for a Cholesky factor L (lower triangle)."""
    n = L.shape[0]
    for i in range(n):
        s = x[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, n):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]


@part
def solve_in_place(M, x):  # type: ignore[no-untyped-def]
    """Replace x by M^-1 x for symmetric M (lower triangle) by Cholesky; False if M is not positive definite.

    M is replaced by its factor.
    """
    for i in range(M.shape[0]):
        for j in range(i + 1):
            s = M[i, j]
            for k in range(j):
                s -= M[i, k] * M[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                M[i, i] = math.sqrt(s)
            else:
                M[i, j] = s / M[j, j]
    substitute(M, x)
    return True
