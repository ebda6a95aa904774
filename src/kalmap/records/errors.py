"""Every error that kalmap raises on purpose descends from `KalmapError`.

The command line catches the root once, prints one line and exits with code 2.
"""

from __future__ import annotations


class KalmapError(Exception):
    """Root of all errors that a user can cause or has to know of."""


class LogError(KalmapError):
    """A log (or a map, or a configuration file) that cannot be read as it is.

    The message names the file, the record (row, scan or event, counted from 1) and the field,
    and what was expected there.
    """

    def __init__(
        self,
        problem: str,
        *,
        file: object = None,
        record: int | str | None = None,
        field: str | None = None,
    ) -> None:
        self.problem, self.file, self.record, self.field = problem, file, record, field
        place = [str(file)] if file is not None else []
        if record is not None:
            place.append(f"record {record}")
        if field is not None:
            place.append(f"field {field}")
        super().__init__(": ".join([", ".join(place), problem]) if place else problem)


class ConfigError(KalmapError):
    """A setting that does not exist, has the wrong type or contradicts another one."""


class EstimationError(KalmapError):
    """The filter cannot go on: a covariance is not positive definite, a number is not finite.

    The message names the quantity and the step.
    """


class JointTooLargeError(EstimationError):
    """A map so large that its joint covariance cannot be written out; everything else about it can."""


class EventError(KalmapError):
    """An event that the estimator refuses (late, not finite, unknown id, no odometry before it).

    `time` is the event's stamp, `field` the part that is wrong. The estimator's state is as before.
    """

    def __init__(self, problem: str, *, time: float | None = None, field: str | None = None) -> None:
        self.problem, self.time, self.field = problem, time, field
        place = [] if time is None else [f"t = {time:.6g} s"]
        if field is not None:
            place.append(f"field {field}")
        super().__init__(": ".join([", ".join(place), problem]) if place else problem)
