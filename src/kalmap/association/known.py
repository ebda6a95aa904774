"""Association by the identities that the log itself gives."""

from __future__ import annotations

from typing import Any, ClassVar

import msgspec
import numpy as np

from kalmap.association.associator import Predicted
from kalmap.records import NEW, SPURIOUS, Association, EventError, Sightings

UNIDENTIFIED = -1


class KnownIds(msgspec.Struct, frozen=True, tag=True):
    """Sightings with the same id are the same landmark; id -1 means unidentified and is left unused."""

    uses_ids: ClassVar[bool] = True

    def start(self) -> Any:
        """Memory: id -> index."""
        return {}

    def fits(self, memory: Any, count: int) -> bool:
        """Whether its indices are 0 to count - 1."""
        return sorted(memory.values()) == list(range(count))

    def associate(self, memory: Any, sightings: Sightings, predicted: Predicted) -> Association:
        """Raises EventError if the frame has no ids or one that cannot be an identity."""
        if sightings.ids is None:
            raise EventError(
                "the log gives no identities: choose another association", time=sightings.time, field="ids"
            )
        matched, fresh, added = [], predicted.count, dict[int, int]()
        for number in sightings.ids.tolist():
            index = memory.get(number, added.get(number))
            if index is None:
                if number < UNIDENTIFIED:
                    raise EventError(
                        f"{number} is no identity (0 or more, or -1 for unidentified)",
                        time=sightings.time,
                        field="ids",
                    )
                if number == UNIDENTIFIED:
                    index = SPURIOUS
                else:
                    index = NEW
                    added[number] = fresh
                    fresh += 1
            matched.append(index)
        return Association(np.array(matched, dtype=np.int64), change=added)

    def settle(self, memory: Any, association: Association) -> None:
        """Remember the identities that this frame brought."""
        memory.update(association.change)
