"""How good a transform is: against a known truth."""

from __future__ import annotations

import numpy as np

from . import se3
from .datatypes import Array


def e_rt(T: Array, T_true: Array, near: float = 1.0, far: float = 60.0) -> float:
    """Mean error of points on the source's y axis, metres (Xue et al. 2019, eq. 12).

    ``1/(m − n) ∫_n^m ‖R x e_y + t − R_gt x e_y − t_gt‖ dx``: the distance between where the two
    transforms put a point x metres out along y, averaged over x from ``near`` to ``far``.

    Parameters
    ----------
    T, T_true
        (4, 4) estimate and truth, target from source.
    near, far
        Ends n and m of the range, metres.
    """
    x = np.linspace(near, far, 512)
    points = x[:, None] * np.array([0.0, 1.0, 0.0])
    gap = np.linalg.norm(se3.apply(T, points) - se3.apply(T_true, points), axis=1)
    return float(np.trapezoid(gap, x) / (far - near))
