"""Anderson's acceleration of an iteration that goes to its fixed point slowly."""

from __future__ import annotations

import numpy as np

_DEPTH = 3


class Accelerated:
    """Gauss-Newton creeps or swings where maps contradict each other; its last few steps say where it is going.

    Anderson 1965 (Walker & Ni 2011): the next state is the combination of the last ones whose steps cancel best.
    """

    def __init__(self) -> None:
        self._states: list[np.ndarray] = []
        self._steps: list[np.ndarray] = []

    def clear(self) -> None:
        """Begin anew."""
        self._states, self._steps = [], []

    def step(self, state: np.ndarray, step: np.ndarray) -> np.ndarray:
        """(n,) the step to take instead of the one that the iteration takes from this state."""
        self._states, self._steps = [*self._states[-_DEPTH:], state], [*self._steps[-_DEPTH:], step]
        if len(self._steps) < 3:  # the first two are large and say little
            return step
        by_state, by_step = np.diff(self._states, axis=0), np.diff(self._steps, axis=0)
        weights, *_ = np.linalg.lstsq(by_step.T, step, rcond=1e-8)
        return step - (by_state + by_step).T @ weights
