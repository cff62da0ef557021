"""Types of the rows that residuals are reported by, named after what they act on."""

from __future__ import annotations

from sms_online.model.layout import Layout

# Rows of the energy balance.
ENERGY = "energy"


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
