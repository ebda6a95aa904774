"""Gaussians: the belief, the linearisers and square roots.

The square-root form of the sigma-point update belongs here beside `linearisers`, with the set filters.
"""

from kalmap.gaussian.belief import Belief
from kalmap.gaussian.linearisers import (
    CentralDifference,
    Cubature,
    Function,
    Jacobian,
    Lineariser,
    Regression,
    Unscented,
)
from kalmap.gaussian.roots import NotPositiveError

__all__ = [
    "Belief",
    "CentralDifference",
    "Cubature",
    "Function",
    "Jacobian",
    "Lineariser",
    "NotPositiveError",
    "Regression",
    "Unscented",
]
