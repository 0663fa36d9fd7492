"""The common language of fleetmap: values, frames, geodesy, recordings, maps and how they travel."""

__version__ = "0.1.0"
