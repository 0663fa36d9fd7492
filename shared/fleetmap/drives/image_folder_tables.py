"""Tables of times, positions and images, as loggers of phones and dash cams write them: CSV with named columns.

Columns are found by their names, in any case and order, with units after an underscore or in brackets:

========== ===========================================================================================
time       time, timestamp, stamp, datetime, utc, gps_time, unix_time, epoch, t; a unit as in time_ms counts;
           a date column may stand beside a time of day
position   lat(itude), lon(gitude), or easting, northing with an EPSG code
height     height, alt(itude), ele(vation); above the ellipsoid
accuracy   accuracy, horizontal_accuracy, hacc, sigma; vertical_accuracy, vacc; one sigma per axis
image      image, file(name), name, photo, path
========== ===========================================================================================
"""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from fleetmap.drive import GnssFix
from fleetmap.drives.conversion import checked_stamp_ns, read_lines
from fleetmap.drives.image_folder_times import NS_PER_UNIT, time_ns
from fleetmap.errors import DriveError, InputError
from fleetmap.geodesy import UtmGrid

UNKNOWN_HEIGHT_SIGMA_M = 10.0  # of a height that no column holds: roads climb

_NAMES = {
    "time": "time timestamp stamp datetime utc utctime timeutc gpstime gpstimestamp unixtime unix epoch t",
    "date": "date day gpsdate",
    "lat": "lat latitude gpslatitude",
    "lon": "lon lng long longitude gpslongitude",
    "easting": "easting utmeasting utme",
    "northing": "northing utmnorthing utmn",
    "height": "height alt altitude ele elevation ellipsoidalheight gpsaltitude",
    "accuracy": "accuracy horizontalaccuracy haccuracy hacc posaccuracy positionaccuracy sigma sigmah",
    "vertical": "verticalaccuracy vaccuracy vacc sigmav",
    "image": "image imagename imagefile file filename name photo picture path sourcefile",
}
_UNITS = {"sec": "s", "secs": "s", "second": "s", "seconds": "s", "secofday": "s", "msec": "ms", "µs": "us"}
_DATE = re.compile(r"\d{4}([-/:.]?)\d\d\1\d\d")
_BRACKETS = re.compile(r"(.+?)[\s_]*[\[(]\s*(.*?)\s*[\])]")
_SUFFIX = re.compile(r"(.+?)[\s_](ns|us|µs|ms|msec|s|secs?|seconds?|sec_of_day|m|deg|degrees|utc)")


@dataclass(frozen=True)
class Table:
    """A CSV file's rows, and which column plays which role."""

    path: Path
    header: tuple[str, ...]
    columns: dict[str, int]  # role -> index
    time_unit: str | None  # of numbers in the time column, where its name says so
    rows: tuple[tuple[int, tuple[str, ...]], ...]  # line number, fields

    def require(self, *roles: str) -> None:
        """Raise DriveError unless the table has columns for all these roles."""
        missing = [role for role in roles if role not in self.columns]
        if missing:
            raise DriveError(
                f"{self.path} has no column for {' and '.join(missing)}; its first line names"
                f" {', '.join(self.header)}"
            )

    def cell(self, row: tuple[str, ...], role: str) -> str:
        """A field of a row; empty where the row or the table ends before it."""
        index = self.columns.get(role, len(row))
        return row[index] if index < len(row) else ""

    def number(self, line: int, row: tuple[str, ...], role: str) -> float:
        """A field as a number. Raises DriveError naming file, line and column."""
        text = self.cell(row, role)
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise DriveError(f"{self.path} line {line}: {self.header[self.columns[role]]} '{text}' is no number")
        return value

    def stamp_ns(self, line: int, row: tuple[str, ...]) -> int:
        """The time of a row. Raises DriveError naming file and line."""
        origin = f"{self.path} line {line}"
        text, date = self.cell(row, "time"), self.cell(row, "date")
        if ":" in text and _DATE.fullmatch(date) and not _DATE.match(text):
            text = f"{date} {text}"
        try:
            return checked_stamp_ns(time_ns(text, self.time_unit), origin)
        except ValueError as error:
            raise DriveError(f"{origin}: {error}") from error


@dataclass(frozen=True)
class PositionDefaults:
    """What a table of positions may leave open."""

    epsg: int | None = None  # of easting and northing
    height_m: float | None = None  # above the ellipsoid, where there is no height
    accuracy_m: float = 1.5  # one sigma per axis, where there is no accuracy

    def __post_init__(self) -> None:
        if not (math.isfinite(self.accuracy_m) and self.accuracy_m > 0.0):
            raise InputError(f"an accuracy of {self.accuracy_m} m makes no sense")
        if self.height_m is not None and not math.isfinite(self.height_m):
            raise InputError(f"a height of {self.height_m} m makes no sense")


def read_table(path: Path) -> Table:
    """A CSV file with comma, semicolon or tab, whose first line names its columns.

    Raises:
        DriveError: it cannot be read, or is empty.
    """
    lines = read_lines(path)
    first = next((index for index, line in enumerate(lines) if line.strip()), None)
    if first is None:
        raise DriveError(f"{path} is empty")
    delimiter = max(",;\t", key=lines[first].count)
    try:
        reader = csv.reader(lines[first:], delimiter=delimiter)
        parsed = [(first + reader.line_num, tuple(field.strip() for field in row)) for row in reader]
    except csv.Error as error:
        raise DriveError(f"{path} is no CSV: {error}") from error
    header = (parsed[0][1][0].lstrip("# "), *parsed[0][1][1:])
    columns, time_unit = _columns(header)
    rows = tuple((line, row) for line, row in parsed[1:] if any(row) and not row[0].startswith("#"))
    return Table(path, header, columns, time_unit, rows)


