"""Grid samples as the balances take them: free of what effects do to channels, beside effects' internal states.

Effects that are found while a session runs may ask for other corrections, or for states that nobody has followed. The
samples that hold them are then prepared once more.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from sms_online.description.schema import Effect
from sms_online.effects.build import changed_model, declaring
from sms_online.effects.catalogue import corrections
from sms_online.model.model import Model
from sms_online.pipeline.conditioning import Conditioning
from sms_online.pipeline.internal_states import FollowedStates
from sms_online.pipeline.rates import RateSamples
from sms_online.pipeline.sensing import Sensing
from sms_online.pipeline.synchronise import GridSamples
from sms_online.state import Stage, State
from sms_online.stream import Array


class PreparationState(State):
    """What a preparation keeps: effects that were found while the session ran, times that it has begun anew."""

    effects: tuple[Effect, ...] = ()
    begun: int = 0


class Preparation(Stage):
    """Corrections of one session's channels, and internal states of effects.

    model: of the system as described. Numbers of segments go up by one at each update that changes the preparation.
    """

    def __init__(self, model: Model, sensing: Sensing) -> None:
        self._described, self._sensing = model, sensing
        self.state = PreparationState()
        self._build()

    def _build(self) -> None:
        self._model = self._with(())
        self._conditioning = Conditioning(self._model.system, self._sensing.channels)
        self._followed = FollowedStates(self._model, self._sensing, self._model.system.sample_rate)

    def _with(self, effects: Sequence[Effect]) -> Model:
        """The model with further effects."""
        every = (*self.state.effects, *effects)
        described = self._described
        return changed_model(described, declaring(described.system, every)) if every else described

    def renew(self) -> None:
        """See Stage."""
        self._build()

    def push(self, piece: GridSamples) -> Iterator[GridSamples]:
        """Take samples of the channels; give those that are ready, with internal states (·, channels + n_states)."""
        numbered = replace(piece, segment=piece.segment + self.state.begun)
        for corrected in self._conditioning.push(numbered):
            yield from self._followed.push(corrected)

    def states(self, rates: RateSamples) -> Array:
        """Internal states (B, n_states) at samples that were given before."""
        return self._followed.beside(rates)

    def differs(self, effects: Sequence[Effect]) -> bool:
        """Whether samples are prepared in another way where the model has these effects too."""
        now, after = self._model, self._with(effects)
        return after.n_states > now.n_states or len(corrections(after.system)) > len(corrections(now.system))

    def begin(self, effects: Sequence[Effect], samples: GridSamples, differs: bool) -> GridSamples:
        """Go on with further effects, from samples of the newest segment that hold them; give these as prepared.

        differs: whether they are prepared in another way. Internal states begin at rest with the first of them.
        """
        self.state.begun += differs
        self.state.effects = (*self.state.effects, *effects)
        self._build()
        nothing = np.empty((0, samples.values.shape[1] + self._model.n_states))
        ready = list(self.push(samples))
        index = np.concatenate((samples.index[:0], *(piece.index for piece in ready)))
        values = np.concatenate((nothing, *(piece.values for piece in ready)))
        return GridSamples(index, values, samples.segment + self.state.begun)
