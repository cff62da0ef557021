"""Every effect of the catalogue at every place of a system, as columns of a session's rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import cached_property, partial
from itertools import product

import numpy as np

from sms_online.description.schema import Effect, System
from sms_online.description.tree import index_of
from sms_online.diagnosis.cached_forms import CachedForms
from sms_online.diagnosis.candidate import Candidate, Unmodelled
from sms_online.diagnosis.constants import is_constant
from sms_online.diagnosis.followed import FollowedMotion
from sms_online.diagnosis.reversals import Reversals
from sms_online.diagnosis.rows import SessionRows
from sms_online.diagnosis.standstill import LEAVING, SessionStandstill
from sms_online.diagnosis.weak_windows import SeenMotion, WeakWindows
from sms_online.effects.base import Ranges, deflection, joints_of, position
from sms_online.effects.build import build_model, declaring
from sms_online.effects.catalogue import ENTRIES, LINEAR, candidates, curve_variables, periods, places, traits_of
from sms_online.model.effect import Inputs
from sms_online.model.model import Model
from sms_online.model.parameters import Parameter
from sms_online.pipeline.momentum_windows import HOPS
from sms_online.pipeline.rough_forces import MOVING_OFF, RoughForces
from sms_online.stream import Array

# Share of its law that friction may lack just before breakaway, 1σ: the spring winds up meanwhile.
WINDING = 0.2
# Declarations of which models and noisy columns are kept: those that a search returns to.
KEPT = 100


class CandidateColumns:
    """Makes candidates for the rows of a session, of effects that the system does not declare.

    Columns of those that become constants hold the parameters behind the noise of the rows, and follow them.
    """

    def __init__(
        self, rows: SessionRows, system: System, weak: WeakWindows | None = None, since: int = 0, resting: bool = False
    ) -> None:
        """weak: windows that columns are wanted in, in place of the rows'. since: number of the first segment whose
        length separates frequencies. resting: whether dry friction has its law at a standstill too.
        """
        self.rows, self.system = rows, system
        self._since, self._resting = since, resting
        self._weak = rows.weak if weak is None else weak
        self._noisy: list[CandidateColumns] = []
        self._made: dict[tuple[object, ...], Model] = {}
        self._forms = CachedForms()
        self._held: dict[int, SessionStandstill] = {}
        self._turned: dict[int, Reversals] = {}
        self._own = {p.name for p in rows.model.parameters}

    def within(self, weak: WeakWindows, resting: bool = False) -> CandidateColumns:
        """The same for other windows of the session."""
        other = self._in(weak, resting)
        other._made = self._made
        return other

    def _in(self, weak: WeakWindows, resting: bool) -> CandidateColumns:
        return CandidateColumns(self.rows, self.system, weak, resting=resting)

    def _model(self, effect: Effect) -> Model:
        """The model with one more effect, the last one. What becomes a constant is linear only beside known masses."""
        if is_constant(effect):
            return build_model(declaring(self.system, [effect]), self.rows.base.physical_values(self.rows.beta))
        law = _law(effect)
        if law not in self._made:
            if len(self._made) == KEPT:
                del self._made[next(iter(self._made))]
            self._made[law] = build_model(declaring(self.system, [effect]))
        return self._made[law]

    def inputs(self, motion: SeenMotion) -> Inputs:
        """What the effects that the system declares need beside the motion."""
        return self._inputs(self.rows.model, motion)

    def _inputs(self, model: Model, motion: SeenMotion) -> Inputs:
        states = np.zeros((len(motion.samples), 0))
        if model.n_states:
            states = self._followed.states(model, motion.segment, motion.samples)
        return Inputs(motion.torque, states)

    @cached_property
    def _followed(self) -> FollowedMotion:
        """The motion that internal states follow: that of the windows' own samples, noise added to them included."""
        rows = self.rows
        if self._weak.segments is rows.segments:
            return rows.followed
        return FollowedMotion(rows.sensing, self._weak.segments, rows.model.system.sample_rate)

    def all(self) -> list[Candidate]:
        """Each effect at each place, with each shape constant of its grid, those that become constants first.

        The rows have to be whitened for these.
        """
        return self.seen(sorted(self.effects(), key=lambda effect: not is_constant(effect)))

    def seen(self, effects: Iterable[Effect]) -> list[Candidate]:
        """Candidates of the declarations; those that leave no trace left out."""
        made = [self.of(effect) for effect in effects]
        return [candidate for candidate in made if np.any(candidate.columns)]

    def effects(self, learned: bool = False) -> Iterator[Effect]:
        """Declarations that may be missing; kinematics are compared as whole systems, not as columns.

        learned: whether curves are among them.
        """
        for effect in candidates(self.system):
            entry = ENTRIES[effect.name]
            if entry.kind == "kinematics":
                continue
            if entry.forms is not None:
                if learned:
                    yield from entry.forms(effect, self._variables(effect))
                continue
            if entry.kind == "channel":
                yield effect.model_copy(update={"coefficients": {}})
                continue
            grids = {s: shape.grid(self.ranges(effect.where)) for s, shape in entry.shapes.items()}
            grids = {s: values for s, values in grids.items() if s in effect.coefficients}
            for values in product(*grids.values()):
                shapes = dict(zip(grids, values, strict=True))
                shaped = effect.model_copy(update={"coefficients": effect.coefficients | shapes})
                order = periods(shaped)
                if order is not None and not self._turns(effect.where, order):
                    continue
                if any(value <= 0.0 < entry.shapes[s].default for s, value in shapes.items()):
                    continue  # a joint at rest has no range to take a share of
                yield shaped

    def _variables(self, effect: Effect) -> dict[str, Array]:
        """Values (K,) that the variables of a joint's curves go through, by name."""
        layout, i = self.rows.model.layout, index_of(effect.where)
        motor = layout.theta_m[i]
        x, v = (np.concatenate([getattr(m, part) for m, _ in self.rows.weak.motions()]) for part in ("x", "v"))
        bent = deflection(layout, x, i)
        values = {"rate": v[:, motor], "angle": position(layout, x, motor), "deflection": bent, "load": bent}
        return {over: values[over] for over in curve_variables(self.system, effect)}

    def _turns(self, where: str, order: float) -> bool:
        """Whether an effect of so many periods a motor turn goes through one: less of it is a constant or a gain."""
        layout, i = self.rows.model.layout, index_of(where)
        theta_m = layout.theta_m[i] + layout.offset
        angles = np.concatenate([motion.x[:, theta_m] for motion, _ in self.rows.weak.motions()])
        return bool(order * self.system.joints[i].gear_ratio * np.ptp(angles) > 2.0 * np.pi)

    def ranges(self, where: str) -> Ranges:
        """How far the session goes at a place."""
        layout = self.rows.model.layout
        joints = joints_of(where) or range(len(layout.q))
        theta_m, q = np.array(layout.theta_m)[list(joints)], np.array(layout.q)[list(joints)]
        motions = [motion for motion, _ in self.rows.weak.motions()]
        speed = max(float(np.abs(motion.v[:, theta_m]).max()) for motion in motions)
        angles = [motion.x[:, theta_m + layout.offset] for motion in motions]
        swing = float(np.ptp(np.concatenate(angles), axis=0).max())
        pairs = zip(angles, motions, strict=True)
        largest = max(float(np.abs(angle - motion.x[:, q + layout.offset]).max()) for angle, motion in pairs)
        rate = self.system.sample_rate
        longest = max(segment.index.size for segment in self.rows.segments[self._since :])
        return Ranges(speed, swing, largest, longest / rate, rate)

    def of(self, effect: Effect) -> Candidate:
        """The candidate of one declaration."""
        if ENTRIES[effect.name].kind == "channel":
            return self._channel(effect)
        model = self._model(effect)
        added = [k for k, p in enumerate(model.parameters) if p.name not in self._own]
        parameters = [model.parameters[k] for k in added]
        if ENTRIES[effect.name].kind == "inertia":
            alone = model.of_parameters(added)

            def inertia(motion: SeenMotion) -> tuple[Array | None, Array]:
                P, G = alone.momentum_columns(motion.x, motion.v, inputs=self.inputs(motion))
                return P[..., added], G[..., added]

            return self._candidate(effect, parameters, self._weak.columns(inertia))
        return self._candidate(effect, parameters, self._force(model))

    @staticmethod
    def _candidate(effect: Effect, parameters: Sequence[Parameter], columns: Array, bend: float = np.inf) -> Candidate:
        return Candidate(effect, tuple(parameters), columns, traits_of(effect), is_constant(effect), bend)

    def _force(self, model: Model) -> Array:
        """Columns (W, n_v, c) of a model's last effect."""
        force = model.effects[-1]

        def columns(motion: SeenMotion) -> tuple[Array | None, Array]:
            inputs = self._inputs(model, motion)
            inputs = replace(inputs, states=inputs.states[:, model.state_slices[-1]])

            def along(v: Array) -> Array:
                return force.force(model.layout, motion.x, v, inputs)

            if not force.reversing:
                return None, along(motion.v)
            G = self._reversals(force.axis(model.layout)).mean(along, motion)
            if force.dry and not self._resting:
                # Stiction is no matter of the law but just before breakaway.
                held = self._standstill(force.axis(model.layout))
                still, leaving = (each(motion.segment, motion.samples) for each in (held.at, held.leaving))
                v = motion.v.copy()
                v[:, held.axis] = leaving * MOVING_OFF
                G = np.where(still[:, None, None], along(v), G)
            return None, G

        return self._weak.columns(columns, dense=not force.smooth)

    def unmodelled(self, candidate: Candidate, coefficients: Array) -> Unmodelled:
        """What the sensors' noise makes of a force with coefficients (c,), and what its law does not determine.

        Noise to first order where a joint's positions and rates give the force; that of a torque which a gain or a
        ripple takes in is left out beside the torque's own. Else by a few draws of it in every window, averaged over
        the windows that a window overlaps. What a law that jumps with a rate's sign does not give is where it jumps,
        and at a standstill any value up to that of its law: with as much of it as they hold, draws add nothing.
        """
        effect = candidate.effect
        nothing = np.zeros((len(self.rows.b), HOPS, self.rows.b.shape[1]))
        if ENTRIES[effect.name].kind != "force" or is_constant(effect) or self.rows.noise.exact:
            return Unmodelled(nothing[:, 0], nothing)
        model = self._model(effect)
        force = model.effects[-1]
        law = _law(effect)
        if joints_of(effect.where) and not force.reversing and not force.n_states:
            spread = partial(self._spread, model)
            return Unmodelled(self._forms.at(("spread", *law), spread, coefficients), nothing)
        squares = self._forms.at(("draws", *law), self._drawn(candidate), coefficients)
        near = slice(HOPS - 1, HOPS - 1 + len(squares))
        sums = [np.convolve(column, np.ones(2 * HOPS - 1))[near] for column in (np.ones(len(squares)), *squares.T)]
        own = np.stack(sums[1:], axis=1) / sums[0][:, None]
        free = nothing
        if force.reversing:
            undetermined = self._forms.at(("undetermined", *law), partial(self._undetermined, model), coefficients)
            free = self._weak.shared(np.sqrt(undetermined))
        return Unmodelled(np.maximum(own - free[:, 0], 0.0), free)

    def _drawn(self, candidate: Candidate) -> Callable[[Array], Array]:
        """Gives the mean squares (W, n_v) of what draws of noise change of a force with coefficients (c,)."""

        def squares(coefficients: Array) -> Array:
            if not self._noisy:
                self._noisy = [self.within(weak) for weak in self.rows.noisy()]
            if not changes:
                changes.extend(make.of(candidate.effect).columns - candidate.columns for make in self._noisy)
            return np.asarray(np.mean(np.square([change @ coefficients for change in changes]), axis=0))

        changes: list[Array] = []
        return squares

    def _undetermined(self, model: Model, coefficients: Array) -> Array:
        """Squares (W, INSTANTS, n_v) of what a model's last effect, a law of a rate's sign, does not determine.

        Where the sign changes, at a standstill, and by what the filter rounds off of the rate.
        """
        force = model.effects[-1]
        turned, held = self._reversals(force.axis(model.layout)), self._standstill(force.axis(model.layout))
        leaving_for = round(LEAVING * self.system.sample_rate)

        def squares(motion: SeenMotion) -> Array:
            inputs = self._inputs(model, motion)

            def along(v: Array) -> Array:
                return force.force(model.layout, motion.x, v, inputs) @ coefficients

            jumps = turned.squares(along, motion)
            if not force.dry:
                return jumps
            v = motion.v.copy()
            v[:, held.axis] = MOVING_OFF
            still, leaving = (each(motion.segment, motion.samples)[:, None] for each in (held.at, held.leaving))
            times = np.where(leaving != 0.0, leaving_for * WINDING**2, self._weak.effective_samples)
            return np.where(still, times * along(v) ** 2, jumps)

        return self._weak.squares(squares)

    def _spread(self, model: Model, coefficients: Array) -> Array:
        """Variance (W, n_v) of the rows for a model's last effect, of a joint, to first order in encoders' noise."""
        rough, noise, sensing = RoughForces(model), self.rows.noise, self.rows.sensing
        columns = model.effect_slices[-1]
        own = (rough.coefficients >= columns.start) & (rough.coefficients < columns.stop)
        factor = coefficients[rough.coefficients[own] - columns.start]
        to_row = np.eye(model.layout.n_v)[rough.rows[own]]

        def slopes(motion: SeenMotion) -> tuple[Array, Array]:
            inputs = self._inputs(model, motion)
            signals = np.concatenate((inputs.torque, inputs.states), axis=1)
            both = rough.slopes(motion.x, motion.v, signals, np.zeros_like(motion.v))
            by_position, by_rate = np.split(both, 2, axis=1)
            # A reading of the motor moves the joint too where that is read as an angle beyond it.
            along = sensing.displacements(motion.x[:1])[0][rough.coordinates[own]] * noise.grid[: motion.x.shape[1]]
            sensors = np.flatnonzero(np.any(along, axis=0))
            by_value, by_change = (
                np.stack([(part[:, own] * factor * along[:, sensor]) @ to_row for sensor in sensors])
                for part in (by_position, by_rate)
            )
            return by_value, by_change * self.system.sample_rate

        return self._weak.spread(slopes)

    def reported(self, effect: Effect, beta: Array, coefficients: Array) -> dict[str, float]:
        """A force's coefficients as a person reads them, for parameters β (n,) and its own coefficients (c,).

        Empty where β does not hold what they are relative to, or none of it is determined.
        """
        force = self._model(effect).effects[-1]
        known = dict(zip((p.name for p in self.rows.base.parameters), beta.tolist(), strict=True))
        if not all(known.get(name) for name in force.relative_to):
            return {}
        return force.reported(np.append(coefficients, [known[name] for name in force.relative_to]))

    def at_rest(self, candidate: Candidate) -> float:
        """Share of the session in which the axis of a law of dry friction is at rest."""
        model = self._model(candidate.effect)
        return self._standstill(model.effects[-1].axis(model.layout)).share

    def _standstill(self, axis: int) -> SessionStandstill:
        """Standstill of an axis, by the number of its speed."""
        if axis not in self._held:
            rows, rate = self.rows, self.system.sample_rate
            self._held[axis] = SessionStandstill(rows.sensing, rows.segments, axis, self._noise_of(axis), rate)
        return self._held[axis]

    def _reversals(self, axis: int) -> Reversals:
        """Reversals of an axis, in the windows' own samples."""
        if axis not in self._turned:
            parts = self._noise_of(axis), self.system.sample_rate, self._standstill(axis)
            self._turned[axis] = Reversals(self.rows.sensing, self._weak.segments, *parts)
        return self._turned[axis]

    def _noise_of(self, axis: int) -> float:
        """σ of the position of an axis, rad."""
        return float(position(self.rows.model.layout, self.rows.noise.coordinates[None], axis)[0])

    def _torque_rate(self, where: str) -> Array:
        """∫ φ d(n τ)/dt dt of the joints that `where` matches, in their motors' rows (W, n_v), by way of dφ/dt."""
        joints = [index_of(joint) for joint in places(self.system, "driven joint") if fnmatchcase(joint, where)]
        motors = [self.rows.model.layout.theta_m[i] for i in joints]

        def columns(motion: SeenMotion) -> tuple[Array, Array]:
            P = np.zeros((*motion.v.shape, 1))
            P[:, motors, 0] = motion.torque[:, joints]
            return P, np.zeros_like(P)

        return self._weak.columns(columns, dense=True)[..., 0]

    def _channel(self, effect: Effect) -> Candidate:
        """What is added to readings, times the rows' response to it; other windows than the rows' give torques alone.

        An effect y = x + c d(x) on a reading y is taken off by y - c d, so rows of readings lack -c times the response.
        """
        layout = self.rows.model.layout
        columns, parameters = [], []
        for quantity, unit, displacement, sign in LINEAR[effect.name]:
            names = [self.rows.sensing.channels[k] for k in self.rows.sensing.position_columns]
            acts = [k for k, name in enumerate(names) if fnmatchcase(name, effect.where)]
            response = np.zeros((self._weak.count, layout.n_v))
            if displacement == "torque rate":
                response = sign * self._torque_rate(effect.where)
            elif self._weak is self.rows.weak:
                response = sign * self.rows.responses[displacement][:, :, acts].sum(axis=2)
            columns.append(response)
            parameters.append(Parameter(f"{effect.key}.{quantity}", quantity, unit, 0.0))
        # An angle turns the arm by as much; a delay counts beside the time in which rows see the motion change.
        span = self._weak.windows.width / self.system.sample_rate
        late = any(each.unit == "s" for each in LINEAR[effect.name])
        return self._candidate(effect, parameters, np.stack(columns, axis=2), 2.0 * np.pi / span if late else 1.0)


def _law(effect: Effect) -> tuple[object, ...]:
    """What the columns of an effect depend on."""
    return effect.name, effect.where, *sorted(effect.coefficients.items()), effect.over, effect.knots
