"""Windows of the momentum balance: where they are, and what the balance makes of each."""

from __future__ import annotations

from dataclasses import dataclass

from sms_online.pipeline.weak_form import effective_samples, test_function
from sms_online.stream import Array

# Exponent of φ = (1 - z²)⁶: smooth enough that sums over samples are integrals and that two derivatives of φ, which
# multiply position noise, stay calm.
EXPONENT = 6
HOPS = 10  # a window begins every tenth of a window


def _overlap() -> float:
    """How many windows share one error that each row has of its own, hop by hop, as test functions overlap."""
    phi, _, _ = test_function(100 * HOPS, 1.0, EXPONENT)
    return effective_samples(phi) / 100.0


# Windows whose rows are not whitened among themselves: so many of them count as one.
OVERLAP = _overlap()
# Instants of a window at which the sensitivity to noise is computed, two a hop: it changes as slowly as the motion.
INSTANTS = 2 * HOPS
# Steps of a window at which it is known what noise adds to its rows: two for each instant.
STEPS = 2 * INSTANTS
STEPS_A_HOP = STEPS // HOPS
# Copies of motion and torques: as measured, and with synthetic noise added and subtracted.
COPIES = 3


@dataclass(frozen=True)
class Instants:
    """States at `number`, `number` + 1, …, in half hops since the segment began: x (K, n_x), v (K, n_v).

    signals (K, n_signals): n τ, measured wrenches, then internal states of effects.
    """

    number: int
    x: Array
    v: Array
    signals: Array


@dataclass(frozen=True)
class Window:
    """Weak-form rows of one window, one for each generalized speed, in N s (N m s).

    start: its first instant, in half hops since the segment began. end: grid index of its last sample. Y (copies,
    nonzero): columns of the base parameters where the model has any (`MomentumBalance.rows`, `.columns`); b (copies,
    n_v). The first copy is that of the samples as measured, the others those of the samples with noise added.
    moment (nonzero,): Y of the first copy with the test function (t - t_c) φ, t_c the window's centre: what parameters
    add that change evenly, by their rates; empty where nobody asked. half_width: M of the filter.
    rough (2, STEPS + 1, E): what noise and slow displacements of readings do by way of rough forces, see `responses` of
    `rough_forces`. rest (INSTANTS, D): see `RoughForces.at_rest`.
    """

    start: int
    end: int
    Y: Array
    b: Array
    half_width: int
    rough: Array
    rest: Array
    moment: Array
