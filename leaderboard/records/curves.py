"""Learning curves as numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.integrate import trapezoid


def area_under_curve(steps: Sequence[int], values: Sequence[float], budget: int) -> float:
    """Area under a learning curve by the trapezoidal rule, as a share of `budget` x 1.

    The first value is held back to step 0 and the last one on to the budget; what lies beyond the
    budget is left out. One evaluation gives its own value.
    """
    knots = np.array([0, *steps, max(budget, steps[-1])], dtype=np.float64)
    heights = np.array([values[0], *values, values[-1]], dtype=np.float64)
    inside = np.unique(np.concatenate([knots[knots <= budget], [float(budget)]]))
    return float(trapezoid(np.interp(inside, knots, heights), inside) / budget)
