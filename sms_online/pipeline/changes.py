"""From an alarm to an adopted event: rows held back, hypotheses compared, the estimate opened where it jumped."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from sms_online.calibration.nuisance import Nuisance, known_beforehand
from sms_online.description.schema import Effect, TrackerChoice
from sms_online.effects.build import changed_model, declaring
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.drift_line import DriftLine
from sms_online.pipeline.event_hypotheses import (
    Explanation,
    additional,
    everything,
    extended,
    restricted,
)
from sms_online.pipeline.event_instant import event_instant
from sms_online.pipeline.event_rows import CLOCK, LARGEST_SHIFT, AfterChange, EventRows
from sms_online.pipeline.events import REMEMBERED, TRANSIENT, ChangeDetector, ClockShift, Event, Seen, prior_behind
from sms_online.pipeline.latency import wandering_clocks
from sms_online.pipeline.momentum_balance import MARGIN
from sms_online.pipeline.momentum_windows import INSTANTS
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensor_noise import SensorNoise
from sms_online.pipeline.synchronise import GridSamples
from sms_online.state import Stage, State
from sms_online.stream import Array, Indices
from sms_online.trackers.information import Information
from sms_online.trackers.interface import Prior

# Windows after the event that a decision takes, and where two hypotheses remain, or a gap comes.
DECISION = 10
LONGEST_DECISION = 40
LEAST_DECISION = 5
# An instant is certain to so many half hops; samples closer to it are left out on both sides.
GUARD = 1


@dataclass(frozen=True)
class Adoption:
    """What the session goes on with after an event.

    base: its parameters, of `model`. known: what is known of them. weights (n,): values behind the weights of the rows
    to come. misfit (n_v,): what the model lacked in the rows before, see `WhiteRows`. samples: those after the event.
    """

    model: Model
    base: BaseParameters
    known: Information
    weights: Array
    misfit: Array
    samples: GridSamples


@dataclass(frozen=True)
class ModelUpdate:
    """Effects that the model lacked, to go on with.

    event: what is reported of them. known: from rows that they had no part in. weights (n + c,): of the parameters,
    then the effects'. since: grid index from which on samples hold them.
    """

    effects: Sequence[Effect]
    event: Event
    known: Information
    weights: Array
    since: int


class ChangesState(State):
    """Events so far, and what the next one is decided by.

    index (B,), values (B, ·): samples of the last segment, as far back as windows are remembered. events: so far;
    added: names of the parameters that they have added, adopted: effects among these. clear: grid index from which on
    no sample is from before the event. wanted: windows after it that the next decision takes. shifts: of clocks.
    reference: values of the model's parameters by name whose masses adopted effects act on.
    """

    index: Indices
    values: Array
    events: list[Event] = msgspec.field(default_factory=list)
    shifts: list[ClockShift] = msgspec.field(default_factory=list)
    added: list[str] = msgspec.field(default_factory=list)
    adopted: tuple[Effect, ...] = ()
    reference: dict[str, float] = msgspec.field(default_factory=dict)
    segment: int = -1
    clear: int = 0
    wanted: int = DECISION


class Changes(Stage):
    """Events of one session.

    model, base: current ones, with what events have added to the system's own. Information is on the session's
    nuisances and then on the parameters. renewed: called when a saved state has put other events here. point: gives the
    nuisances (m,) that samples are corrected by. off: gives by how much the session's estimate (m + n,) differs from
    least squares, which shrink with noise in the columns of gains where rows leave more than noise. judged: the tracker
    that is judged. drift: gives the known one, see `EventRows`.
    """

    def __init__(
        self,
        model: Model,
        base: BaseParameters,
        sensing: Sensing,
        nuisances: Sequence[Nuisance],
        renewed: Callable[[], None],
        point: Callable[[], Array],
        off: Callable[[], Array],
        judged: TrackerChoice,
        drift: Callable[[int], DriftLine | None],
    ) -> None:
        self.model, self.base = model, base
        self._point, self._off = point, off
        self._nuisances = tuple(nuisances)
        self._system, self._described = model.system, base
        self._sensing = sensing
        self._renewed = renewed
        self._clocks = wandering_clocks(sensing, self._nuisances)
        self._judged, self._drift = judged, drift
        rate, span = self._system.sample_rate, self._system.windows.momentum
        self._half_hop = max(1, round(span * rate / INSTANTS))
        # Where it may have been a drift, an event is decided on later.
        self._remembered = 2 * REMEMBERED if judged.learns else REMEMBERED
        self.detector = self._new_detector()
        columns = len(sensing.channels) + model.n_states
        self.state = ChangesState(np.empty(0, dtype=np.int64), np.empty((0, columns)))

    def renew(self) -> None:
        """See Stage."""
        if self.events:
            adopted, self.state.adopted = self.state.adopted, ()
            self._follow_adopted(adopted)
            self.detector = self._new_detector()
            self._renewed()

    @property
    def events(self) -> list[Event]:
        """Events of the session so far."""
        return self.state.events

    @property
    def shifts(self) -> list[ClockShift]:
        """Of the devices' clocks so far."""
        return self.state.shifts

    @property
    def adopted(self) -> tuple[Effect, ...]:
        """Effects that the session goes on with, beside those of the system."""
        return self.state.adopted

    def _new_detector(self) -> ChangeDetector:
        n, hop = len(self._nuisances) + self.base.n, 2 * self._half_hop / self._system.sample_rate
        detector = ChangeDetector(n, self.model.layout.n_v, hop, self._remembered, self._clocks)
        if self._nuisances:
            detector.begin(self.beforehand)
        return detector

    @property
    def beforehand(self) -> Information:
        """What is known of the nuisances before any row, and nothing of the parameters."""
        return known_beforehand(self._nuisances, self.base.n)

    def parameters(self, known: Information) -> Array:
        """β (n,) as it is known."""
        return known.solution().pi[len(self._nuisances) :]

    @property
    def window_samples(self) -> int:
        """Samples of a window."""
        return INSTANTS * self._half_hop

    def keep(self, piece: GridSamples) -> None:
        """Remember samples of the grid: those of one segment, as far back as windows are remembered."""
        if piece.segment != self.state.segment:
            self.state.segment, self.state.clear = piece.segment, int(piece.index[0])
            self.state.index, self.state.values = self.state.index[:0], self.state.values[:0]
        kept = 2 * self._remembered * self._half_hop + self.window_samples + 2 * MARGIN
        self.state.index = np.concatenate((self.state.index, piece.index))[-kept:]
        self.state.values = np.concatenate((self.state.values, piece.values))[-kept:]

    @property
    def windows_after(self) -> int:
        """Number of windows that samples from after the event give."""
        if self.detector.alarm is None or self.state.index.size == 0:
            return 0
        samples = (
            int(self.state.index[-1]) - max(self.detector.alarm, self.state.clear) - self.window_samples - 2 * MARGIN
        )
        return max(0, samples // (2 * self._half_hop))

    def decide(
        self, noise: SensorNoise, start_time: float, last: bool, steps: bool = False
    ) -> Adoption | AfterChange | None:
        """The event, once the windows after it suffice to decide; what they show so far where they do not.

        None where there is nothing new to see. Where the model lacked something before, only a jump that explains the
        rows is one, and the alarm is dismissed otherwise. start_time: s of grid index 0. last: in this segment no more
        windows come. steps: it may be a drift yet, and is none only where a jump explains the rows and does not go on.
        """
        alarm, wanted = self.detector.alarm, min(self.state.wanted, LONGEST_DECISION)
        if alarm is None or self.windows_after < (LEAST_DECISION if last else self.state.wanted if steps else wanted):
            return None
        whole = changed_model(self.model, everything(self._system))
        names = additional(self._system, whole, self.base)
        base = extended(self._described, whole, [*self.state.added, *names])
        onset = self.detector.onset - MARGIN
        before = self._before(onset)
        samples = self.behind(alarm)
        behind = self._rows.explain(whole, base, before, samples, (onset, alarm), noise)
        explanation = behind.explanation
        clear = explanation.explained and explanation.decisive and explanation.changed
        clear = clear and not (steps and behind.goes_on)
        if not clear and (steps or (not last and self.windows_after < LONGEST_DECISION)):
            self.state.wanted = self.windows_after + DECISION
            return behind
        self.state.wanted = DECISION
        if self.detector.uncertain and not (explanation.jump and explanation.explained and explanation.needed):
            self.detector.dismiss()
            return None
        late = max(alarm, int(self.state.index[-1]) - self.window_samples - 2 * MARGIN - 2 * DECISION * self._half_hop)
        if not explanation.explained and late > alarm:
            # What acts may have ended meanwhile.
            at_last = self._rows.explain(whole, base, before, self.behind(late), (onset, alarm), noise).explanation
            if not at_last.changed:
                return self._unchanged(TRANSIENT, late, start_time)
        if not explanation.changed:
            return self._unchanged(TRANSIENT, alarm, start_time)
        if explanation.jump is not None and explanation.jump.kind == CLOCK:
            return self._follow_clocks(explanation, onset, alarm, start_time)
        return self._adopt(whole, base, explanation, onset, alarm, start_time)

    def follow_drift(self, known: Information) -> None:
        """What has given an alarm, or was found without one, is a drift: test rows to come against what is known."""
        self.state.wanted = DECISION
        self.detector.begin(known)

    def abandon(self, start_time: float) -> Adoption | None:
        """The session ends while rows are held back: what was known before the event is all there is."""
        if self.detector.alarm is None:
            return None
        if self.detector.uncertain:
            self.detector.dismiss()
            return None
        return self._unchanged("undecided", int(self.state.index[-1]) + 1, start_time)

    def _unchanged(self, kind: str, until: int, start_time: float) -> Adoption:
        """Go on with what was known before an alarm, and with samples from a grid index on."""
        onset, alarm = self.detector.onset - MARGIN, self.detector.alarm
        assert alarm is not None
        before, samples = self._before(onset), self.behind(until)
        time = start_time + 0.5 * (onset + alarm) / self._system.sample_rate
        reach = until + self.window_samples
        dropped = sum(before.end < seen.end <= reach for seen in self.detector.history)
        self.state.events.append(Event(time, kind, (), (), (), (), dropped))
        known = self._known_at(before, until)
        if samples.index.size:
            self.detector = self._new_detector()
            self.detector.begin(known)
        return Adoption(self.model, self.base, known, self.parameters(known), before.misfit, samples)

    def _known_at(self, before: Seen, index: int) -> Information:
        """What was known before a change, of the parameters as they would be at a grid index: drifts go on."""
        drift = self._drift(index + self.window_samples // 2)
        return before.known if drift is None else before.known.shifted(np.pad(drift.moved, (len(self._nuisances), 0)))

    @property
    def _rows(self) -> EventRows:
        return EventRows(
            self._system, self._sensing, self._nuisances, self._clocks, self._point,
            not self._judged.static, self._judged.learns, self._drift,
        )  # fmt: skip

    def _before(self, end: int) -> Seen:
        """The last window that ends at or before a grid index, with what was known by then, free of its bias."""
        seen = self.detector.before(end)
        return replace(seen, known=seen.known.shifted(self._off())) if self.detector.uncertain else seen

    def _follow_clocks(self, explanation: Explanation, onset: int, alarm: int, start_time: float) -> Adoption:
        """Go on with the same model behind shifts of clocks, of which as much is known as they have shifted by.

        Behind a step of one nothing is known.
        """
        assert explanation.jump is not None
        shifted, m, n = list(explanation.jump.columns), len(self._nuisances), self.base.n
        time = start_time + 0.5 * (onset + alarm) / self._system.sample_rate
        for k, size, std in zip(shifted, explanation.sizes.tolist(), explanation.stds.tolist(), strict=True):
            self.state.shifts.append(ClockShift(time, self._nuisances[k].where, size, std))
        wide = [replace(self._nuisances[k], tolerance=float(np.hypot(self._nuisances[k].tolerance, size)))
                for k, size in zip(shifted, explanation.sizes, strict=True)]  # fmt: skip
        again = np.zeros((len(shifted), m + n + 1))
        again[np.arange(len(shifted)), shifted] = [1.0 / each.tolerance for each in wide]
        before = self._before(onset)
        known = self._known_at(before, (onset + alarm) // 2).without(shifted).with_rows(again)
        if (np.abs(explanation.sizes) >= LARGEST_SHIFT).any():
            known = self.beforehand.without(shifted).with_rows(again)
        self.detector = self._new_detector()
        self.detector.begin(known)
        return Adoption(
            self.model, self.base, known, explanation.beta[m : m + n], before.misfit, self.behind(alarm)
        )  # fmt: skip

    def _adopt(
        self, whole: Model, base: BaseParameters, explanation: Explanation, onset: int, alarm: int, start_time: float
    ) -> Adoption:
        jump, n, m = explanation.jump if explanation.explained else None, self.base.n, len(self._nuisances)
        columns = () if jump is None else tuple(k - m for k in jump.columns)
        instant = None
        if jump is not None:
            by = np.zeros(whole.n_pi)
            by[[base.independent[k] for k in columns]] = explanation.sizes
            x, signals = self._sensing.coordinates(self.state.values), self._sensing.signals(self.state.values)
            between = (onset - self.window_samples // 2, alarm)
            instant = event_instant(
                whole, by, explanation.beta, self.detector.seen(), self.state.index, x, signals, between,
                self._half_hop, self._system.sample_rate,
            )  # fmt: skip
        until, last, at = onset, alarm, 0.5 * (onset + alarm)
        if instant is not None:
            guard = GUARD * self._half_hop
            until, last, at = int(instant) - guard - MARGIN, int(np.ceil(instant)) + guard, instant
        before = self._before(until)
        fresh = [base.parameters[k].name for k in columns if k >= n]
        if fresh:
            self.state.added += fresh
            self._extend()
        names = [p.name for p in self.base.parameters]
        jumped = [names.index(base.parameters[k].name) for k in columns]
        weights = np.zeros(self.base.n)
        weights[:n] = explanation.beta[m:] if jumped else self.parameters(before.known)
        weights[jumped] += explanation.sizes[: len(jumped)]
        reach = last + self.window_samples
        # What no hypothesis explains leaves nothing of what was known.
        known = self.beforehand
        if jump is not None:
            known = self._known_at(before, int(at)).widened(len(fresh)).without([m + k for k in jumped])
        event = Event(
            time=start_time + at / self._system.sample_rate,
            kind="unexplained" if jump is None else jump.kind,
            parameters=tuple(names[k] for k in jumped),
            units=tuple(self.base.parameters[k].unit for k in jumped),
            sizes=tuple(float(size) for size in explanation.sizes[: len(jumped)]),
            stds=tuple(float(std) for std in explanation.stds[: len(jumped)]),
            dropped_windows=sum(until < seen.end <= reach for seen in self.detector.history),
        )
        self.state.events.append(event)
        self.detector = self._new_detector()
        self.detector.begin(known)
        return Adoption(self.model, self.base, known, weights, before.misfit, self.behind(last))

    def behind(self, index: int) -> GridSamples:
        """Samples from a grid index on, as far as they are remembered."""
        after = self.state.index >= max(index, self.state.clear)
        return GridSamples(self.state.index[after], self.state.values[after], self.state.segment)

    def adopt(self, update: ModelUpdate, samples: GridSamples) -> Adoption:
        """Go on with effects that the model lacked.

        samples: those of the session's last segment that hold the effects, as `keep` takes them; none where a gap was
        just before.
        """
        masses = self.base.physical_values(update.weights[: self.base.n])
        reference = dict(zip((p.name for p in self.model.parameters), masses.tolist(), strict=True))
        larger = changed_model(self.model, declaring(self._system, update.effects))
        held, keys = {p.name for p in larger.parameters}, {effect.key for effect in update.effects}
        fresh = [name for name in update.event.parameters if name in held]  # others are constants
        if not self.state.reference and any(each.needs_masses for each in larger.effects if each.key in keys):
            self.state.reference = reference
        self.state.added += fresh
        self._follow_adopted((*self.state.adopted, *update.effects))
        known = update.known.widened(len(fresh))
        self.state.events.append(update.event)
        self.state.segment, self.state.index, self.state.values = samples.segment, samples.index, samples.values
        self.state.clear, self.state.wanted = update.since, DECISION
        self.detector = self._new_detector()
        self.detector.begin(known)
        return Adoption(self.model, self.base, known, update.weights, np.zeros(self.model.layout.n_v), samples)

    def _follow_adopted(self, adopted: tuple[Effect, ...]) -> None:
        fresh = adopted[len(self.state.adopted) :]
        self._system = declaring(self._system, fresh)
        self.state.adopted = adopted
        if adopted or self.state.added:
            self._extend()

    def prior(self, described: Prior) -> Prior:
        """What is known beforehand of the current parameters."""
        return prior_behind(self.state.events, described, self.base.parameters)

    def _extend(self) -> None:
        """Model and base with the effects, and the parameters, that events have added."""
        self.model = changed_model(self.model, restricted(self._system, self.state.added), self.state.reference)
        self.base = extended(self._described, self.model, self.state.added)

    @property
    def added(self) -> tuple[str, ...]:
        """Names of the parameters that events have added, in their order."""
        return tuple(self.state.added)
