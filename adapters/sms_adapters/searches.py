"""Searches of a recorded session's diagnosis, repeated where it is replayed."""

from __future__ import annotations

import json
from pathlib import Path

from sms_online.diagnosis.online_search import search
from sms_online.diagnosis.searcher import AnyRequest, Outcome, Searcher
from sms_online.errors import InputError

NAME = "searches.jsonl"
# Keys of its lines: a search that was begun, used at a block, or lost by then.
BEGUN, USED, LOST = "begun", "search", "lost"


class Repeated:
    """The searches that a recorded session made, each used at the block at which that one used it.

    used, lost: their blocks, of those that said something and of those that ended without. begun: also those that the
    session's end overtook.
    """

    def __init__(self, used: dict[int, int], lost: dict[int, int], begun: set[int]) -> None:
        self._blocks, self._lost, self._begun = used | lost, lost, begun
        self._done: tuple[int, Outcome | None] | None = None

    def submit(self, number: int, request: AnyRequest) -> bool:
        """See `Searcher`."""
        if self._done is not None:
            return False
        if number in self._blocks:
            self._done = number, None if number in self._lost else search(request)
            return True
        return number in self._begun

    def outcome(self, block: int) -> tuple[int, Outcome | None] | None:
        """See `Searcher`."""
        if self._done is None or block < self._blocks[self._done[0]]:
            return None
        done, self._done = self._done, None
        return done


def searcher_of(capture: Path, adopt: bool) -> Searcher | None:
    """Who searches while a capture is replayed; None for a session's own searches, whose answers are used at once.

    Of a recording that was made with the same `adopt`, answers are used when they were then. Raises InputError where
    the recording's searches are no such document.
    """
    path = capture / NAME
    if not path.is_file():
        return None
    try:
        # A session that was killed may have left half a line.
        whole = [line for line in path.read_text(encoding="utf-8").splitlines(keepends=True) if line.endswith("\n")]
        first, *others = (json.loads(line) for line in whole)
        used, lost = ({int(e[kind]): int(e["block"]) for e in others if kind in e} for kind in (USED, LOST))
        begun = {int(entry[BEGUN]) for entry in others if BEGUN in entry}
        same = bool(first["adopt"]) == adopt
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(str(path), "", f"{type(error).__name__}: {error}", "searches as `live` writes them") from None
    return Repeated(used, lost, begun) if same else None
