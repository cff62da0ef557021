"""The pipeline of one session: blocks of samples in, estimates of the base parameters out.

The momentum balance gives the estimate as soon as its weights are known. Until then, and where a system asks for
nothing else, it comes from the energy balance. The two are never added up: both are functions of the same samples, so
their errors are not independent, and the momentum rows hold what the energy rows hold (power is force times speed).
Where a link has fewer sensors than coordinates the energy balance sees a static shape, and is the first fit of a
smoother that knows the dynamics; it gives the estimate as soon as its first span is through.
"""

from __future__ import annotations

from itertools import groupby, pairwise
from operator import attrgetter
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from sms_online.description.schema import System
from sms_online.effects.build import build_model, refuse_unknown_masses
from sms_online.errors import InputError
from sms_online.model.base_parameters import BaseParameters, find_base_parameters
from sms_online.model.model import Model
from sms_online.pipeline.blocks import ENERGY_BLOCK, blocks
from sms_online.pipeline.changes import Changes, ModelUpdate
from sms_online.pipeline.energy_estimate import EnergyEstimate
from sms_online.pipeline.events import Event
from sms_online.pipeline.marker_identity import MarkerIdentity, Swap
from sms_online.pipeline.momentum import Momentum
from sms_online.pipeline.observer import Observer
from sms_online.pipeline.outliers import LeftOut, Outliers
from sms_online.pipeline.preparation import Preparation
from sms_online.pipeline.rates import RateSamples, RatesStage
from sms_online.pipeline.relinearisation import Relinearisation
from sms_online.pipeline.sensing import AttitudeContinuity, Sensing, stated_period
from sms_online.pipeline.smoother_choice import smoother_of, too_slow
from sms_online.pipeline.statistics import Method, Setup
from sms_online.pipeline.synchronise import GridSamples, SyncCounters, Synchroniser
from sms_online.pipeline.tracker_bank import Reading, session_trackers
from sms_online.state import Stage, State
from sms_online.stream import Array, Block
from sms_online.threads import one_blas_thread
from sms_online.trackers.interface import Estimate, Prior

if TYPE_CHECKING:
    from sms_online.smoother.session import Smoother


class EstimatorState(State):
    """What an estimator keeps beside its stages.

    samples: received, over `duration` s from `first_time` on. pending_t (B,), pending (B, channels): samples that
    wait for their block to be whole. unbalanced: coordinates and torques that wait for the energy balance. through:
    time of the newest sample that has passed the stages, s.
    """

    pending_t: Array
    pending: Array
    samples: int = 0
    first_time: float = np.nan
    duration: float = 0.0
    unbalanced: list[GridSamples] = msgspec.field(default_factory=list)
    through: float = -np.inf


