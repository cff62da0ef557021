"""From an alarm to an adopted event: rows held back, hypotheses compared, the estimate opened where it jumped."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_online.calibration.columns import CalibrationColumns
from sms_online.calibration.nuisance import Nuisance, known_beforehand, prior_rows
from sms_online.description.schema import Effect
from sms_online.effects.build import changed_model
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.pipeline.event_hypotheses import (
    Explanation,
    additional,
    everything,
    explain,
    extended,
    hypotheses,
    restricted,
)
from sms_online.pipeline.event_instant import event_instant
from sms_online.pipeline.events import REMEMBERED, ChangeDetector, Event, Seen
from sms_online.pipeline.momentum_balance import MARGIN, MomentumBalance
from sms_online.pipeline.momentum_fit import MomentumFit
from sms_online.pipeline.momentum_windows import COPIES, INSTANTS
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.sensor_noise import SensorNoise
from sms_online.pipeline.synchronise import GridSamples
from sms_online.pipeline.window_noise import WindowNoise
from sms_online.stream import Array
from sms_online.trackers.information import Information
from sms_online.trackers.interface import Prior

# Windows after the event that a decision takes, and where two hypotheses remain, or a gap comes.
DECISION = 10
LONGEST_DECISION = 40
LEAST_DECISION = 5
# An instant is certain to so many half hops; samples closer to it are left out on both sides.
GUARD = 1
# Times that the rows after an event are whitened, each with the jumps found before.
PASSES = 2


@dataclass(frozen=True)
class Adoption:
    """What the session goes on with after an event.

    base: its parameters, of `model`. known: what is known of them. weights (n,): values behind the weights of the rows
    to come. samples: those after the event.
    """

    model: Model
    base: BaseParameters
    known: Information
    weights: Array
    samples: GridSamples


class Changes:
    """Events of one session.

    model, base: current ones, with what events have added to the system's own. adopted: effects among that. Information
    is on the session's nuisances and then on the parameters.
    """

    def __init__(
        self, model: Model, base: BaseParameters, sensing: Sensing, nuisances: Sequence[Nuisance] = ()
    ) -> None:
        self.model, self.base = model, base
        self._nuisances = tuple(nuisances)
        self.events: list[Event] = []
        self._system, self._described = model.system, base
        self._sensing = sensing
        self._added: list[str] = []
        self.adopted: tuple[Effect, ...] = ()
        rate, span = self._system.sample_rate, self._system.windows.momentum
        self._half_hop = max(1, round(span * rate / INSTANTS))
        self.detector = self._new_detector()
        self._segment = -1
        self._index = np.empty(0, dtype=np.int64)
        self._values = np.empty((0, len(sensing.channels) + model.n_states))
        self._clear = 0  # grid index from which on no sample is from before the event
        self._wanted = DECISION

    def _new_detector(self) -> ChangeDetector:
        n, hop = len(self._nuisances) + self.base.n, 2 * self._half_hop / self._system.sample_rate
        detector = ChangeDetector(n, self.model.layout.n_v, hop)
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
        if piece.segment != self._segment:
            self._segment, self._clear = piece.segment, int(piece.index[0])
            self._index, self._values = self._index[:0], self._values[:0]
        kept = 2 * REMEMBERED * self._half_hop + self.window_samples + 2 * MARGIN
        self._index = np.concatenate((self._index, piece.index))[-kept:]
        self._values = np.concatenate((self._values, piece.values))[-kept:]

    @property
    def windows_after(self) -> int:
        """Number of windows that samples from after the event give."""
        if self.detector.alarm is None or self._index.size == 0:
            return 0
        samples = int(self._index[-1]) - max(self.detector.alarm, self._clear) - self.window_samples - 2 * MARGIN
        return max(0, samples // (2 * self._half_hop))

    def decide(self, noise: SensorNoise, start_time: float, last: bool) -> Adoption | None:
        """The event, once the windows after it are enough to tell; last: in this segment no more of them come.

        start_time: s of grid index 0.
        """
        alarm = self.detector.alarm
        if alarm is None or self.windows_after < (LEAST_DECISION if last else self._wanted):
            return None
        whole = changed_model(self.model, everything(self._system))
        names = additional(self._system, whole, self.base)
        base = extended(self._described, whole, [*self._added, *names])
        onset = self.detector.onset - MARGIN
        before = self.detector.before(onset) or self.detector.history[0]
        explanation = self._explain(whole, base, before, max(alarm, self._clear), noise)
        if not (explanation.explained and explanation.decisive) and self.windows_after < LONGEST_DECISION and not last:
            self._wanted = self.windows_after + DECISION
            return None
        self._wanted = DECISION
        return self._adopt(whole, base, explanation, onset, alarm, start_time)

    def abandon(self, start_time: float) -> Adoption | None:
        """The session ends while rows are held back: what was known before the event is all there is."""
        if self.detector.alarm is None:
            return None
        onset = self.detector.onset - MARGIN
        before = self.detector.before(onset) or self.detector.history[0]
        time = start_time + 0.5 * (onset + self.detector.alarm) / self._system.sample_rate
        dropped = sum(seen.end > before.end for seen in self.detector.history)
        self.events.append(Event(time, "undecided", (), (), (), (), dropped))
        weights = self.parameters(before.known)
        nothing = GridSamples(self._index[:0], self._values[:0], self._segment)
        return Adoption(self.model, self.base, before.known, weights, nothing)

    def _explain(self, model: Model, base: BaseParameters, before: Seen, start: int, noise: SensorNoise) -> Explanation:
        n, m = self.base.n, len(self._nuisances)
        jumps = [replace(jump, columns=tuple(m + k for k in jump.columns)) for jump in hypotheses(base.parameters)]
        after = self._index >= start
        values = self._values[after]
        balance = MomentumBalance(model, base, self._system.sample_rate, self._system.windows.momentum)
        windows, instants = balance.push(self._index[after], [self._sensing.motion(values)] * COPIES, noise.coordinates)
        weights = np.zeros(base.n)
        weights[:n] = self.parameters(before.known)
        # What the rows before left decides, where it is more than noise.
        factor = before.known.factor
        left = max(1.0, abs(factor[-1, -1]) / np.sqrt(max(1, before.known.rows - m - n)))

        def new_noise() -> WindowNoise:
            calibration = CalibrationColumns(model, self._sensing, balance.span) if m else None
            return WindowNoise(model, base, balance, self._sensing.displacements, calibration=calibration)

        for _ in range(PASSES):
            prior = prior_rows(self._nuisances, base.n)
            known = partial(np.append, np.zeros(m), weights)
            fit = MomentumFit(model, base, balance, new_noise, known, calibration=prior)
            fit.go_on(weights, noise)
            rows = np.concatenate([white.Y for white in fit.push(windows, instants, noise)])
            explanation = explain(factor / left, rows / left, jumps)
            weights = np.zeros(base.n)
            weights[:n] = explanation.beta[m:]
            if explanation.jump is not None:
                weights[[k - m for k in explanation.jump.columns]] += explanation.sizes
        return explanation

    def _adopt(
        self, whole: Model, base: BaseParameters, explanation: Explanation, onset: int, alarm: int, start_time: float
    ) -> Adoption:
        jump, n, m = explanation.jump if explanation.explained else None, self.base.n, len(self._nuisances)
        columns = () if jump is None else tuple(k - m for k in jump.columns)
        instant = None
        if jump is not None:
            by = np.zeros(whole.n_pi)
            by[[base.independent[k] for k in columns]] = explanation.sizes
            x, signals = self._sensing.coordinates(self._values), self._sensing.signals(self._values)
            between = (onset - self.window_samples // 2, alarm)
            instant = event_instant(
                whole, by, explanation.beta, self.detector.history, self._index, x, signals, between, self._half_hop,
                self._system.sample_rate,
            )  # fmt: skip
        guard = GUARD * self._half_hop
        first, last = (onset, alarm) if instant is None else (int(instant) - guard, int(np.ceil(instant)) + guard)
        at = 0.5 * (first + last) if instant is None else instant
        before = self.detector.before(first - MARGIN) or self.detector.history[0]
        fresh = [base.parameters[k].name for k in columns if k >= n]
        if fresh:
            self._added += fresh
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
            known = before.known.widened(len(fresh)).without([m + k for k in jumped])
        event = Event(
            time=start_time + at / self._system.sample_rate,
            kind="unexplained" if jump is None else jump.kind,
            parameters=tuple(names[k] for k in jumped),
            units=tuple(self.base.parameters[k].unit for k in jumped),
            sizes=tuple(float(size) for size in explanation.sizes[: len(jumped)]),
            stds=tuple(float(std) for std in explanation.stds[: len(jumped)]),
            dropped_windows=sum(first - MARGIN < seen.end <= reach for seen in self.detector.history),
        )
        self.events.append(event)
        after = self._index >= max(last, self._clear)
        samples = GridSamples(self._index[after], self._values[after], self._segment)
        self.detector = self._new_detector()
        self.detector.begin(known)
        return Adoption(self.model, self.base, known, weights, samples)

    def adopt(
        self, effects: Sequence[Effect], event: Event, known: Information, weights: Array, samples: GridSamples
    ) -> Adoption:
        """Go on with effects that the model lacked: forces without internal states, or a payload.

        event: what is to be told of it; its parameters are the effects' own. known: from rows that they had no part
        in. weights (n + c,): of the parameters, then the effects'. samples: those of the session's last segment that
        hold the effects.
        """
        self._added += event.parameters
        self._follow_adopted((*self.adopted, *effects))
        known = known.widened(len(event.parameters))
        self.events.append(event)
        self._clear, self._wanted = int(samples.index[0]), DECISION
        self.detector = self._new_detector()
        self.detector.begin(known)
        return Adoption(self.model, self.base, known, weights, samples)

    def _follow_adopted(self, adopted: tuple[Effect, ...]) -> None:
        fresh = adopted[len(self.adopted) :]
        self._system = self._system.model_copy(update={"effects": (*self._system.effects, *fresh)})
        self.adopted = adopted
        self._extend()

    def prior(self, described: Prior) -> Prior:
        """What is known beforehand of the current parameters: nothing of those that have jumped."""
        more = np.full(self.base.n - described.value.size, np.nan)
        std = np.concatenate((described.std, more))
        jumped = {name for event in self.events for name in event.parameters}
        everything_jumped = any(event.kind == "unexplained" for event in self.events)
        std[[everything_jumped or p.name in jumped for p in self.base.parameters]] = np.nan
        return Prior(np.concatenate((described.value, more)), std)

    def _extend(self) -> None:
        """Model and base with the parameters that events have added."""
        if self._added:
            self.model = changed_model(self.model, restricted(self._system, self._added))
            self.base = extended(self._described, self.model, self._added)

    def state(self) -> dict[str, Any]:
        """What `restore` needs to continue."""
        return {
            "events": np.array(json.dumps([asdict(event) for event in self.events])),
            "added": np.array(json.dumps(self._added)),
            "adopted": np.array(json.dumps([effect.model_dump() for effect in self.adopted])),
            "place": np.array([self._segment, self._clear, self._wanted]),
            "index": self._index,
            "values": self._values,
            **self.detector.state(),
        }

    @property
    def added(self) -> tuple[str, ...]:
        """Names of the parameters that events have added, in their order."""
        return tuple(self._added)

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from a saved state."""
        events = [Event.from_saved(entry) for entry in json.loads(str(state["events"]))]
        adopted = [Effect.model_validate(entry) for entry in json.loads(str(state["adopted"]))]
        self.events, self._added = events, json.loads(str(state["added"]))
        self._follow_adopted(tuple(adopted))
        self._segment, self._clear, self._wanted = (int(number) for number in state["place"])
        self._index, self._values = np.array(state["index"]), np.array(state["values"])
        self.detector = self._new_detector()
        self.detector.restore(state)
