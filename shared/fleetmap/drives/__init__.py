"""One module a recording format, each giving a fleetmap.drive.Drive."""
