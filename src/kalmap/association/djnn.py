"""Dynamic joint nearest neighbour (Zhou, Zhao & Zhang 2010)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from kalmap.association.associator import Predicted
from kalmap.association.checks import check
from kalmap.association.gated import Gated, Matching, Table
from kalmap.association.management import BuiltInManagement, Counter
from kalmap.kernels import nearest as kernel
from kalmap.records import Reason

_CASES = {
    kernel.CONTESTED: "case 2: some sightings share a landmark",
    kernel.ALL_CONTESTED: "case 3: all matched sightings share landmarks",
    kernel.NONE_MATCHED: "case 4: nothing matched though landmarks should be seen",
}


class Djnn(Gated, frozen=True, kw_only=True, tag=True):
    """Nearest neighbour whose sightings know of each other, with a tentative set and a local region.

    The three parts can be switched off one by one: interference within a frame (`interference`: cases 1 to 3;
    `widen`: case 4's factor on the gate, 0 for never), spurious landmarks over frames (`management`: the
    information counter), and the local region (`region.local`).
    """

    interference: bool = True
    widen: float = 3.0
    management: BuiltInManagement = Counter()

    def __post_init__(self) -> None:
        super().__post_init__()
        check(0.0 <= self.widen < math.inf, "widen", "0 or more", self.widen)

    def _match(self, table: Table, predicted: Predicted) -> Matching:
        count = len(table.squared)
        columns, offset = np.full(count, kernel.FREE, dtype=np.int64), np.zeros(2)
        squared, normalised = table.squared.copy(), table.normalised.copy()
        expected, usable = table.expected, ~table.trial
        frame = table.sightings.values, predicted.noises, expected.z, expected.spreads, table.extra, usable
        tables = squared, normalised, columns, offset
        case, widened = kernel.dynamic_joint(*frame, usable, table.gate, self.interference, 0.0, *tables)
        if case == kernel.NONE_MATCHED and self.widen > 0.0 and usable.any():
            inside = usable & self.region.in_view(predicted, expected, shrink=True)
            case, widened = kernel.dynamic_joint(
                *frame, inside, table.gate, self.interference, self.widen, *tables
            )
        if case == kernel.CLEAN or (case == kernel.NONE_MATCHED and not widened):
            return Matching(columns)
        reason: Any = Reason.WIDENED if widened else Reason.NEAREST
        notes: tuple[str, ...] = ()
        if predicted.explain:
            reason = self._reasons(table, columns, reason)
            notes = (
                f"{_CASES[case]}; offset {offset[0]:+.3f} m, {math.degrees(offset[1]):+.3f} deg taken off",
            )
        return Matching(columns, reason, notes=notes, squared=squared, normalised=normalised)

    def _reasons(self, table: Table, columns: np.ndarray, otherwise: Reason) -> np.ndarray:
        """(M,) OFFSET where a sighting got another landmark than its nearest."""
        plain = np.full(len(columns), kernel.FREE, dtype=np.int64)
        everyone = np.ones(len(columns), dtype=np.bool_)
        kernel.nearest(table.squared, table.normalised, table.gate, everyone, ~table.trial, plain)
        changed = (plain != columns) & (otherwise != Reason.WIDENED)
        return np.where(changed, Reason.OFFSET, otherwise)
