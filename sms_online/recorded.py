"""A recorded session as one record: its samples, and what was recorded with them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from sms_online.checkpoint import Checkpoint
from sms_online.description.schema import TrackerChoice
from sms_online.diagnosis.searcher import Searcher
from sms_online.stream import Source


@dataclass(frozen=True)
class Recorded:
    """A recorded session: its samples, a name for messages, and what was recorded with them.

    truth: of a simulation. checkpoint: what the session resumed from. searcher: of its diagnosis, from whether effects
    are adopted; None for the session's own. trackers: those that were asked for in place of the system file's, if any.
    """

    source: Source
    name: str
    truth: Mapping[str, Any] | None = None
    checkpoint: Checkpoint | None = None
    searcher: Callable[[bool], Searcher | None] = lambda adopt: None
    trackers: tuple[TrackerChoice, ...] = ()
