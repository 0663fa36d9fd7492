"""Every error a user can meet. Each message says what was wrong, where, and what to do.

FleetmapError
├── InputError                bad input or usage                          exit code 2
│   ├── DriveError            a recording cannot be read, or lacks something
│   ├── CalibrationError      a camera model is missing or contradicts the images
│   ├── TrajectoryError       a TUM file is malformed or does not fit its partner
│   ├── MapPackageError       a map package is malformed, tampered with or too new
│   └── OutputExistsError     the output is there already and --force was not given
└── RunError                  failed while running                        exit code 1
    ├── NoPoseError           not one frame of the whole drive could be localised
    ├── StorageError          the disk is full or refuses
    ├── ConflictError         somebody else was first: another version of the map is the latest by now
    ├── JobLostError          a job belongs to another worker by now, or to none
    └── ServerError           what goes wrong between client and map server
        ├── ServerUnreachableError
        ├── ServerRefusedError    the server answered with a problem document
        │   └── AccessDeniedError     it wants a token, or another one
        └── TransferError         the transfer ended before everything had arrived
"""

from typing import ClassVar


class FleetmapError(Exception):
    """Root of all errors that are meant for the user's eyes; str() is one clear line."""

    exit_code: ClassVar[int] = 1


class InputError(FleetmapError):
    """Bad input or usage."""

    exit_code = 2


class DriveError(InputError):
    """A recording cannot be read, or lacks something that the task needs."""


class CalibrationError(InputError):
    """A camera model is missing or contradicts the images."""


class TrajectoryError(InputError):
    """A TUM file is malformed or does not fit its partner."""


class MapPackageError(InputError):
    """A map package is malformed, tampered with, or of a newer major version."""


class OutputExistsError(InputError):
    """The output is there already and replacing it was not asked for."""


class RunError(FleetmapError):
    """The input was good, the run was not."""


class NoPoseError(RunError):
    """Not one frame of the whole drive could be localised."""


class StorageError(RunError):
    """The disk is full or refuses to be written."""


class ConflictError(RunError):
    """Somebody else was first: another version of the map is the latest by now."""


class JobLostError(RunError):
    """A job belongs to another worker by now, or to none; what its fence protects was not done."""


class ServerError(RunError):
    """Something went wrong between a client and the map server."""


class ServerUnreachableError(ServerError):
    """No map server answered at the given endpoint."""


class ServerRefusedError(ServerError):
    """The map server answered with a problem document (RFC 9457)."""


class AccessDeniedError(ServerRefusedError):
    """The map server wants a token, or one that may do more."""


class TransferError(ServerError):
    """A transfer ended before everything had arrived, or arrived damaged."""
