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


class Gap(click.ParamType[tuple[float, float]]):
    """A stretch of time such as ``11:10``."""

    name = "START_S:LENGTH_S"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        """Start and length, or click's usage error (exit code 2) naming what was expected."""
        if isinstance(value, tuple):
            return value
        try:
            start_s, length_s = (float(field) for field in str(value).split(":"))
        except ValueError:
            start_s = length_s = -1.0
        if not (0.0 <= start_s < float("inf") and 0.0 < length_s < float("inf")):
            self.fail(f"'{value}' is not {self.name}: two numbers of seconds with a colon between", param, ctx)
        return start_s, length_s


XYZ = Numbers("X,Y,Z")
LAT_LON = Numbers("LAT,LON")
