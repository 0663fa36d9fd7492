"""Option types that several verbs share."""

from __future__ import annotations

import click


class Numbers(click.ParamType[tuple[float, ...]]):
    """A fixed count of comma-separated numbers, such as ``-1.5,0,2``."""

    def __init__(self, names: str) -> None:
        self.name = names
        self._count = len(names.split(","))

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """The numbers, or click's usage error (exit code 2) naming what was expected."""
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(float(field) for field in str(value).split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != self._count or not all(abs(number) < float("inf") for number in numbers):
            self.fail(f"'{value}' is not {self.name}: {self._count} numbers with commas between", param, ctx)
        return numbers


XYZ = Numbers("X,Y,Z")
LAT_LON = Numbers("LAT,LON")
