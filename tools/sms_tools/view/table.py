"""All parameters as they are now, as a table in Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from sms_online.model.parameters import Parameter
from sms_tools.view.frames import Reference
from sms_tools.view.known import Known
from sms_tools.view.parameter_groups import shortened


def markdown_table(parameters: Sequence[Parameter], references: Sequence[Reference | None], now: Known) -> str:
    """Symbol, unit, estimate ± std and the reference; a dash where the data determine nothing."""
    estimate, std, determined = now.estimate, now.std, now.determined
    compared = "true" if any(reference is not None and reference.is_true for reference in references) else "nominal"
    lines = [f"| parameter | unit | estimate | ± std | {compared} | deviation |", "|:--|:--|--:|--:|--:|--:|"]
    for k, (p, reference) in enumerate(zip(parameters, references, strict=True)):
        value = spread = deviation = "–"
        if determined[k]:
            value, spread = f"{estimate[k]:.6g}", f"{std[k]:.2g}"
            if reference is not None and reference.value:
                deviation = f"{100.0 * (estimate[k] / reference.value - 1.0):+.3g} %"
        known = "–" if reference is None else f"{reference.value:.6g}"
        lines.append(f"| {shortened(p.symbol)} | {p.unit} | {value} | {spread} | {known} | {deviation} |")
    return "\n".join(lines)