class Estimator(Stage):
    """Streams one session of a described system.

    channels: what the source's blocks hold. source: its name, for messages. Raises InputError when a channel is missing
    that the model needs, or where the system declares a tilt of the table and there is no reference.
    reference: π (n_pi,) of the system whose masses that tilt acts on, from an estimate without it or from a scale.
    observers: watch what passes, in this order. whole: samples are those of a whole capture, see `blocks`.
    """

    @one_blas_thread()
    def __init__(
        self, system: System, channels: tuple[str, ...], source: str, reference: Array | None = None,
        whole: bool = False,
    ) -> None:  # fmt: skip
        self.system = system
        self._model = model = build_model(system, reference)
        if reference is None:
            refuse_unknown_masses(model)
        self._base = base = find_base_parameters(model)
        self.sensing = Sensing(model, channels, source)
        self.observers: list[Observer] = []
        # Put back first: it knows the time of an event.
        self._synchroniser = Synchroniser(self.sensing.channels, system.sample_rate)
        self.smoother = smoother_of(base, self.sensing, channels, source, self._begin_joints)
        self.channels = tuple(dict.fromkeys((*self.sensing.channels, *self._smoothed_channels)))
        self._columns = [channels.index(name) for name in self.channels]
        self._smoothed_columns = [self.channels.index(name) for name in self._smoothed_channels]
        self._identity = MarkerIdentity(model, self.sensing, self.channels)
        # A torque may jump for one sample, and what pushes the arm.
        sensors = [k for k, name in enumerate(self.channels) if not name.startswith(("tau_", "force_", "wrench_"))]
        self._outliers = Outliers(len(self.channels), sensors)
        self._attitude = AttitudeContinuity()
        self._preparation = Preparation(model, self.sensing)
        # Positions choose the filter's width, as far as their noise is a sensor's; torques pass the same filter for the
        # sake of the lag.
        self._rates = RatesStage(system.sample_rate, *self.sensing.deciding)
        # A balance of forces does not hold in a shape that is not the link's; energies tolerate it best.
        by_energy = (
            system.balance == "energy" or self.sensing.missing or (self.smoother is not None and too_slow(self.sensing))
        )
        self.trackers = session_trackers(self.sensing, not by_energy)
        if by_energy and self.smoother is None and not all(choice.static for choice in self.trackers):
            found = "a tracker of its own, and no momentum balance"
            raise InputError(system.name, "tracker", found, "rls without forgetting, or all coordinates measured")
        self._relinearisation = (
            None if by_energy else Relinearisation(model, base, self.sensing, self.trackers, self._begin_joints)
        )
        # Behind what may have it begin anew when states are put back.
        self.energy = EnergyEstimate(model, base, system.sample_rate)
        self.energy.begin_joints(model, base, None if by_energy else self.sensing)
        slowest = None if by_energy else stated_period(system, self.sensing.channels)
        self._first_block, self._block = blocks(system, slowest, whole)
        self.finished = False  # no more samples come
        self.prior: Prior | None = None
        self._setup: tuple[int, Setup] | None = None  # and the number of events that it is since
        self.state = EstimatorState(np.empty(0), np.empty((0, len(self._columns))))

    @property
    def momentum(self) -> Momentum | None:
        """The momentum balance, None where energies alone are balanced; another one where it is relinearised."""
        return None if self._relinearisation is None else self._relinearisation.momentum

    def renew(self) -> None:
        """See Stage."""
        self._setup = None
        self._synchroniser.resumed = self.end
        if self.smoother is not None:
            self.smoother.resume(self.end)

    @one_blas_thread()
    def set_prior(self, prior: Prior) -> None:
        """Add what is known of the base parameters beforehand as a prior; before the first sample."""
        self.prior, self._setup = prior, None
        self.energy.set_prior(prior)
        if self._relinearisation is not None:
            self._relinearisation.set_prior(prior)
        if self.smoother is not None:
            self.smoother.set_prior(prior)

    @property
    def _smoothed_channels(self) -> tuple[str, ...]:
        return () if self.smoother is None else self.smoother.channels

    @property
    def unused(self) -> tuple[str, ...]:
        """Channels of the source that play no part."""
        return tuple(name for name in self.sensing.unused if name not in self.channels)

    @property
    def _changing(self) -> Changes | Smoother | None:
        """What finds changes."""
        return self.smoother if self.momentum is None else self.momentum.changes

    @property
    def model(self) -> Model:
        """The system's model, with what events have added to it."""
        return self._model if self._changing is None else self._changing.model

    @property
    def base(self) -> BaseParameters:
        """The parameters that are estimated: the system's own, and what events have added to them."""
        return self._base if self._changing is None else self._changing.base

    @property
    def events(self) -> list[Event]:
        """Changes of the system while the session ran."""
        return [] if self._changing is None else self._changing.events

    def _begin_joints(self) -> None:
        """Residuals of the joints count since the last event, in the parameters that hold since then."""
        since = (self.events[-1].time - self.start_time) * self.system.sample_rate if self.events else 0.0
        sensing = None if self.momentum is None else self.sensing
        self.energy.begin_joints(self.model, self.base, sensing, int(np.ceil(since)))

    @property
    def samples(self) -> int:
        """Samples received."""
        return self.state.samples

    @property
    def duration(self) -> float:
        """Time from the first sample to the last, s."""
        return self.state.duration

    @property
    def end(self) -> float:
        """Time of the newest sample, s; NaN before the first."""
        return self.state.first_time + self.state.duration

    @property
    def newest_row(self) -> float:
        """Time of the newest sample behind the estimate, s; -inf where there is none."""
        if self.smoother is not None and self.by_smoother:
            return self.smoother.end
        if self.momentum is not None and self.by_momentum:
            return self.momentum.state.newest_row
        return self.energy.state.newest_row

    @property
    def by_smoother(self) -> bool:
        """Whether the estimate comes from the smoother: beside a momentum balance as long as nothing changes."""
        if self.smoother is None:
            return False
        some = self.smoother.known.spans > 0
        # Behind a change that nothing explains it knows that nothing is known.
        return some or bool(self.events) if self.momentum is None else some and not self.events

    @property
    def by_momentum(self) -> bool:
        """Whether the estimate comes from the momentum balance."""
        if self.momentum is None or self.by_smoother:
            return False
        return self.momentum.started or self.system.balance == "momentum"

    def readings(self, t: float) -> tuple[Reading, ...]:
        """Readings of each chosen tracker at t, s, the judged one first; empty where that is least squares alone."""
        if self.smoother is not None and self.by_smoother:
            return self.smoother.readings()
        return self.momentum.readings(t) if self.momentum is not None and self.by_momentum else ()

    @property
    def method(self) -> Method:
        """What the estimate comes from."""
        if self.by_smoother:
            return "smoother"
        return "momentum" if self.by_momentum else "energy"

    @property
    def setup(self) -> Setup:
        """What is estimated now: one object from one event to the next."""
        if self._setup is None or self._setup[0] != len(self.events):
            behind = self.smoother if self.momentum is None else self.momentum
            current = self.prior if behind is None else behind.current_prior
            now = self.model, self.base, self._base
            nuisances = () if self.momentum is None else self.momentum.nuisances
            smoothed = () if self.smoother is None else self.smoother.nuisances
            channels, priors = (self.sensing, self.unused), (self.prior, current)
            setup = Setup(self.system, *now, *channels, *priors, nuisances, smoothed, self.trackers)
            self._setup = len(self.events), setup
        return self._setup[1]

    @property
    def periods(self) -> Array:
        """Sample period of each channel, s, as found; NaN while it is not known."""
        return self._synchroniser.periods

    @property
    def start_time(self) -> float:
        """Time of the grid's index 0, s."""
        return self._synchroniser.start_time

    @property
    def swaps(self) -> list[Swap]:
        """Markers that cameras have taken for each other."""
        return self._identity.state.swaps

    @property
    def outliers(self) -> dict[str, LeftOut]:
        """Samples left out as outliers, of each channel with any."""
        return self._outliers.found(self.channels)

    @property
    def counters(self) -> SyncCounters:
        """Counts of the synchroniser: missing and interpolated cells, gaps, lost samples."""
        return self._synchroniser.counters

    @property
    def last_time(self) -> Array:
        """Time of each channel's last sample (channels,), s; -inf where none has come yet."""
        pending = self.state.pending[:, : len(self.sensing.channels)]
        waiting = np.where(np.isnan(pending), -np.inf, self.state.pending_t[:, None])
        return np.asarray(np.maximum(self._synchroniser.last_time, waiting.max(axis=0, initial=-np.inf)))

    def push(self, block: Block) -> None:
        """Take samples, in order of time; any number at a time."""
        if block.t.size == 0:
            return
        if np.isnan(self.state.first_time):
            self.state.first_time = float(block.t[0])
        self.state.samples += block.t.size
        self.state.duration = float(block.t[-1]) - self.state.first_time
        self.state.pending_t = np.concatenate((self.state.pending_t, block.t))
        self.state.pending = np.concatenate((self.state.pending, block.values[:, self._columns]))
        number = np.floor((self.state.pending_t - self.state.first_time - self._first_block) / self._block)
        ends = np.flatnonzero(np.diff(number)) + 1
        if ends.size:
            with one_blas_thread():
                for start, stop in pairwise([0, *ends.tolist()]):
                    self._synchronise(self.state.pending_t[start:stop], self.state.pending[start:stop])
            self.state.pending_t, self.state.pending = self.state.pending_t[ends[-1] :], self.state.pending[ends[-1] :]

    @one_blas_thread()
    def finish(self) -> None:
        """End of the session: process what is still pending."""
        self.finished = True
        self._synchronise(self.state.pending_t, self.state.pending, last=True)
        self.state.pending_t, self.state.pending = self.state.pending_t[:0], self.state.pending[:0]
        for piece in self._synchroniser.flush():
            self._prepare(piece)
        self._end_motion()
        if self._relinearisation is not None:
            self._relinearisation.finish(self.periods)
        if self.smoother is not None:
            self.smoother.work(self._balanced, last=True)

    def _synchronise(self, t: Array, values: Array, last: bool = False) -> None:
        t, values = self._outliers.push(t, self._identity.push(t, values), last)
        received = Block(t, self.channels, values)
        for observer in self.observers:
            observer.received(received)
        own = len(self.sensing.channels)
        block = self._attitude.continued(Block(t, self.sensing.channels, values[:, :own]))
        if self.smoother is not None:
            every = np.concatenate((block.values, values[:, own:]), axis=1)
            self.smoother.gathered.push(t, self.sensing.joint_torque(block.values), every[:, self._smoothed_columns])
        if self._relinearisation is not None:
            self._relinearisation.observe(block.t, block.values)
        for piece in self._synchroniser.push(block):
            self._prepare(piece)
        if self.smoother is not None:
            self.smoother.work(self._balanced)
        if t.size:
            self.state.through = float(t[-1])
        for observer in self.observers:
            observer.block_through()

    def adopt(self, update: ModelUpdate, samples: GridSamples) -> None:
        """Go on with effects that the model lacked; from within `Observer.block_through` alone.

        samples: of the channels as they came, in the session's newest segment, that hold the effects.
        """
        assert self._relinearisation is not None
        differs = self._preparation.differs(update.effects)
        if differs:
            # The motion so far is that of other samples.
            self._end_motion()
        prepared = self._preparation.begin(update.effects, samples, differs)
        self._relinearisation.adopt(update, prepared, self.periods if differs else None)

    def _prepare(self, piece: GridSamples) -> None:
        for observer in self.observers:
            observer.samples(piece)
        for ready in self._preparation.push(piece):
            motion = self.sensing.motion(ready.values[:, : len(self.sensing.channels)])
            self.state.unbalanced.append(GridSamples(ready.index, motion, ready.segment))
            waiting = sum(each.index.size for each in self.state.unbalanced)
            # Beside momentum rows nobody waits for those of the energy.
            if self.momentum is None or waiting >= ENERGY_BLOCK:
                self._balance_waiting()
            if self._relinearisation is not None:
                self._relinearisation.push(ready, self._synchroniser.start_time, self.periods)

    def _end_motion(self) -> None:
        self._balance_waiting()
        for rates in self._rates.flush():
            self._balance(rates)

    def _balance_waiting(self) -> None:
        waiting, self.state.unbalanced = self.state.unbalanced, []
        for segment, run in groupby(waiting, key=attrgetter("segment")):
            pieces = list(run)
            index, values = (np.concatenate([getattr(each, part) for each in pieces]) for part in ("index", "values"))
            for rates in self._rates.push(GridSamples(index, values, segment)):
                self._balance(rates)

    def _balance(self, rates: RateSamples) -> None:
        n_x = self.model.layout.n_x
        x, inputs = rates.values[:, :n_x], rates.values[:, n_x:]
        v = self.model.layout.speeds(x, rates.rates[:, :n_x])
        if self.smoother is not None:
            self.smoother.gathered.move(rates.index, x, v)
        states = self._preparation.states(rates)
        for observer in self.observers:
            observer.motion(rates.index, rates.segment, x, v, inputs, states)
        signals = np.concatenate((inputs, states), axis=1)
        self.energy.push(
            rates.index, rates.segment, x, v, signals, self._rates.sigma[n_x:], self._synchroniser.start_time
        )

    @one_blas_thread()
    def estimate(self) -> Estimate:
        """The base parameters as they are known now."""
        if self.smoother is not None and self.by_smoother:
            return self.smoother.estimate()
        return self._balanced()

    def _balanced(self) -> Estimate:
        """The base parameters as the balances determine them."""
        if self.momentum is not None and self.by_momentum:
            return self.momentum.estimate(self.end)
        return self.energy.tracker.estimate()
