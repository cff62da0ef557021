"""What all records of a system description have in common."""

from __future__ import annotations

from typing import Annotated, Any, get_args

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]


class Record(BaseModel):
    """A frozen record: unknown keys, infinities and NaN are errors.

    The docstring of each record has a line `field: meaning, unit.` for each of its fields. The site's reference of
    system files is made of these lines, and its build fails where one is missing.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def records_in(annotation: Any) -> list[type[Record]]:
    """The records that a type is made of, in its order: those of a union, of a list, of a table."""
    if isinstance(annotation, type) and issubclass(annotation, Record):
        return [annotation]
    return [record for part in get_args(annotation) for record in records_in(part)]


def tagged(key: str, union: Any) -> dict[str, type[Record]]:
    """Records of a union by the value of the key that distinguishes them."""
    return {get_args(record.model_fields[key].annotation)[0]: record for record in records_in(union)}
