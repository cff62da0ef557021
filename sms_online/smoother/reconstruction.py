"""Coordinates that no sensor follows, reconstructed: a capture whose links cameras see as points, as if all were read.

The momentum balance, and with it a diagnosis, needs samples of every coordinate. Equations of motion with white forces
on all coordinates, as the smoother begins with, follow the samples whatever else acts, and say how a link bends between
its markers. Of what is missing in the model they hold nothing, for it is a force as any other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from sms_online.description.bodies import FlexibleLink
from sms_online.description.channels import sensed_channels
from sms_online.description.schema import LEAST_SQUARES, Sensor, System, Tolerances
from sms_online.effects.build import build_model
from sms_online.effects.catalogue import ENTRIES
from sms_online.errors import InputError
from sms_online.linearised import Motion
from sms_online.model.base_parameters import BaseParameters
from sms_online.model.model import Model
from sms_online.model.readings import position_channels
from sms_online.pipeline.description import described
from sms_online.pipeline.estimator import Estimator
from sms_online.pipeline.sensing import Sensing
from sms_online.smoother.gauss_newton import DivergedError
from sms_online.smoother.session import Smoother
from sms_online.stream import Block
from sms_online.trackers.factor import triangular_factor
from sms_online.trackers.interface import Estimate

# Nodes at either end of a span that are left out: the filter there knows samples of one side alone.
ENDS = 3
# Rows of the blocks that are made.
BLOCK = 1000


class _Follower(Smoother):
    """Follows the samples span by span in place of fitting them. motions: of the spans; failures: of those left out."""

    def __init__(self, model: Model, base: BaseParameters, sensing: Sensing, available: Sequence[str]) -> None:
        super().__init__(model, base, sensing, available, (LEAST_SQUARES,), None)
        self.motions: list[Motion] = []
        self.failures: list[str] = []
        self._found = np.concatenate((np.zeros(len(self.nuisances)), described(model, base)[0]))
        self._factor = self.known.factor

    def _fit(self, count: int, first_fit: Callable[[], Estimate]) -> bool:
        try:
            smoother, span = self._span_problem(count)
            search = smoother.follow(span, self._found, triangular_factor(self._beforehand, self._factor))
        except DivergedError as error:
            begin, end, _, _ = self.gathered.span(count)
            self.failures.append(f"{begin:.6g} … {end:.6g} s: {error}")
            return True
        self.motions.append(search.motion)
        self._found, self._factor = search.beta, triangular_factor(self._factor, search.factor)
        return True


def _without(system: System, keys: Sequence[str]) -> System:
    """The system without some effects and what it states of them: what the smoother does not use is missing to it."""
    stated = {
        name: {key: value for key, value in getattr(system, name).items() if key.rpartition(".")[0] not in keys}
        for name in ("known", "priors", "fitted")
    }
    effects = tuple(effect for effect in system.effects if effect.key not in keys)
    return system.model_copy(update={"effects": effects, **stated})


class Reconstruction:
    """Reconstructs what the sensors of a system do not follow.

    available: channels of the captures; source: names them in messages. system: as described, but with a reading of
    every coordinate. channels: those of its readings that are reconstructed; none where nothing has to be. failures:
    spans of captures that were left out and why, a sentence each.
    Raises InputError as `Sensing` and `Estimator` do.
    """

    def __init__(self, system: System, available: Sequence[str], source: str) -> None:
        self._described, self._available, self._source = system, tuple(available), source
        self.system, self.channels = system, tuple[str, ...]()
        self.failures: list[str] = []
        model = build_model(system)
        unseen = [] if system.balance == "energy" else Sensing(model, available, source).unseen
        if not unseen:
            return
        unused = [effect.key for effect in model.effects if effect.n_states or effect.needs_torque]
        unused += [effect.key for effect in system.effects if ENTRIES[effect.name].kind == "channel"]
        self._followed = _without(system, unused)
        bent = {i for i, k in enumerate(model.chain.flexible) if k and model.layout.elastic(i).start in unseen}
        links = tuple(
            link.model_copy(update={"markers": ()}) if i in bent else link for i, link in enumerate(system.links)
        )
        whole = build_model(system.model_copy(update={"links": links}))
        self._unseen, self.channels = unseen, tuple(position_channels(whole)[k] for k in unseen)
        of_links = tuple(f"link_{i + 1}." for i in bent)
        kept = [name for name in available if name not in self.channels and not name.startswith(of_links)]
        self._sensing = Sensing(whole, (*kept, *self.channels), source)
        self._kept = [name for name in kept if name in self._sensing.channels]
        self.system = whole.system.model_copy(
            update={"sensors": self._sensors(), "tolerances": self._tolerances(), "balance": "both"}
        )

    def _sensors(self) -> tuple[Sensor, ...]:
        """Those of the channels that are kept: of what is reconstructed the samples show the noise."""
        named = [
            (sensor, tuple(c for c in sensed_channels(self._described, sensor) if c in self._kept))
            for sensor in self._described.sensors
        ]
        return tuple(sensor.model_copy(update={"channels": own}) for sensor, own in named if own)

    def _tolerances(self) -> Tolerances:
        """With zeros of markers by as much as places of those may be off from which shapes are reconstructed."""
        stated = self._described.tolerances
        flexible = [link for link in self._described.links if isinstance(link, FlexibleLink)]
        element = min((link.length / link.elements for link in flexible), default=np.inf)
        turned = np.hypot(stated.marker_zero_angle, stated.marker_station / element)
        zero = np.hypot(stated.marker_zero, stated.marker_station)
        return stated.model_copy(update={"marker_zero": float(zero), "marker_zero_angle": float(turned)})

    def __call__(self, blocks: Sequence[Block]) -> list[Block]:
        """Samples of a capture, those of its channels that are kept beside what is reconstructed.

        InputError where no span of it can be followed.
        """
        if not self.channels:
            return list(blocks)
        estimator = Estimator(self._followed, self._available, self._source, whole=True)
        follower = _Follower(estimator.model, estimator.base, estimator.sensing, self._available)
        estimator.smoother = follower
        for block in blocks:
            estimator.push(block)
        estimator.finish()
        if not follower.motions:
            why = follower.failures[0] if follower.failures else "no motion without a gap of half a second"
            raise InputError(self._source, "", why, "samples that some motion of the described system explains")
        self.failures += follower.failures
        return self._merged(blocks, follower.motions)

    def _merged(self, blocks: Sequence[Block], motions: Sequence[Motion]) -> list[Block]:
        kept = [self._available.index(name) for name in self._kept]
        t = np.concatenate([block.t for block in blocks] + [motion.t[ENDS:-ENDS] for motion in motions])
        read = [self._sensing.readings(motion.x[ENDS:-ENDS])[:, self._unseen] for motion in motions]
        own, other = sum(block.t.size for block in blocks), sum(map(len, read))
        values = np.full((own + other, len(kept) + len(self.channels)), np.nan)
        values[:own, : len(kept)] = np.concatenate([block.values[:, kept] for block in blocks])
        values[own:, len(kept) :] = np.concatenate(read)
        order = np.argsort(t, kind="stable")
        whole = Block(t[order], (*self._kept, *self.channels), values[order])
        return list(whole.pieces(BLOCK))

    @property
    def warnings(self) -> list[str]:
        """What was reconstructed, and what was left out, a sentence each."""
        several = f" and {len(self.channels) - 1} more" if len(self.channels) > 1 else ""
        said = f"{self.channels[0]}{several} are reconstructed by equations of motion with unknown forces"
        return [said, *(f"left out is {failure}" for failure in self.failures)]

    def restored(self, system: System) -> System:
        """`system`, or what a diagnosis has made of it, with the sensors and markers that are described."""
        if not self.channels:
            return system
        described = self._described
        links = tuple(
            link.model_copy(update={"markers": own.markers})
            for link, own in zip(system.links, described.links, strict=True)
        )
        kept = ("sensors", "tolerances", "balance", "trackers")
        return system.model_copy(update={"links": links, **{name: getattr(described, name) for name in kept}})
