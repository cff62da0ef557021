"""Validation: what known parameters leave of the torques of a run that they were not estimated from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from sms_online.calibration.columns import nuisances
from sms_online.calibration.found import Calibration, held
from sms_online.capture import check_channels
from sms_online.cramer_rao import MotionRecord
from sms_online.data import Data, recorded_session
from sms_online.description.channels import channels as known_channels
from sms_online.description.schema import System
from sms_online.effects.catalogue import declares
from sms_online.errors import InputError
from sms_online.evaluation import negative
from sms_online.fixed_residual import FixedResidual
from sms_online.linearised import Motion
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.physical import PhysicalSet
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.torque_gains import gain_columns
from sms_online.predicted import NEGLIGIBLE, Predicted, PredictedTorque
from sms_online.result import Parameter, Parameters, Result
from sms_online.stream import Array
from sms_online.tables import Tabled
from sms_online.torque_prediction import TorqueCourse, TorquePrediction
from sms_online.verdict.reasons import (
    DESCRIBE,
    DIAGNOSE,
    LARGEST_DISTANCE,
    MOVE,
    NOISE_RESIDUAL,
    listed,
)

SCHEMA = "sms-online/validation/1"
AS_WELL = "The parameters predict this run as well as those fitted to it"
# Share of a run in which a joint is at rest that is worth a word.
RESTING = 0.01
# What validation says of parameters: they hold; a torque is mostly noise, and contradicts nothing; they do as well as a
# fit to the run, which leaves a large share of a torque unexplained; they hold but for the zero of a torque; they
# differ from those of the run; nothing has them.
Verdict = Literal["hold", "weak", "unexplained", "shifted", "differ", "impossible"]


@dataclass(frozen=True, repr=False)
class Validation(Tabled):
    """A run whose torques were predicted with fixed parameters.

    system: with which description. duration: of the run, s. joints: `joint_i` to what is left of its torque; those
    without a torque are left out. impossible: why nothing has the parameters, a clause each. diagnosed: whether the
    system is what a diagnosis has found. warnings: of the source, and of a motion beyond what effects are known for.
    deflections: of springs, `joint_i`, and flexible links, `link_i`: what is left of their elastic forces, with these
    alone fitted for comparison. Empty where shapes are not measured or sensors are too slow; where a stiffness is no
    parameter it is left out. courses: of the joints' torques. gravity: whether the load of the arm is felt at rest.
    """

    system: str
    duration: float
    joints: Mapping[str, PredictedTorque]
    impossible: tuple[str, ...] = ()
    diagnosed: bool = False
    warnings: tuple[str, ...] = ()
    deflections: Mapping[str, Predicted] = field(default_factory=dict)
    courses: Mapping[str, TorqueCourse] = field(default_factory=dict)
    gravity: bool = False

    LEFT = 1

    @property
    def verdict(self) -> Verdict:
        """What is said of the parameters; the first that applies, from the worst on."""
        every = self._every().values()
        if self.impossible:
            return "impossible"
        if any(not (each.holds or each.shifted) for each in every):
            return "differ"
        if any(each.shifted for each in every):
            return "shifted"
        if any(each.unexplained for each in every):
            return "unexplained"
        return "weak" if any(each.weak for each in self.joints.values()) else "hold"

    @property
    def holds(self) -> bool:
        """Whether the parameters hold on this run too, at every joint and link, and explain it."""
        return self.verdict == "hold"

    @property
    def sentence(self) -> str:
        """The verdict, what it is worst for, and the next step, in a sentence."""
        verdict = self.verdict
        if verdict == "impossible":
            then = (
                "see what their diagnosis left unexplained" if self.diagnosed else "diagnose the run that they are from"
            )
            return f"The parameters cannot be, whatever they leave of this run: {'; '.join(self.impossible)}; {then}."
        every = self._every().items()
        if verdict == "differ":
            name, worst = max((each for each in every if not each[1].holds), key=lambda item: item[1].ratio)
            left = f"{100.0 * worst.left:.2g} % of the {name} is left"
            ratio = f"{worst.ratio:.3g} times the residual of parameters fitted to it"
            beside = "" if worst.rows is None else f" and {worst.rows.whitened:.3g} times its noise"
            return f"The parameters do not hold on this run: {left}, {ratio}{beside}."
        if verdict == "shifted":
            return self._shifted()
        if verdict == "unexplained":
            name, worst = max((each for each in every if each[1].unexplained), key=lambda item: item[1].left)
            left = f"{100.0 * worst.left:.2g} % of the {name} is unexplained in both"
            return f"{AS_WELL}, but {left}: {DESCRIBE if self.diagnosed else DIAGNOSE}."
        joint, torque = max(self.joints.items(), key=lambda item: item[1].left)
        if verdict == "weak":
            noise = f"{100.0 * min(1.0, torque.left):.2g} % of the torque of {joint} is noise"
            return f"The parameters leave no more than noise, but {noise}: {MOVE}."
        noisy = torque.left > NEGLIGIBLE and torque.rows is not None and not torque.rows.beyond
        left = f"at most {100.0 * torque.left:.2g} % of a torque is left ({joint})"
        return f"The parameters hold for the torques of this run: {left}{', no more than noise' if noisy else ''}."

    def _every(self) -> dict[str, Predicted]:
        """All that was predicted, by what it is."""
        torques = {f"torque of {name}": each for name, each in self.joints.items()}
        return torques | {f"elastic force of {name}": each for name, each in self.deflections.items()}

    def _shifted(self) -> str:
        shifted = sorted(self.joints.items(), key=lambda item: -item[1].zero_share)
        shifted = [each for each in shifted if each[1].shifted]
        zeros = listed([f"{each.channel} by {each.zero:+.2g} {each.unit}" for _, each in shifted])
        lengths = {name: "m" if each.unit == "N" else "rad" for name, each in shifted}
        turned = [f"{name} by {each.turned:+.2g} {lengths[name]}" for name, each in shifted if each.turned]
        either = f", or of the encoders beside the spring of {listed(turned)}" if turned else ""
        name, worst = shifted[0]
        explained = all(each.beside_zero <= NOISE_RESIDUAL for each in self.joints.values())
        as_well = "The parameters hold on this run" if explained else AS_WELL
        left = f"{100.0 * worst.zero_share:.2g} % of the torque of {name}, beside which {100.0 * worst.beside_zero:.2g}"
        load = ", unless the arm carries another load" if self.gravity else ""
        return (
            f"{as_well} but for the zeros of torques: {zeros}{either}: {left} % is left. "
            f"Zero the sensors before each run, or fit {declares('drive_offset')} to each{load}."
        )

    def document(self) -> dict[str, Any]:
        """validation.json as plain dictionaries and numbers."""
        return {
            "schema": SCHEMA,
            "system": self.system,
            "duration_s": self.duration,
            "verdict": self.verdict,
            "holds": self.holds,
            "sentence": self.sentence,
            "impossible": list(self.impossible),
            "joints": {name: each.document() for name, each in self.joints.items()},
            "deflections": {name: each.document() for name, each in self.deflections.items()},
            "warnings": list(self.warnings),
        }

    def rows(self) -> tuple[list[str], list[list[str]]]:
        """Headings and cells of a table."""
        cells = [_cells(name, e, e.left, e.beside_zero, e.least) for name, e in self.joints.items()]
        left = ["share of torque left", "beside its zero", "fitted to this run"]
        return ["joint", *left, "ratio", "times noise"], cells

    def deflection_rows(self) -> tuple[list[str], list[list[str]]]:
        """Headings and cells of a table of springs and flexible links."""
        cells = [_cells(name, e, e.left, e.least) for name, e in self.deflections.items()]
        return ["deflection", "share of elastic force left", "fitted to this run", "ratio", "times noise"], cells


def _cells(name: str, each: Predicted, *shares: float) -> list[str]:
    noise = "" if each.rows is None else f"{each.rows.whitened:.3g}"
    return [name, *(f"{share:.3g}" for share in shares), f"{each.ratio:.2f}", noise]


def validate(
    system: System,
    data: Data,
    parameters: Result | Parameters | Mapping[str, float] | None = None,
    calibration: Sequence[Calibration] | None = None,
) -> Validation:
    """Predict the torques of recorded data with fixed parameters, and measure the error.

    data: as for `estimate`. parameters: values by name, or those of a `Result`; the nominal ones of the system file
    unless given. Values without a deviation count as exact. calibration: what the description is off by, gains and
    zeros of torques among it; what a `Result` has found unless given. Nothing is estimated from the data but for
    comparison.
    Raises InputError where the data do not fit the system, a parameter is missing, or there is no torque to predict.
    """
    if isinstance(parameters, Result):
        calibration = parameters.calibration if calibration is None else calibration
        parameters = parameters.parameters
    recorded = recorded_session(system, data)
    check_channels(tuple(recorded.source.channels), known_channels(system), recorded.name)
    # The rows of the joints' torques depend on no estimate; without a momentum balance no event changes the model.
    session = Estimator(system.model_copy(update={"balance": "energy"}), recorded.source.channels, recorded.name)
    beta = _values(session.base, system, parameters)
    calibration = calibration or ()
    # Where shapes are not measured, no session has estimated any.
    described = () if session.sensing.missing else nuisances(session.sensing)
    known = held(described, calibration)
    # A free gain would make a torque vanish.
    prediction = TorquePrediction(session, beta, known, gain_columns(session.model, session.base, ()))
    motion = MotionRecord(system.sample_rate)
    session.observers += [prediction, motion]
    channels = tuple(recorded.source.channels)
    residual = FixedResidual(session, system, channels) if FixedResidual.known(session, system) else None
    for block in recorded.source:
        session.push(block)
        if residual is not None:
            residual.push(block)
    session.finish()
    courses = prediction.courses
    if not courses:
        raise InputError(recorded.name, "", "no torque, or too few samples", "a run with measured torques")
    least = prediction.least(courses)
    by_type, deflections = ({}, {}) if residual is None else residual.of(beta, calibration)
    joints = {
        name: PredictedTorque(
            each.left,
            least[name],
            by_type.get(name),
            each.channel,
            each.unit,
            each.zero,
            each.zero_share,
            each.turned,
            system.tolerances.encoder_zero,
            each.at_rest,
        )
        for name, each in courses.items()
    }
    warnings = (*recorded.source.warnings, *_resting(courses), *beyond(session.model, motion.motions))
    cannot = _impossible(session.model, session.base, beta, parameters)
    return Validation(
        system.name,
        session.duration,
        joints,
        cannot,
        bool(system.fitted),
        warnings,
        deflections,
        courses,
        any(system.gravity),
    )


def beyond(model: Model, motions: Sequence[Motion]) -> list[str]:
    """Where a run goes beyond what effects of its model are known for, a sentence each."""
    if not motions:
        return []
    x, v = (np.concatenate([getattr(motion, part) for motion in motions]) for part in ("x", "v"))
    return [said for effect in model.effects if (said := effect.beyond(model.layout, x, v))]


def _resting(courses: Mapping[str, TorqueCourse]) -> list[str]:
    """What of a run is not predicted for joints with dry friction that are at rest, a sentence."""
    shares = [f"{name} {100.0 * each.at_rest:.0f} %" for name, each in courses.items() if each.at_rest >= RESTING]
    why = "dry friction is any force up to breakaway there"
    return [f"left out where a joint is at rest, for {why}: {', '.join(shares)}"] if shares else []


def _values(base: BaseParameters, system: System, parameters: Parameters | Mapping[str, float] | None) -> Array:
    """β (n,) of the parameters that are given by name."""
    if parameters is None:
        return base.values(np.array([parameter.nominal for parameter in base.physical]))
    values = {name: each if isinstance(each, float) else each.value for name, each in parameters.items()}
    missing = [parameter.name for parameter in base.parameters if parameter.name not in values]
    if missing:
        raise InputError(system.name, missing[0], "no value", "a value of every parameter of this system")
    return np.array([values[parameter.name] for parameter in base.parameters])


def _impossible(
    model: Model, base: BaseParameters, beta: Array, parameters: Parameters | Mapping[str, float] | None
) -> tuple[str, ...]:
    """Why nothing has parameters β (n,), a clause each.

    Of deviations the correlation is not known: without any, the distance from possible parameters is at most √n times
    too large.
    """
    names, values, beside = [parameter.name for parameter in base.parameters], beta, ""
    if parameters is None:
        # A system file states them one by one, not as they are lumped.
        own, beside = [base.physical[k] for k in base.independent], " beside what else is described"
        names, values = [parameter.name for parameter in own], np.array([parameter.nominal for parameter in own])
        fitted = model.system.fitted
        std = np.array([fitted[name].std or np.inf if name in fitted else 0.0 for name in names])
    else:
        given = [parameters[name] for name in names]
        std = np.array([each.std if isinstance(each, Parameter) else 0.0 for each in given])
    below = negative(names, values, std)
    are = "are" if len(below) > 1 else "is"
    out = [f"{listed(below)} {are} negative{beside}, which is not physical"] if below else []
    known = np.isfinite(std) & (std > 0.0)
    variance = np.full(std.size, np.inf)
    variance[known] = std[known] ** 2
    try:
        nearest = PhysicalSet(model, base).project(beta, np.diag(variance))
    except ArithmeticError:
        return tuple(out)
    distance = nearest.distance / np.sqrt(max(1, int(known.sum())))
    if distance > LARGEST_DISTANCE:
        of = listed(nearest.active)
        out.append(f"no distribution of mass has those of {of}, by at least {distance:.0f} standard deviations")
    return tuple(out)
