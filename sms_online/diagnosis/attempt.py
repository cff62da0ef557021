"""One description of a system against the samples of a session: rows, search, residuals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sms_online.description.channels import concerns
from sms_online.description.schema import Effect, System
from sms_online.diagnosis.candidate_rows import CandidateRows
from sms_online.diagnosis.candidates import CandidateColumns
from sms_online.diagnosis.constants import corrected, is_constant
from sms_online.diagnosis.folds import Folds
from sms_online.diagnosis.followed import least_samples
from sms_online.diagnosis.hypothesis import LARGEST_SHARE_LEFT, REWEIGHED, Hypothesis
from sms_online.diagnosis.record import LONGEST, Segment, bounded, excerpts
from sms_online.diagnosis.relative import RelativeResiduals
from sms_online.diagnosis.residuals import ResidualTest, RowResidual, whitened
from sms_online.diagnosis.rows import SessionRows
from sms_online.diagnosis.start_weights import first_weights, reweight, same_weights
from sms_online.effects.build import build_model, declaring, with_effects, with_kinematics
from sms_online.errors import InputError
from sms_online.pipeline.conditioning import noise_gains
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.pipeline.second_order import SecondOrderNoise
from sms_online.pipeline.sensor_noise import SensorNoise
from sms_online.stream import Array
from sms_online.trackers.interface import Prior

# Part of a session that decides which kinematics of links are nearer, and improves channels' constants, s.
SOME = 8.0


@dataclass(frozen=True)
class Part:
    """Residuals of a model with what was fitted, by row type; whitened over the predicted deviation, relative to the
    measured torque or force."""

    whitened: dict[str, float]
    relative: dict[str, float]


@dataclass(frozen=True)
class ModelFit:
    """What a model, with or without the effects found, makes of the session.

    system: with the effects. solution (n + c,): parameters and coefficients. residual (W, n_v): of all windows, over
    each row's own predicted deviation; time (W,): their middles, s since grid index 0. fit: of all of the capture.
    holdout: of another capture, or of blocks of this one predicted from the others.
    """

    system: System
    solution: Array
    residual: Array
    time: Array
    fit: Part
    holdout: Part
    test: dict[str, RowResidual]

    @property
    def excess(self) -> float:
        """Sum of squares beyond noise."""
        return float(np.sum(self.residual**2) - self.residual.size)


@dataclass(frozen=True)
class Step:
    """What a search had found when it took one more effect.

    taken: its key, name@where; effects: all keys by then, what it replaced left out. relative: residual by joint over
    the measured torque or force, blocks predicted from the others.
    """

    taken: str
    effects: tuple[str, ...]
    relative: dict[str, float]


# Receives what is being done, a few words, and the share of all that is done, roughly.
Progress = Callable[[str, float], None]
# Shares of the time of a diagnosis that are over when the described model is fitted, its residual traced, and searched;
# what is found is fitted in the rest. Measured on the planar example of 20 s.
FITTED_ONCE, TRACED, SEARCHED = 0.25, 0.6, 0.75
# Gives what is known beforehand of the parameters of an estimator's model.
PriorOf = Callable[[Estimator], Prior | None]


@dataclass(frozen=True)
class Case:
    """A capture to be diagnosed: its session with the system as described, samples, and those held out.

    progress: see `Progress`. stop: whether to end with what has been found. learned: whether curves are tried where no
    law is selected. begins: of further captures, see `captures`. use_prior: whether a search heeds the prior.
    reconstructed: channels that no sensor reads, of which no effect is looked for.
    """

    source: str
    session: Estimator
    noise: SensorNoise
    segments: Sequence[Segment]
    held: Sequence[Segment]
    prior: PriorOf
    progress: Progress = lambda what, share: None
    stop: Callable[[], bool] = lambda: False
    learned: bool = False
    begins: tuple[float, ...] = ()
    use_prior: bool = True
    reconstructed: tuple[str, ...] = ()


def _noise_behind(described: Estimator, case: Case) -> SensorNoise:
    """The noise of the samples of a case, corrected as another session describes it."""
    sensing = described.sensing
    columns = [*sensing.position_columns, *sensing.torque_columns]
    own, before = (noise_gains(each.system, sensing.channels)[columns] for each in (described, case.session))
    grid = case.noise.grid * own / before
    coordinates = sensing.coordinate_noise(grid[: len(sensing.position_columns)])
    return replace(case.noise, grid=grid, coordinates=coordinates)


class Attempt(Hypothesis):
    """One description of the system against the samples of a whole capture."""

    def __init__(
        self,
        case: Case,
        system: System,
        constants: Sequence[Effect] = (),
        beta: Array | None = None,
        candidates: Sequence[Effect] | None = None,
        most: float = LONGEST,
        second_order: SecondOrderNoise | None = None,
    ) -> None:
        """constants: see that module. beta (n,): behind the noise of rows, from the rows themselves unless given.
        candidates: all by default. most: s of the session that are used. second_order: see `SessionRows`.
        """
        self.case, self.system = case, system
        session = case.session
        declared = with_effects(system, constants)
        # An event may have added an effect to the session's model.
        same = with_kinematics(declared) == session.model.system
        estimator = session if same else Estimator(declared, session.sensing.channels, case.source)
        self._known = case.prior(estimator)
        prior = self._known if case.use_prior else None
        noise = _noise_behind(estimator, case)
        span = system.windows.momentum
        length, longest = bounded(system)
        longest = min(longest, round(most * system.sample_rate))
        least = least_samples(system)
        # Corrections reach beyond a stretch.
        channels = session.sensing.channels
        whole = ([corrected(declared, channels, segment) for segment in each] for each in (case.segments, case.held))
        fitting, self._held = (
            [part for part in excerpts(each, length, longest) if part.index.size > least] for each in whole
        )
        rows = SessionRows(
            estimator.model, estimator.base, estimator.sensing, noise, fitting, second_order=second_order
        )
        make = CandidateColumns(rows, declared)
        # Half of the windows, where there are two blocks, give twice as many rows as there are parameters.
        wanted = 2 * (2 * rows.base.n // rows.model.layout.n_v + 1)
        if rows.count < wanted:
            seconds = least / system.sample_rate + wanted * span / HOPS
            expected = f"some {seconds:.1f} s without a gap, to fit and to check"
            raise InputError(case.source, "", f"too few windows of {span:g} s: {rows.count}", expected)
        capture = np.searchsorted(case.begins, rows.time)
        folds = Folds.of(rows.weak.windows.segment, rows.time, capture=capture)
        if candidates is None:
            every = make.effects(case.learned)
            effects = [effect for effect in every if not concerns(effect.where, case.reconstructed)]
        else:
            effects = list(candidates)
        self._lasting = [effect for effect in effects if is_constant(effect)]
        forces = [effect for effect in effects if not is_constant(effect)]
        made = make.seen(forces) if candidates is None else [make.of(effect) for effect in forces]
        if beta is None:
            laws = [candidate for candidate in made if not candidate.traits.learned]
            first_weights(rows, laws, prior, session.estimate().pi if same else None)
        else:
            reweight(rows, beta)
        self._most_found = 0
        super().__init__(make, [*make.seen(self._lasting), *made], folds, prior, constants)

    def trial(self, system: System, constants: Sequence[Effect], beta: Array, effects: Sequence[Effect]) -> Attempt:
        """A quick attempt with no candidates but some effects, on stretches of the session.

        On all of it where internal states would begin at rest in each stretch. Noise beyond first order is that of this
        attempt's rows, whatever else becomes of them: the same measure for all that are compared.
        """
        forces = tuple(effect for effect in (*system.effects, *effects) if not is_constant(effect))
        states = build_model(system.model_copy(update={"effects": forces})).n_states
        return Attempt(self.case, system, constants, beta, effects, LONGEST if states else SOME, self.rows.second_order)

    def by_rows(self, chosen: Sequence[int]) -> bool:
        """Whether parameters are those of these rows, and not those of a session with those chosen.

        So they are with a prior that these heed; without any prior, where rows without a torque leave far more than
        noise: nothing says then at which scale a session ends.
        """
        self.tracing.weigh(chosen)
        return self.prior is not None or (self.tracing.exceeds_by_much and self._known is None)

    def watch(self, chosen: Sequence[int]) -> bool:
        """See `Hypothesis`."""
        if chosen and len(chosen) > self._most_found:
            self._most_found = len(chosen)
            self.case.progress(f"found so far: {', '.join(self.tracing.candidates[k].key for k in chosen)}", TRACED)
        return self.case.stop()

    def search(self, begun: Sequence[Effect] = ()) -> list[int]:
        """Numbers of the candidates found, with rows whitened by what was found if it explains them.

        begun: effects that were found before in nearly the same rows, to go on from.
        """
        chosen = self.run(begun)
        for _ in range(REWEIGHED):
            # A refined shape may explain what nothing did when the rows were first whitened.
            self.tracing.weigh(chosen)
            beta = self.solution(chosen)[: self.rows.base.n]
            if self.prior is not None:
                beta = np.where(self.prior.known, self.prior.value, beta)
            # Rows that leave more than noise whatever is added are weighted by that.
            if self.tracing.exceeds or same_weights(self.rows, beta):
                break
            if self.excess(chosen) > LARGEST_SHARE_LEFT * self.excess([]):
                break
            self.rows.reweight(beta)
            forces = [candidate for candidate in self.tracing.candidates if not candidate.constant]
            begun = [self.tracing.candidates[k].effect for k in chosen]
            self.trace([*self.make.seen(self._lasting), *forces])
            chosen = self.run(begun)
        return chosen

    def conclude(self, chosen: Sequence[int]) -> None:
        """Improve the constants by all the rows, once more: they were found on stretches.

        The rows stay: their columns give to second order what so small a change makes of them.
        """
        self.constants = self.improved(self.solution(chosen))

    def adopted(self, chosen: Sequence[int]) -> System:
        """The described system with everything that was found."""
        declared = with_effects(self.system, self.constants)
        effects = [self.tracing.candidates[k].effect for k in chosen]
        return declaring(declared, effects)

    @cached_property
    def _joints(self) -> RelativeResiduals:
        """Rows of the joints' torques."""
        return RelativeResiduals(self.rows, self.make)

    def test(self, chosen: Sequence[int]) -> dict[str, RowResidual]:
        """Residuals of the model with the effects chosen, by row type, against noise."""
        self.tracing.weigh(chosen)
        return ResidualTest(self.rows).of(self.residual(chosen))

    def state(self, chosen: Sequence[int]) -> ModelFit:
        """Residuals of the model with the effects chosen."""
        rows, tracing = self.rows, self.tracing
        tracing.weigh(chosen)
        solution, without = self.solution(chosen), tracing.solutions(chosen)
        residual = tracing.residual(chosen, solution)
        effects = [tracing.candidates[k].effect for k in chosen]
        self._joints.declare([*self.constants, *effects])
        if self._held:
            holdout = self._elsewhere(effects, solution)
        else:
            predicted = tracing.predicted(chosen, without)
            holdout = Part(whitened(rows, predicted), self._joints.of(solution, self._blocks(without)))
        return ModelFit(
            system=self.adopted(chosen),
            solution=solution,
            residual=residual,
            time=rows.time,
            fit=Part(whitened(rows, residual), self._joints.of(solution)),
            holdout=holdout,
            test=ResidualTest(rows).of(residual),
        )

    def _blocks(self, solutions: Array) -> list[tuple[NDArray[np.bool_], Array]]:
        """Windows of the joints in each block, and the solution without it."""
        block = self.folds.of_others(self._joints.segment, self._joints.times)
        return [(block == k, solution) for k, solution in enumerate(solutions)]

    def _elsewhere(self, effects: Sequence[Effect], solution: Array) -> Part:
        """What the model with a solution (n + c,) leaves of the capture that is held out."""
        make = self._made_elsewhere()
        rows = make.rows
        held = CandidateRows(
            rows,
            [make.of(effect) for effect in effects],
            Folds.of(rows.weak.windows.segment, rows.time),
            fixed=[make.of(effect) for effect in self.constants],
            laws=make,
            calibrated=rows.calibrated,
        )
        everything = range(len(effects))
        held.reweight(everything, solution)
        joints = RelativeResiduals(rows, make)
        joints.declare([*self.constants, *effects])
        return Part(whitened(rows, held.residual(everything, solution)), joints.of(solution))

    def _made_elsewhere(self) -> CandidateColumns:
        """Candidates' columns, and with them the rows, of the capture that is held out."""
        own = self.rows
        rows = SessionRows(
            own.model, own.base, own.sensing, own.noise, self._held, own.beta, second_order=own.second_order
        )
        return CandidateColumns(rows, self.make.system)

    def joints_elsewhere(self) -> RelativeResiduals | None:
        """Rows of the joints' torques, in windows that overlap by half, of the capture that is held out.

        None without one, or where it is too short.
        """
        if not self._held:
            return None
        make = self._made_elsewhere()
        return RelativeResiduals(make.rows, make, gapless=True)

    def steps(self, chosen: Sequence[int]) -> list[Step]:
        """The way of the last search, with the weights of those chosen in the end."""
        self.tracing.weigh(chosen)
        out = []
        for taken, those in self.tracing.path:
            effects = [self.tracing.candidates[k] for k in those]
            self._joints.declare([*self.constants, *(candidate.effect for candidate in effects)])
            relative = self._joints.of(self.solution(those), self._blocks(self.tracing.solutions(those)))
            out.append(Step(self.tracing.candidates[taken].key, tuple(c.key for c in effects), relative))
        return out
