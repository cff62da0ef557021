"""What the statistics of a session say: estimate, error bars, residuals, trust, each when it is asked for.

A pure function of `Statistics`, so that the estimator's process, the view's and a reader of saved statistics say the
same. `result_of` makes one record of all of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sms_online.calibration.found import CERTAIN, Calibration, found
from sms_online.calibration.nuisance import BOUND
from sms_online.effects.catalogue import either, in_words
from sms_online.judgement import STATE_HOLD, Discrepancy, Dispute, Facts, judge, undecided
from sms_online.model.parameters import Parameter
from sms_online.nominal import Comparison, compare, unit_factors
from sms_online.physical import PhysicalSet, Projection
from sms_online.pipeline.description import described, nearer
from sms_online.pipeline.latency import source_channels
from sms_online.pipeline.periods import LONGEST_HOLE
from sms_online.pipeline.sensing import is_slow
from sms_online.pipeline.statistics import Statistics
from sms_online.pipeline.synchronise import SIDE
from sms_online.pipeline.tracker_bank import Reading, rows_per_second
from sms_online.row_types import ENERGY, joint_rows, row_types
from sms_online.stream import Array
from sms_online.threads import one_blas_thread
from sms_online.tracker_results import Consistency, Drift, Tracked, TrackerResult
from sms_online.trackers.interface import Estimate
from sms_online.trust import Reason, Residual, Trust

# Half width of a 95 % interval in standard deviations.
NORMAL_95 = 1.959963984540054
# An estimate within three standard deviations of zero is not determined by the data: not even its sign is certain.
LARGEST_RELATIVE_STD = 1.0 / 3.0
# Mean square of rows over their predicted variance that noise alone may leave: that of the noise is estimated to 7 %.
LARGEST_ROW_VARIANCE = 1.2
# Rows of the energy balance, for each parameter, from which on its first transient is forgotten.
ROWS_A_PARAMETER = 10
# Noise in the columns matters where it pulls an estimate by more than this many standard deviations.
LARGEST_PULL = 1.0
# An estimate further from its prior than this many of the prior's deviations agrees with it by no chance.
LARGEST_DISPUTE = 3.0
# A clock this many tolerances off may have moved on the way.
MOVED = 1.5
# Clocks are alike within this share of what they are off by.
ALIKE = 0.05
# Quantities that cannot be negative, as the ends of names.
POSITIVE = ("mass", "mass_per_length", "stiffness", "damping", "rotor_inertia", "rigidity", "rigidity_y", "rigidity_z")
# Effects of one cause that a warning names.
NAMED = 4


def identifiable(beta: Array, std: Array) -> NDArray[np.bool_]:
    """Which parameters β (n,) the data determine: std (n,) is finite, and β three of it from zero."""
    return np.asarray(std <= LARGEST_RELATIVE_STD * np.abs(beta))


class Evaluation:
    """The statistics of an instant, evaluated.

    estimate: the one that follows from them, where it is at hand: to make it costs milliseconds. discrepancies: of the
    running diagnosis. troubles: whatever else speaks against the numbers, see `judgement.Facts`.
    """

    def __init__(
        self,
        statistics: Statistics,
        estimate: Estimate | None = None,
        discrepancies: Sequence[Discrepancy] = (),
        troubles: Sequence[str] = (),
    ) -> None:
        self.statistics = statistics
        self.model, self.base = statistics.setup.model, statistics.setup.base
        self._estimate = estimate
        self._discrepancies, self._troubles = tuple(discrepancies), tuple(troubles)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """What is estimated, (n,)."""
        return self.base.parameters

    @cached_property
    def estimate(self) -> Estimate:
        """The base parameters as the rows determine them."""
        return self.statistics.estimate() if self._estimate is None else self._estimate

    @cached_property
    @one_blas_thread()
    def std(self) -> Array:
        """1σ of each parameter (n,) as it is reported, inf where the data determine nothing.

        The smoother's covariance follows from the noise of sensors and torques, and of forces where it had to allow
        some. Rows of the momentum balance have a predicted variance. While the residual agrees with it, the estimate's
        covariance follows from it; where rows leave more, the model lacks something and the residual decides, as it
        does for rows of the energy balance.
        From the residual: the larger of two answers. One takes the rows' errors as independent with the residual's
        variance, the other allows errors that last within clusters of rows. To it comes what errors add that rows of an
        energy window share, which least squares absorbs and no residual shows; it is known while no row is forgotten.
        Where rows have been weighed against a prior, the posterior's own covariance holds.
        """
        return self._reported(self.estimate)

    def _reported(self, estimate: Estimate) -> Array:
        """See `std`; of any tracker's estimate."""
        now = self.statistics
        std = np.full(estimate.pi.shape, np.inf)
        if estimate.dof <= 0.0:
            return std
        known = estimate.determined
        if estimate.scale is not None or now.method == "smoother":
            std[known] = estimate.std[known]
            return std
        row_variance = estimate.rss / estimate.dof
        misfit = now.momentum is not None and now.momentum.rows.misfit.any()
        if now.method == "momentum" and row_variance <= LARGEST_ROW_VARIANCE and not misfit:
            std[known] = estimate.std[known]
            return std
        variance = np.diag(estimate.covariance)[known] * row_variance
        if estimate.covariance_robust is not None:
            variance = np.maximum(variance, np.diag(estimate.covariance_robust)[known])
        if now.method == "energy" and estimate.rows == now.shared.rows:
            inverse = np.where(np.outer(known, known), estimate.covariance, 0.0)
            variance = variance + now.shared.variance(inverse, row_variance)[known]
        std[known] = np.sqrt(variance)
        return std

    @cached_property
    def determined(self) -> NDArray[np.bool_]:
        """Which parameters the data determine (n,), see `identifiable`."""
        return identifiable(self.estimate.pi, self.std)

    @cached_property
    @one_blas_thread()
    def residuals(self) -> dict[str, Residual]:
        """By type of the rows."""
        now, joint = self.statistics, self._joint
        beta = joint[len(now.setup.nuisances) :]
        relative = {joint_rows(i): joint.relative(beta) for i, joint in enumerate(now.joints)}
        out = {ENERGY: Residual(None, None)}
        # Where the smoother knows better, rows of the balance see shapes that are not the links'.
        momentum = None if now.method == "smoother" else now.momentum
        for name, speeds in row_types(self.model.layout).items():
            whitened = None if momentum is None else momentum.rows.whitened(speeds, joint)
            out[name] = Residual(relative.get(name), whitened)
        return out

    @property
    def _joint(self) -> Array:
        """Nuisances and parameters that residuals are for; zeros for the nuisances where another balance gives it.

        Where parameters have moved, sums of rows are free of that, and so are these.
        """
        momentum = self.statistics.momentum
        if self.statistics.method == "momentum" and momentum is not None and momentum.reference is not None:
            return momentum.reference
        # An attenuated estimate of what rows hardly determine would leave its signal in the residual.
        found, m = nearer(self.estimate, *described(self.model, self.base)), len(self.statistics.setup.nuisances)
        return found if found.size == m + self.base.n else np.concatenate((np.zeros(m), found))

    @cached_property
    @one_blas_thread()
    def estimates(self) -> tuple[tuple[Estimate, Array], ...]:
        """Of each chosen tracker, the judged one first, its estimate and 1σ (n,) as it is reported, see `std`.

        The judged one alone where no momentum balance gives the estimate.
        """
        momentum = self.statistics.momentum
        others = () if self.statistics.method != "momentum" or momentum is None else momentum.trackers[1:]
        return ((self.estimate, self.std), *((each.estimate, self._reported(each.estimate)) for each in others))

    @cached_property
    @one_blas_thread()
    def trackers(self) -> tuple[TrackerResult, ...]:
        """What each chosen tracker says, the judged one first; empty where no momentum balance gives the estimate."""
        now = self.statistics
        if now.method != "momentum" or now.momentum is None:
            return ()
        readings = now.momentum.trackers
        if not readings:
            rate = rows_per_second(self.model.layout.n_v, self.model.system.windows.momentum)
            readings = (Reading(now.setup.system.trackers[0].label, self.estimate, self.estimate.rows / rate),)
        out = []
        for k, (reading, (estimate, std)) in enumerate(zip(readings, self.estimates, strict=True)):
            numbers = (estimate.pi.tolist(), std.tolist(), identifiable(estimate.pi, std).tolist())
            tracked = {p.name: Tracked(*each) for p, *each in zip(self.parameters, *numbers, strict=True)}
            consistency = Consistency.of(estimate)
            moving = [(self.parameters[drift.column], drift, drift.column) for drift in reading.drifts]
            drifts = tuple(
                Drift(
                    p.name, p.unit, drift.since, drift.rate, drift.std, float(estimate.pi[column]), float(std[column])
                )
                for p, drift, column in moving
            )
            memory = min(reading.memory, now.duration)
            out.append(TrackerResult(reading.label, k == 0, tracked, consistency, memory, drifts))
        return tuple(out)

    @cached_property
    def calibration(self) -> list[Calibration]:
        """What the session tells of its calibration better than the description's tolerances."""
        estimate, nuisances = self.estimate, self.statistics.setup.nuisances
        if estimate.nuisances.size != len(nuisances) or estimate.dof <= 0.0:
            return []
        return found(nuisances, estimate, max(1.0, float(np.sqrt(estimate.rss / estimate.dof))))

    @cached_property
    @one_blas_thread()
    def pulled(self) -> list[str]:
        """Names of parameters that noise in the columns pulls by more than their std: errors in variables.

        The comparison is Hausman's, of least squares with an estimate that is free of this bias.
        """
        if self.statistics.method != "momentum":
            return []
        shift = np.abs(self.statistics.shift(self.estimate))
        return [p.name for p, s, d in zip(self.parameters, shift, self.std, strict=True) if s > LARGEST_PULL * d]

    @cached_property
    @one_blas_thread()
    def projection(self) -> Projection | None:
        """The parameters of real bodies that are nearest to the estimate; None where they are not found.

        A finished session is not lost for it. It takes too long to be made of a session that runs, and is None then.
        """
        if not self.statistics.finished:
            return None
        std, estimate = self.std, self.estimate
        known = np.flatnonzero(np.isfinite(std))
        stated = estimate.std[known]
        scale = np.divide(std[known], stated, out=np.ones_like(stated), where=stated > 0.0)
        covariance = np.diag(np.full(std.size, np.inf))
        covariance[np.ix_(known, known)] = estimate.covariance[np.ix_(known, known)] * np.outer(scale, scale)
        try:
            return PhysicalSet(self.model, self.base).project(estimate.pi, covariance)
        except ArithmeticError:
            return None

    @cached_property
    def comparison(self) -> Comparison:
        """The determined parameters against the values that the system file states; those of effects count as none."""
        known = np.flatnonzero(self.determined)
        names = [self.parameters[k].name for k in known]
        nominal = {p.name: p.nominal for p in self.parameters if "@" not in p.name}
        return compare(names, self.estimate.pi[known], self.std[known], nominal, unit_factors(self.model.system))

    @cached_property
    def trust(self) -> Trust:
        """May the estimate be trusted? The answer changes while a session runs."""
        now, estimate, flags = self.statistics, self.estimate, self.determined
        names = [p.name for p in self.parameters]
        below = flags & (estimate.pi + NORMAL_95 * np.where(flags, self.std, 0.0) < 0.0)
        momentum, projection = now.momentum, self.projection
        return judge(
            Facts(
                determined=(int(np.count_nonzero(flags)), flags.size),
                undetermined=tuple(name for name, known in zip(names, flags, strict=True) if not known),
                settling=self._settling(),
                silent=self._silent(),
                residual=self.residuals,
                negative=tuple(
                    name for name, negative in zip(names, below, strict=True) if negative and name.endswith(POSITIVE)
                ),
                pulled=tuple(self.pulled),
                alarm=None if momentum is None else momentum.alarm,
                disputed=tuple(self._disputes()),
                undecided=tuple(event.time for event in now.events if event.kind == "undecided"),
                distance=0.0 if projection is None else projection.distance,
                comparison=self.comparison,
                lost=self._lost,
                slow=self._slow,
                outliers={channel: left.number / left.of for channel, left in now.outliers.items()},
                discrepancies=self._discrepancies,
                coloured={} if momentum is None else momentum.coloured,
                miscalibrated=(*self._miscalibrated(), *self._undecided()),
                troubles=tuple(self._troubles),
                weaknesses=tuple(self._weaknesses()),
                suspected=None if momentum is None or now.method != "momentum" else momentum.suspected,
                unwatched=now.duration if self._unwatched else 0.0,
                consistency=self.trackers[0].consistency if self.trackers else None,
                scale=now.setup.system.scale_tolerance,
            )
        )

    @property
    def _unwatched(self) -> bool:
        """Whether a drift would show nowhere."""
        now = self.statistics
        return now.method == "momentum" and now.momentum is not None and now.momentum.unwatched

    @property
    def _lost(self) -> float:
        """Share of the grid's points that were lost; not what interpolation between slow samples needs at the ends."""
        now = self.statistics
        if now.method == "smoother" and now.smoother is not None:
            # Of its samples those are lost that have no torque.
            return now.smoother.lost / max(1, now.smoother.lost + now.samples)
        ends = 2.0 * SIDE * float(np.nanmax(now.periods, initial=0.0)) * now.setup.system.sample_rate
        lost = max(0.0, now.counters.lost_samples - ends)
        return lost / max(1.0, lost + now.samples)

    @property
    def _slow(self) -> dict[str, float]:
        """Sample rates, Hz, of position channels that are too slow for the momentum balance's windows."""
        now = self.statistics
        if now.method == "smoother" or now.setup.system.balance == "energy":
            return {}
        sensing, window = now.setup.sensing, now.setup.system.windows.momentum
        each = {sensing.channels[k]: now.periods[k] for k in sensing.position_columns}
        return {name: 1.0 / period for name, period in each.items() if is_slow(float(period), window)}

    def _miscalibrated(self) -> list[Reason]:
        """Where the description is wrong by more than its tolerances allow; corrections are linear, up to a bound.

        A clock that moves on the way looks like a change of parameters: beside one, less counts.
        """
        changed = any(event.parameters for event in self.statistics.events)
        held = self._held
        return held + [
            Reason(
                f"{each}: {abs(each.estimate / each.tolerance):.0f} tolerances",
                abs(each.estimate) > BOUND * each.tolerance,
                full=f"{each}: {each.advice}",
                then=each.advice,
            )
            for each in self.calibration
            if each.tolerance is not None
            and not (held and each.name == "clock")
            and (each.beyond or (changed and each.name == "clock" and abs(each.estimate) > MOVED * each.tolerance))
        ]

    @property
    def _held(self) -> list[Reason]:
        """That torques act half a sample later than they are stamped, which commands do that are held."""
        setup = self.statistics.setup
        half = 0.5 * float(np.nanmax(self.statistics.periods[list(setup.sensing.torque_columns)], initial=0.0))
        clocks = [each for each in self.calibration if each.name == "clock"]
        count = sum(each.name == "clock" for each in setup.nuisances)
        alike = all(abs(each.estimate - half) < max(CERTAIN * each.std, ALIKE * half) for each in clocks)
        if not count or len(clocks) < count or not alike or not all(each.beyond for each in clocks):
            return []
        text = f"the torques act {1e3 * half:.2g} ms after their stamps: commands that are held over the sample"
        return [Reason(text, False, then=STATE_HOLD)]

    def _undecided(self) -> list[Reason]:
        """Effects of the description, larger than their tolerance, that may as well be the other way elsewhere."""
        model, names = self.model, [p.name for p in self.parameters]
        scale, out = model.system.scale_tolerance, []
        for effect in model.system.effects:
            other = either(effect, model.system)
            key = f"{effect.name}@{effect.where}."
            values = {n.removeprefix(key): float(self.estimate.pi[k]) for k, n in enumerate(names) if n.startswith(key)}
            if other and scale is not None and any(abs(value) > scale for value in values.values()):
                out.append(undecided(in_words(effect, model.system, values), effect.where, other))
        return out

    def _disputes(self) -> list[Dispute]:
        """Parameters that the data pull further from what was known of them beforehand than that allows."""
        now, prior = self.statistics, self.statistics.setup.current_prior
        if prior is None:
            return []
        off = np.zeros(prior.std.size)
        off[prior.known] = ((self.estimate.pi - prior.value) / prior.std)[prior.known]
        far = np.flatnonzero(np.abs(off) > LARGEST_DISPUTE)
        scale_free = None if now.method != "momentum" or now.momentum is None else now.momentum.scale_free
        slopes = (
            None if scale_free is None or not far.size else scale_free.minimum().slopes[:, len(now.setup.nuisances) :]
        )
        out = []
        for k in far.tolist():
            row = None
            if slopes is not None:
                # The criterion falls on the way from the prior to where rows want the parameter.
                types = row_types(self.model.layout)
                pulls = {name: -np.sign(off[k]) * slopes[rows, k].sum() for name, rows in types.items()}
                row = max(pulls, key=lambda name: float(pulls[name]))
            out.append(Dispute(self.parameters[k].name, float(off[k]), row))
        return out

    def _silent(self) -> dict[str, float]:
        """Since when, s, sources have been silent; channels where not all of a source is, or none is described."""
        last = self.statistics.last_time
        silent = {
            name: time
            for name, time in zip(self.statistics.setup.sensing.channels, last.tolist(), strict=True)
            if np.isneginf(time) or last.max() - time > LONGEST_HOLE
        }
        names: dict[str, float] = {}
        for source in self.statistics.setup.system.sources:
            used = [name for name in source_channels(source) if name in self.statistics.setup.sensing.channels]
            if used and all(name in silent for name in used):
                names[source.name] = max(silent.pop(name) for name in used)
        return names | silent

    def _settling(self) -> str:
        """Why the estimate will still move by more than its error bars."""
        now, estimate = self.statistics, self.estimate
        if not self.determined.any():
            return f"no parameter is determined by the motion of {now.duration:.3g} s"
        smoother, momentum = now.smoother, now.momentum
        if smoother is not None and smoother.spans == 0 and not smoother.failures:
            return "the smoother has not worked off its first span"
        if now.method == "smoother":
            return ""
        if momentum is None:
            few = estimate.dof < ROWS_A_PARAMETER * estimate.pi.size
            return "the energy balance has few rows yet" if few else ""
        if not momentum.started:
            return f"the first fit has no weights after the motion of {now.duration:.3g} s"
        if momentum.tested or (now.events and now.events[-1].kind == "undecided"):
            return ""
        after = f" since the change at {now.events[-1].time:.1f} s" if now.events else ""
        return f"the test for more than noise has seen too few rows{after}"

    def _weaknesses(self) -> list[str]:
        """What weakens an estimate by the way it is made."""
        out = []
        now, missing = self.statistics, self.statistics.setup.sensing.missing
        by_smoother = now.method == "smoother"
        if now.smoother is not None and now.smoother.level > 0.0 and by_smoother:
            out.append("samples do not agree with the equations of motion")
        if by_smoother and any(value != 0.0 for value in now.setup.system.tolerances.model_dump().values()):
            out.append("error bars by the smoother count no tolerances of geometry and calibration")
        if now.momentum is None and not by_smoother:
            out.append("by the energy balance alone, nothing tests whether the model lacks something")
        if now.smoother is not None and not by_smoother and missing:
            out.append("links are taken as bent statically: estimates are off by percents")
        late = None if now.momentum is None else now.momentum.latency
        if late is not None:
            whose = late.source if late.size > 0.0 else f"all sources but {late.source}"
            out.append(f"{whose}: {1e3 * abs(late.size):.2g} ms later than stated")
        return out

    @cached_property
    def warnings(self) -> list[str]:
        """What the trust rests on or lacks, in full sentences."""
        return [*self.trust.warnings, *self._projection_warning(), *self._smoother_warnings()]

    def _smoother_warnings(self) -> list[str]:
        """What the smoother replaced, and where it failed."""
        now, setup = self.statistics, self.statistics.setup
        smoother = now.smoother
        if smoother is None:
            asked = setup.system.balance == "smoother"
            return ["no smoother: it does not know of the effects on channels that are declared"] if asked else []
        out = [f"the smoother left out {failure}" for failure in smoother.failures]
        missing = ", ".join(setup.sensing.missing)
        if now.method == "smoother":
            if missing:
                out.append(f"not measured, but estimated by the equations of motion: {missing}")
            if smoother.level > 0.0:
                share = f"{100.0 * smoother.level:.2g} % of the usual ones"
                out.append(
                    f"samples do not agree with the equations of motion: unknown forces of {share} are allowed for"
                )
        elif missing:
            out.append(
                f"links are taken as bent statically, for {missing} are not measured: estimates are off by percents"
            )
        return out

    def _projection_warning(self) -> list[str]:
        projection = self.projection
        if not self.statistics.finished:
            return []
        if projection is None:
            return ["physical consistency is not known: the search for consistent parameters did not converge"]
        if projection.distance == 0.0:
            return []
        distance, names = f"{projection.distance:.2g} standard deviations", ", ".join(projection.active)
        return [f"the estimate violates physical consistency, because of {names}, by {distance}"]

    @cached_property
    def notices(self) -> list[str]:
        """What happened to the samples, a sentence each."""
        now, system = self.statistics, self.statistics.setup.system
        out = []
        if now.dropped_rows:
            out.append(f"{now.dropped_rows} rows of the balance dropped: a value in them is beyond all numbers")
        period = 1.0 / system.sample_rate
        fastest = float(np.nanmin(now.periods, initial=np.inf))
        if np.isfinite(fastest) and not 0.8 < fastest / period < 1.25:
            out.append(f"the capture has {1.0 / fastest:.4g} samples/s, the system file says {system.sample_rate:g}")
        late = [name for sensor in system.sensors if sensor.delay(system.sample_rate) for name in sensor.channels]
        if late and now.method == "smoother":
            out.append(f"latency of {', '.join(late)} is described but not corrected by the smoother")
        if now.counters.gaps:
            out.append(f"{now.counters.gaps} gaps too long to bridge; each begins a new window of the balance")
        if now.counters.interpolated_cells:
            out.append(f"{now.counters.interpolated_cells} cells interpolated")
        coloured = {} if now.momentum is None else now.momentum.coloured
        out += [f"{channel}: noise is correlated over {1e3 * time:.2g} ms" for channel, time in coloured.items()]
        out += [f"{channel}: {left.number} outliers left out" for channel, left in now.outliers.items()]
        out += [
            f"{s.first} and {s.second} swapped from {s.begin:.3f} to {s.end:.3f} s: {s.samples} samples relabelled"
            for s in now.swaps
        ]
        out += self.unstated_latency
        if now.setup.unused:
            out.append(f"channels not used: {', '.join(now.setup.unused)}")
        return out

    @property
    def unstated_latency(self) -> list[str]:
        """That a source is late against the others by more than the system file says, if one is."""
        found = None if self.statistics.momentum is None else self.statistics.momentum.latency
        if found is None:
            return []
        late = f"{1e3 * abs(found.size):.3g} ± {1e3 * found.std:.2g} ms"
        if found.size < 0.0:
            return [f"all sources but {found.source}: {late} later than their stated latencies"]
        more = [f"{len(found.effects) - NAMED} more"] if len(found.effects) > NAMED else []
        effects = ", ".join([*found.effects[:NAMED], *more])
        return [f"{found.source}: {late} later than its stated latency ({effects})"]
