"""Observers of a session's samples, motion and blocks."""

from __future__ import annotations

from sms_online.pipeline.synchronise import GridSamples
from sms_online.stream import Array, Block, Indices


class Observer:
    """Watches one session: put it into `Estimator.observers`. What it does not override it does not see."""

    def received(self, block: Block) -> None:
        """Samples of the channels that the session uses, at their own times, without outliers."""

    def samples(self, piece: GridSamples) -> None:
        """Grid samples of the channels that the model reads, as the synchroniser gives them."""

    def motion(self, index: Indices, segment: int, x: Array, v: Array, inputs: Array, states: Array) -> None:
        """Consecutive smoothed samples: grid index (B,), number of the segment, x (B, n_x), v (B, n_v).

        inputs (B, inputs): n τ and measured wrenches. states (B, n_states): internal states of effects.
        """

    def block_through(self) -> None:
        """An internal block has passed all stages: the one moment at which effects may be adopted."""
