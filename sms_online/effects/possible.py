"""What can be: parameters and coefficients that are negative of no body, spring or friction."""

from __future__ import annotations

from sms_online.effects.catalogue import ENTRIES

# Quantities of a model without effects that cannot be negative, as the ends of names.
POSITIVE = ("mass", "mass_per_length", "stiffness", "damping", "rotor_inertia", "rigidity", "rigidity_y", "rigidity_z")


def not_negative(name: str) -> bool:
    """Whether a parameter cannot be negative: a mass, a spring, or a coefficient of an effect that is not signed."""
    effect, at, _ = name.partition("@")
    return not ENTRIES[effect].traits.signed if at else name.endswith(POSITIVE)
