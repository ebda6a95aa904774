"""Questions to an audit trail that was written: a frame, a landmark's story, the counts."""

from __future__ import annotations

import math
import sqlite3
from pathlib import Path
from typing import Any, Self
from urllib.parse import quote

import numpy as np

from kalmap.data.audit import APPLICATION, AUDIT, VERSION
from kalmap.data.audit_story import Story, known, last_name, tell
from kalmap.records import Frame, LogError, Managed, Reason, Why
from kalmap.records.trail import TrailSummary, Trouble

_WORST = 10


def open_audit(path: Path | str) -> Audit:
    """Open the trail of a result folder, or the file itself.

    Raises LogError if there is none, or the file is no audit trail, is damaged or was written by a newer kalmap.
    """
    path = Path(path)
    if path.is_dir():
        path = _inside(path)
    if not path.is_file():
        raise LogError("no such file or folder", file=path)
    return Audit(path)


def _inside(folder: Path) -> Path:
    """The trail in a folder; the message where there is none says where one is."""
    if (folder / AUDIT).is_file():
        return folder / AUDIT
    below = sorted(str(found.parent) for found in folder.glob(f"*/{AUDIT}"))
    hint = (
        f"; there is one in {', '.join(below)}"
        if below
        else " (the log gave the identities, the map is a random finite set, or it was not kept)"
    )
    raise LogError(f"holds no audit trail of data association{hint}", file=folder)


