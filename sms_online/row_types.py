"""Types of the rows, named after what they act on, and the residuals that are reported by them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from sms_online.model.layout import Layout

# A joint whose unexplained torque reaches this share of the measured one lacks an effect, whatever the error bars say.
LARGEST_RESIDUAL = 0.5
# Sessions whose model holds leave up to 1.3 of it. Rows beyond this hold more than noise, and green claims too much.
NOISE_WHITENED = 1.5
# Rows of the energy balance.
ENERGY = "energy"


class Residual(NamedTuple):
    """What one type of rows leaves, root mean square; None where it is not known.

    relative: to the measured torque or force. whitened: over the standard deviation that the sensors' noise predicts,
    so that 1 is noise alone.
    """

    relative: float | None
    whitened: float | None

    @property
    def noise_alone(self) -> bool:
        """Whether rows hold no more than their sensors' noise."""
        return self.whitened is not None and self.whitened <= NOISE_WHITENED

    @property
    def weak(self) -> bool:
        """Whether a torque is noise for the most part, by its size and by what the fit leaves.

        Of such a torque a fit can be so far off that it leaves more than noise, along what the motion does not show.
        """
        if self.relative is None or self.whitened is None or self.relative <= LARGEST_RESIDUAL:
            return False
        return self.noise_alone or self.relative / self.whitened > LARGEST_RESIDUAL

    @property
    def unexplained(self) -> bool:
        """Whether most of a torque is unexplained, and more than noise."""
        return self.relative is not None and self.relative > LARGEST_RESIDUAL and not self.weak


Residuals = Mapping[str, Residual]  # by type of the rows


def joint_rows(joint: int) -> str:
    """Type of the rows that hold the motor's torque of a joint, by its number from 0."""
    return f"joint_{joint + 1}"


def row_types(layout: Layout) -> dict[str, list[int]]:
    """Generalized speeds by type of momentum rows: `joint_i`, `link_i` what moves with link i, `base`."""
    out = {joint_rows(i): [theta_m] for i, theta_m in enumerate(layout.theta_m)}
    beside = [[q] if q != theta_m else [] for q, theta_m in zip(layout.q, layout.theta_m, strict=True)]
    beside += [[]] * (len(layout.q_f) - len(beside))  # of fixed joints
    for i, (q_f, q) in enumerate(zip(layout.q_f, beside, strict=True), start=1):
        rows = [*range(q_f.start, q_f.stop), *q]
        if rows:
            out[f"link_{i}"] = rows
    if layout.n_base_speeds:
        out["base"] = list(range(layout.n_base_speeds))
    return out