def read_image_stamps(table: Table) -> dict[str, tuple[int, int]]:
    """File name -> line number and stamp in ns, of the rows that name an image.

    Raises:
        DriveError: a column is missing, a time cannot be read, or two rows name one image.
    """
    table.require("image", "time")
    stamps: dict[str, tuple[int, int]] = {}
    for line, row in table.rows:
        name = PurePosixPath(table.cell(row, "image").replace("\\", "/")).name
        if not name:
            continue
        if name in stamps:
            raise DriveError(f"{table.path} line {line}: {name} has a row already, line {stamps[name][0]}")
        stamps[name] = (line, table.stamp_ns(line, row))
    return stamps


def read_fixes(table: Table, defaults: PositionDefaults) -> list[GnssFix]:
    """A fix for each row that has a position; rows whose position is empty had no reception.

    Raises:
        DriveError: a column is missing, a row holds garbage, or a row is not later than the one before.
    """
    is_projected = "lat" not in table.columns and "easting" in table.columns
    position = ("easting", "northing") if is_projected else ("lat", "lon")
    table.require("time", *position)
    if is_projected and defaults.epsg is None:
        raise DriveError(f"{table.path} has easting and northing; say of which UTM zone, such as --epsg 32632")
    grid = UtmGrid(defaults.epsg) if is_projected and defaults.epsg is not None else None
    fixes: list[GnssFix] = []
    needed = 1 + max(table.columns[role] for role in ("time", *position))
    for line, row in table.rows:
        if len(row) < needed:
            raise DriveError(f"{table.path} line {line} has {len(row)} fields instead of {len(table.header)}")
        if not any(table.cell(row, role) for role in position):
            continue
        fix = _fix(table, line, row, grid, defaults)
        if fixes and fix.stamp_ns <= fixes[-1].stamp_ns:
            raise DriveError(f"{table.path} line {line} is not later than the position before it")
        fixes.append(fix)
    if not fixes:
        raise DriveError(f"{table.path} holds no positions")
    return fixes


def _fix(
    table: Table, line: int, row: tuple[str, ...], grid: UtmGrid | None, defaults: PositionDefaults
) -> GnssFix:
    lat_deg, lon_deg = _lat_lon_deg(table, line, row, grid)
    has_height = table.cell(row, "height") != ""
    if "height" in table.columns and not has_height and defaults.height_m is None:
        raise DriveError(f"{table.path} line {line} has no height; give --height-m for such rows")
    height_m = table.number(line, row, "height") if has_height else defaults.height_m or 0.0
    sigma_m = _sigma_m(table, line, row, "accuracy", defaults.accuracy_m)
    sigma_up_m = _sigma_m(table, line, row, "vertical", sigma_m) if has_height else UNKNOWN_HEIGHT_SIGMA_M
    covariance_enu_m2 = np.diag([sigma_m**2, sigma_m**2, sigma_up_m**2])
    return GnssFix(table.stamp_ns(line, row), lat_deg, lon_deg, height_m, covariance_enu_m2)


def _lat_lon_deg(table: Table, line: int, row: tuple[str, ...], grid: UtmGrid | None) -> tuple[float, float]:
    if grid is None:
        lat_deg, lon_deg = table.number(line, row, "lat"), table.number(line, row, "lon")
    else:
        easting_m, northing_m = table.number(line, row, "easting"), table.number(line, row, "northing")
        if not (0.0 < easting_m < 1e6 and 0.0 <= northing_m <= 1e7):
            raise DriveError(f"{table.path} line {line}: {easting_m}, {northing_m} lies outside its UTM zone")
        lat, lon, _ = grid.to_geodetic(np.array([easting_m, northing_m, 0.0]))
        lat_deg, lon_deg = float(lat), float(lon)
    if not (abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0):
        raise DriveError(f"{table.path} line {line}: latitude {lat_deg}, longitude {lon_deg} is not on the globe")
    return lat_deg, lon_deg


def _sigma_m(table: Table, line: int, row: tuple[str, ...], role: str, otherwise_m: float) -> float:
    """Empty, zero and negative accuracies are how loggers say that they do not know."""
    if table.cell(row, role) == "":
        return otherwise_m
    sigma_m = table.number(line, row, role)
    return sigma_m if sigma_m > 0.0 else otherwise_m


def _columns(header: tuple[str, ...]) -> tuple[dict[str, int], str | None]:
    """The first column of each role, and the unit that the time column's name holds."""
    columns: dict[str, int] = {}
    time_unit = None
    for index, name in enumerate(header):
        base, unit = _name_and_unit(name)
        role = next((role for role, names in _NAMES.items() if base in names.split()), None)
        if role is not None and role not in columns:
            columns[role] = index
            if role == "time":
                time_unit = unit if unit in NS_PER_UNIT else None
    if "time" not in columns and "date" in columns:
        columns["time"] = columns.pop("date")
    return columns, time_unit


def _name_and_unit(name: str) -> tuple[str, str | None]:
    lowered = name.lower()
    split = _BRACKETS.fullmatch(lowered) or _SUFFIX.fullmatch(lowered)
    base, unit = (split[1], re.sub(r"[\s_]", "", split[2])) if split else (lowered, None)
    return re.sub(r"[^a-z0-9]", "", base), _UNITS.get(unit, unit) if unit else None