class Audit:
    """An audit trail, open for reading; also a context manager. Every method raises LogError on a damaged file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            name = quote(str(path.resolve()))
            self._connection = sqlite3.connect(f"file:{name}?mode=ro&immutable=1", uri=True)
        except sqlite3.Error as error:
            raise LogError(f"cannot be read: {error}", file=path) from error
        try:
            self._check()
        except LogError:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the file."""
        self._connection.close()

    def _check(self) -> None:
        [(kind,)], [(version,)] = self._ask("PRAGMA application_id"), self._ask("PRAGMA user_version")
        if kind != APPLICATION:
            raise LogError("is not an audit trail of kalmap", file=self.path)
        if version > VERSION:
            problem = f"written in format {version} by a newer kalmap; this one reads up to {VERSION}"
            raise LogError(problem, file=self.path)
        if self._stated_size() != self.path.stat().st_size:
            raise LogError("damaged: cut off, or not of the size that it states", file=self.path)
        found = self._ask("PRAGMA quick_check(1)")
        if found != [("ok",)]:
            raise LogError(f"damaged: {found[0][0]}", file=self.path)

    def _stated_size(self) -> int:
        """Bytes, by the page size and count in the file's header (SQLite database file format, section 1.3)."""
        with self.path.open("rb") as stream:
            header = stream.read(32)
        size = int.from_bytes(header[16:18], "big")
        return (65536 if size == 1 else size) * int.from_bytes(header[28:], "big")

    def _ask(self, question: str, *values: Any) -> list[tuple[Any, ...]]:
        try:
            return self._connection.execute(question, values).fetchall()
        except OverflowError as error:
            raise LogError("a number of more than 64 bits names nothing", file=self.path) from error
        except (sqlite3.Error, UnicodeDecodeError) as error:
            raise LogError(f"not an audit trail, or damaged: {error}", file=self.path) from error

    # --- the whole ----------------------------------------------------------------------------------------------

    def about(self) -> dict[str, str]:
        """What the writer said about where the trail comes from, and the file's format."""
        return dict(self._ask("SELECT name, value FROM about ORDER BY name"))

    def frames(self) -> int:
        """How many frames there are."""
        return int(self._ask("SELECT count(*) FROM frames")[0][0])

    def reasons(self) -> dict[int, str]:
        """`Reason` -> its sentence, as written in the file."""
        return dict(self._ask("SELECT reason, sentence FROM reasons"))

    def summary(self) -> TrailSummary:
        """The counts of the whole trail."""
        try:
            return self._summary()
        except (TypeError, ValueError) as error:
            raise LogError(f"damaged: {error}", file=self.path) from error

    def _summary(self) -> TrailSummary:
        frames, first, last, *sums = self._ask(
            "SELECT count(*), min(frame), max(frame), total(contests), total(between_gates), total(offsets),"
            " total(rivals), total(contests + between_gates + offsets + rivals > 0) FROM frames"
        )[0]
        begin, end = self._ask("SELECT min(time), max(time) FROM frames")[0]
        reasons = {
            int(Reason(reason)): n
            for reason, n in self._ask("SELECT reason, count(*) FROM sightings GROUP BY 1")
        }
        fates = dict(self._ask("SELECT fate, count(*) FROM landmarks GROUP BY fate"))
        unused = int(self._ask("SELECT count(*) FROM sightings WHERE landmark < 0")[0][0])
        founded = reasons.get(Reason.FOUNDED, 0)
        sightings = sum(reasons.values())
        return TrailSummary(
            frames=frames,
            sightings=sightings,
            first=first,
            last=last,
            begin=begin,
            end=end,
            matched=sightings - founded - unused,
            founded=founded,
            unused=unused,
            reasons=reasons,
            landmarks=sum(fates.values()),
            confirmed=fates.get("confirmed", 0),
            trial=fates.get("trial", 0),
            retired=fates.get("retired", 0),
            merged=fates.get("merged", 0),
            troubled=int(sums[4]),
            trouble=Trouble(*map(int, sums[:4])),
            worst=self._worst(),
        )

    def _worst(self) -> tuple[tuple[int, float, Trouble], ...]:
        rows = self._ask(
            "SELECT frame, time, contests, between_gates, offsets, rivals FROM frames"
            " WHERE contests + between_gates + offsets + rivals > 0"
            " ORDER BY contests + between_gates + offsets + rivals DESC, frame LIMIT ?",
            _WORST,
        )
        return tuple((frame, known(time), Trouble(*counts)) for frame, time, *counts in rows)

    # --- a frame ------------------------------------------------------------------------------------------------

    def frame(self, number: int) -> Frame:
        """The frame with this number, as it was handed to the writer.

        Raises LogError, with the numbers that there are, if there is none.
        """
        head = self._ask("SELECT * FROM frames WHERE frame = ?", number)
        if not head:
            raise LogError(self._missing("frame", number), file=self.path)
        try:
            return self._frame(number, *head[0][1:10])
        except (TypeError, ValueError) as error:
            raise LogError(f"damaged: frame {number}: {error}", file=self.path) from error

    def _frame(self, number: int, time: Any, *head: Any) -> Frame:
        columns = "range, bearing, landmark, reason, trial, noise_rr, noise_rb, noise_bb"
        seen = self._of_frame(columns, "sightings", number)
        pairs = self._of_frame("sighting, landmark, squared, log_volume", "candidates", number)
        places = self._of_frame("landmark, x, y, p_xx, p_xy, p_yy", "expected", number)
        managed = self._of_frame("landmark, action, why, into_landmark", "managed", number)
        if any(not 0 <= row[0] < len(seen) for row in pairs):
            raise ValueError("a pair speaks of a sighting that is not there")
        numbers = _table([head], 8)[0]
        noises = _symmetric(_table([row[5:] for row in seen], 3))
        why = Why(
            gate=float(numbers[6]),
            new_gate=float(numbers[7]),
            reasons=_whole([int(Reason(row[3])) for row in seen]),
            pairs=_whole([row[:2] for row in pairs]).reshape(-1, 2),
            squared=_table([row[2:3] for row in pairs], 1)[:, 0].copy(),
            log_volume=_table([row[3:] for row in pairs], 1)[:, 0].copy(),
            notes=tuple(str(row[0]) for row in self._of_frame("note", "notes", number)),
            managed=tuple(Managed(*row) for row in managed),
        )
        return Frame(
            number=number,
            time=known(time),
            pose=numbers[:3].copy(),
            sensor=numbers[3:6].copy(),
            values=_table([row[:2] for row in seen], 2),
            labels=_whole([row[2] for row in seen]),
            trial=_whole([row[4] for row in seen]).astype(bool),
            why=why,
            landmarks=_whole([row[0] for row in places]),
            positions=_table([row[1:3] for row in places], 2),
            spreads=_symmetric(_table([row[3:] for row in places], 3)),
            noises=None if np.isnan(noises).all() else noises,
        )

    def _of_frame(self, columns: str, table: str, number: int) -> list[tuple[Any, ...]]:
        order = "sighting" if table == "sightings" else "number"
        return self._ask(f"SELECT {columns} FROM {table} WHERE frame = ? ORDER BY {order}", number)

    def frame_at(self, time: float) -> Frame:
        """The frame nearest to a time in s, of equals the earlier. Raises LogError if there is no frame at all."""
        if not math.isfinite(time):
            raise LogError(f"{time} is no time: expected a finite number of seconds", file=self.path)
        rows = self._ask(
            "SELECT frame FROM frames WHERE time IS NOT NULL ORDER BY abs(time - ?), frame LIMIT 1", time
        )
        if not rows:
            raise LogError("the audit trail holds no frame", file=self.path)
        return self.frame(rows[0][0])

    # --- a landmark ---------------------------------------------------------------------------------------------

    def final(self, label: int) -> int:
        """The landmark that a number stands for after all mergers; the number itself if it was never merged."""
        return last_name(self._ask, label)

    def landmark(self, number: int) -> Story:
        """The story of a landmark. Raises LogError, with the numbers that there are, if there never was such a one."""
        try:
            story = tell(self._ask, number)
        except (TypeError, ValueError) as error:
            raise LogError(f"damaged: landmark {number}: {error}", file=self.path) from error
        if story is None:
            raise LogError(self._missing("landmark", number), file=self.path)
        return story

    def _missing(self, kind: str, number: int) -> str:
        """Why there is no such frame or landmark, with the numbers that there are."""
        table = f"{kind}s"
        low, high = self._ask(f"SELECT min({kind}), max({kind}) FROM {table}")[0]
        if low is None:
            return f"{kind} {number} does not exist: the audit trail holds no {kind}"
        nearest = self._ask(
            f"SELECT {kind} FROM {table} ORDER BY abs({kind} - ?), {kind} LIMIT 1", float(number)
        )[0][0]
        return f"{kind} {number} does not exist; numbers run from {low} to {high}, the nearest is {nearest}"


def _table(rows: list[Any], columns: int) -> np.ndarray:
    """(n, columns) float64, NaN where a number is not known."""
    return np.array(rows, dtype=np.float64).reshape(-1, columns)


def _whole(values: list[Any]) -> np.ndarray:
    return np.array(values, dtype=np.int64)


def _symmetric(lower: np.ndarray) -> np.ndarray:
    """(n, 3) lower triangles -> (n, 2, 2)."""
    return lower[:, (0, 1, 1, 2)].reshape(-1, 2, 2)
