"""What a running session asks of a search, what it is answered, and whom it asks: no search is imported for that."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from sms_online.description.schema import Effect, System
from sms_online.diagnosis.record import Segment
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.events import Event
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensor_noise import SensorNoise
from sms_online.stream import Array, Block
from sms_online.trackers.interface import Prior

# Candidates whose evidence is reported, the best ones.
REPORTED = 8


@dataclass(frozen=True)
class Request:
    """Samples of a session that show more than noise.

    model, base: those of the session, of `model.system`. segments: gap-free samples of the session's channels as they
    came. late: number of the first segment that holds the effect, if it began at all. beta (n,): parameters behind the
    rows' noise; whitened: they come from rows that were whitened by it. prior: what is known of them beforehand.
    """

    model: Model
    base: BaseParameters
    sensing: Sensing
    noise: SensorNoise
    segments: tuple[Segment, ...]
    late: int
    beta: Array
    whitened: bool
    prior: Prior | None


@dataclass(frozen=True)
class RecordedRequest:
    """Samples as they came, of a session whose parameters come from the smoother: they are diagnosed as a capture is.

    system: with what events have added. source: names the samples. prior: what is known beforehand, see
    `priors.given_prior`; events: before the samples, behind which less of it is known.
    """

    system: System
    blocks: tuple[Block, ...]
    source: str
    prior: bool | dict[str, Any]
    events: tuple[Event, ...] = ()


AnyRequest = Request | RecordedRequest


@dataclass(frozen=True)
class Named:
    """An effect that the record shows.

    effect: as a system file declares it. parameters, values (c,): its unknowns of π, none where it is a constant.
    coefficients: as people read them, name to value, 1σ (None where there is none) and unit. gain: evidence, twice the
    log likelihood ratio; limit: what the best of all absent candidates reaches by chance. ambiguous: keys of others
    that explain as much.
    """

    effect: Effect
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    stds: Array
    coefficients: dict[str, tuple[float, float | None, str]]
    gain: float
    limit: float
    ambiguous: tuple[str, ...]

    @property
    def key(self) -> str:
        """name@where."""
        return self.effect.key

    @property
    def sizes(self) -> dict[str, tuple[float, float, str]]:
        """Value, 1σ and unit of each parameter, or of each constant where it has none."""
        if self.parameters:
            read = zip(self.values.tolist(), self.stds.tolist(), self.units, strict=True)
            return dict(zip(self.parameters, read, strict=True))
        said = self.coefficients.items()
        return {f"{self.key}.{name}": (value, std, unit) for name, (value, std, unit) in said if std is not None}


@dataclass(frozen=True)
class Outcome:
    """The answer of a search: verdict "clean", "named" or "unexplained", or "mistake" where samples hold one.

    named: the effects found, also where they leave more than noise. mistakes: of units, signs and wiring, a sentence
    each; effects beside them are there once they are undone. scores: gain of the best candidates alone, by key.
    left: share of what was beyond noise that is left. began: whether the effects are absent from the segments before
    the late ones. beta (n,): parameters with the effects. ended: so much is lacking that the search ended before it
    had found all.
    """

    verdict: str
    named: tuple[Named, ...]
    scores: dict[str, float]
    left: float
    began: bool
    beta: Array
    ended: bool = False
    mistakes: tuple[str, ...] = ()

    @property
    def keys(self) -> tuple[str, ...]:
        """What was found, in an order that does not depend on that of the search."""
        return tuple(sorted(named.key for named in self.named))

    @property
    def found(self) -> tuple[str, tuple[str, ...], tuple[str, ...]]:
        """What two searches have to agree on."""
        return self.verdict, self.keys, self.mistakes


class Searcher(Protocol):
    """Makes searches, one at a time."""

    def submit(self, number: int, request: AnyRequest) -> bool:
        """Begin a search; False where this one is left out."""

    def outcome(self, block: int) -> tuple[int, Outcome | None] | None:
        """Number of the search that was begun, and its answer, once, from the internal block on that may use it."""
