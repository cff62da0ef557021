"""What all records of a system description have in common."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]


class Record(BaseModel):
    """A frozen record: unknown keys, infinities and NaN are errors.

    The docstring of each record has a line `field: meaning, unit.` for each of its fields. The site's reference of
    system files is made of these lines, and its build fails where one is missing.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
