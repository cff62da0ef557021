"""A simulated session as a capture with its truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from sms_online.capture import Capture
from sms_online.description.given import Given, given_system
from sms_online.description.schema import Effect, System
from sms_online.effects.build import build_model, declaring
from sms_online.effects.catalogue import ENTRIES, check_effect, parse_effect
from sms_online.errors import InputError
from sms_online.stream import Block
from sms_sim.camera_faults import CameraFault, CameraFaults, parsed_faults
from sms_sim.drifting import ParameterDrift, drifted, parsed
from sms_sim.plant import Plant
from sms_sim.sensors import Sensors
from sms_sim.simulate import Simulation, sampled_blocks
from sms_sim.simulate import simulate as solve

# Longest simulation, s: eleven days.
LONGEST = 1e6


@dataclass(frozen=True)
class Simulated:
    """A session to be simulated: the described system with effects that its file does not declare, and its sensors.

    grade: noise in place of the described one. seed: of the noise. duration: s, None for the trajectory's own. drifts:
    of its parameters. faults: of the cameras that see its markers.
    """

    described: System
    effects: tuple[Effect, ...] = ()
    duration: float | None = None
    grade: str | None = None
    seed: int = 0
    drifts: tuple[ParameterDrift, ...] = ()
    faults: tuple[CameraFault, ...] = ()

    @staticmethod
    def of(
        system: System,
        effects: Sequence[str | Effect] = (),
        duration: float | None = None,
        grade: str | None = None,
        seed: int = 0,
        drift: Sequence[str | ParameterDrift] = (),
        faults: Sequence[str | CameraFault] = (),
    ) -> Simulated:
        """Effects, drifts and faults as texts or records; InputError where one cannot act on the system."""
        if isinstance(effects, str):
            raise InputError("effects", "", repr(effects), f"a list of effects, [{effects!r}]")
        injected: list[Effect] = []
        for effect in effects:
            whole = declaring(system, injected)
            if isinstance(effect, Effect):
                check_effect(whole, effect, "effects", effect.key)
                injected.append(effect)
            else:
                injected.append(parse_effect(effect, whole))
        for effect in injected:
            if ENTRIES[effect.name].coefficients and not any(effect.coefficients.values()):
                (first, *_) = ENTRIES[effect.name].coefficients
                expected = f"its size, such as {effect.key}:{first}=1"
                raise InputError("effects", effect.key, "nothing of it", expected)
        if duration is not None and not 0.0 < duration <= LONGEST:
            raise InputError("simulate", "duration", f"{duration:g} s", f"more than 0, at most {LONGEST:g} s")
        if system.trajectory is not None and any(system.trajectory.joints) and system.controller is None:
            raise InputError(system.name, "controller", "no such table", "gains that follow [trajectory]")
        whole = declaring(system, injected)
        drifts = parsed(drift)
        model = build_model(whole) if drifts else None
        for each in drifts:
            assert model is not None
            each.direction(model, model.nominal)
        out = Simulated(system, tuple(injected), duration, grade, seed, drifts, parsed_faults(faults))
        if out.faults:
            CameraFaults(out.faults, out.channels, seed)  # refuses markers that there are not
        return out

    @cached_property
    def system(self) -> System:
        """The system that moves."""
        return declaring(self.described, self.effects)

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """What the sensors record; InputError on an unknown grade."""
        return Sensors(self.system, Plant(self.system).recordable, self.grade, self.seed).channels

    def solve(self, progress: Callable[[str, float], None] = lambda what, share: None) -> Simulation:
        """The motion; InputError where nothing states how long it is, or where it cannot be followed.

        progress: is called with what is being done, a few words, and the share of it that is done.
        """
        try:
            report = partial(progress, "solving the motion")
            return solve(self.system, self.duration, progress=report, drifts=self.drifts)
        except ArithmeticError as error:
            expected = "a motion that the integrator can follow"
            raise InputError(self.described.name, "trajectory and controller", str(error), expected) from None

    def blocks(self, simulation: Simulation) -> Iterator[Block]:
        """What the sensors record of it."""
        whole = sampled_blocks(simulation, self.grade, self.seed)
        return map(CameraFaults(self.faults, self.channels, self.seed), whole) if self.faults else whole

    def capture(self, simulation: Simulation) -> Capture:
        """The same as a capture with its truth."""
        blocks = list(self.blocks(simulation))
        t, values = (np.concatenate([getattr(block, part) for block in blocks]) for part in ("t", "values"))
        name = f"simulation of {self.described.name}"
        return Capture(t, self.channels, values, name, (), self.truth(simulation))

    def truth(self, simulation: Simulation) -> dict[str, Any]:
        """True parameters of the described system, and how they came about."""
        return {
            "parameters": self._at_end(simulation),
            "system": self.system.name,
            "grade": self.grade,
            "seed": self.seed,
            "duration_s": simulation.duration,
            "effects": [
                {"coefficients": {}, **effect.model_dump(mode="json", exclude_defaults=True)} for effect in self.effects
            ],
            "drifts": [drift.document() for drift in self.drifts],
            "faults": [fault.document() for fault in self.faults],
        }

    def _at_end(self, simulation: Simulation) -> dict[str, float]:
        """Parameters of the described system, with where drifts have brought them."""
        model = build_model(self.described)
        own = [drift for drift in self.drifts if any(drift.parameter in (p.name, p.owner) for p in model.parameters)]
        end = drifted(model, model.nominal, own, np.array([simulation.duration]))[0]
        return {p.name: float(value) for p, value in zip(model.parameters, end, strict=True)}


def simulate(
    system: Given,
    duration: float | None = None,
    grade: str | None = None,
    seed: int = 0,
    effects: Sequence[str | Effect] = (),
    drift: Sequence[str | ParameterDrift] = (),
    faults: Sequence[str | CameraFault] = (),
) -> Capture:
    """Simulate a described system in closed loop, and record what its sensors see.

    system: described, or its name or file. duration: s, the described trajectory's by default. grade: noise of all
    sensors in place of the described one, "0" none, "A", "B", "C" ever more. seed: of the noise. effects: what the
    system file does not describe, as texts "name@where:coefficient=value,…". drift: parameters that change on the way,
    "parameter:share=-0.1,over=60" for instance, or "parameter:half_life=20"; what is true is then the value at the end.
    faults: of the cameras, "missing@link_1.*:share=0.1", "hidden@link_2.*:begin=8,over=2" or
    "swapped@link_1.marker_1+link_1.marker_2:begin=5,over=1". The capture holds the truth, which no estimate uses.
    InputError for an effect, a drift, a fault or a grade that there is not, or a motion that cannot be followed.
    """
    system, _ = given_system(system)
    session = Simulated.of(system, effects, duration, grade, seed, drift, faults)
    _ = session.channels  # an unknown grade is known before a long simulation
    return session.capture(session.solve())
