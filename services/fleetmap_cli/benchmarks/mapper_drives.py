"""The drives that maps are measured on: two real ones, and a simulated circuit whose truth is exactly known."""

from __future__ import annotations

from dataclasses import dataclass

from fleetmap_cli.benchmarks.workbench import Workbench

ODOMETRY = "drives/kitti_odo_00_first300"
RAW = "drives/kitti_raw_20110926_1405"
ODOMETRY_SEED = 7  # of the GNSS errors


@dataclass(frozen=True)
class Recording:
    """A recording NAME.mcap, with its NAME.reference.tum, and the commands that make it."""

    name: str
    commands: tuple[str, ...]
    needs: tuple[str, ...] = ()  # under the data folder

    def make(self, bench: Workbench) -> None:
        """Make it, unless an earlier row has."""
        for command in self.commands:
            bench.once(command)


def odometry(name: str, gnss: str) -> Recording:
    """The first 300 images of KITTI odometry 00, with fixes made from its reference."""
    command = f"convert kitti-odometry DATA/{ODOMETRY} {name}.mcap {gnss} --seed {ODOMETRY_SEED}"
    return Recording(name, (command,), (ODOMETRY,))


def raw() -> Recording:
    """KITTI raw 2011-09-26 14:05 with its own receiver, which also made the reference."""
    return Recording("raw", (f"convert kitti-raw DATA/{RAW} raw.mcap --camera 0",), (RAW,))


ODOMETRY_RTK_5S = odometry("odo-rtk-5s", "--gnss-error rtk --gnss-interval-s 5")
ODOMETRY_RTK_GAP = odometry("odo-rtk-gap", "--gnss-error rtk --gnss-interval-s 1 --gnss-gap 10.5:10")
ODOMETRY_RTK = odometry("odo-rtk", "--gnss-error rtk")
ODOMETRY_ARM = odometry("odo-arm", "--gnss-error rtk --gnss-interval-s 1 --antenna-in-camera 0,-1.6,0")
ODOMETRY_CONSUMER = odometry("odo-consumer", "--gnss-error consumer")
KITTI_RAW = raw()


RTK_1HZ = "--gnss rtk --gnss-interval-s 1"


@dataclass(frozen=True)
class Circuit:
    """A lap through a simulated city, rendered once; its recordings differ in their receivers only."""

    length_m: float = 1500.0
    speed_mps: float = 9.0
    gap_s: float = 10.0
    tunnel_s: float = 30.0
    drive_seed: int = 1
    world: str = "--kind city --world 1"

    @property
    def clean(self) -> Recording:
        """With a fix of 5 cm a second: the one that is rendered, and that stress is held against."""
        return Recording("circuit-rtk-1hz", (self._command("circuit-rtk-1hz", RTK_1HZ),))

    def with_receiver(self, name: str, gnss: str) -> Recording:
        """The same drive, with other options of GNSS."""
        taken = self._command(name, f"{gnss} --images-from {self.clean.name}.mcap")
        return Recording(name, (*self.clean.commands, taken))

    def in_mid_drive(self, length_s: float) -> str:
        """A gap of this length for --gnss-gap; its middle is a little early, as bends are driven more slowly."""
        return f"{0.5 * (self.length_m / self.speed_mps - length_s):.1f}:{length_s:g}"

    def _command(self, name: str, options: str) -> str:
        drive = (
            f"{self.world} --drive {self.drive_seed} --length-m {self.length_m:g} --speed-mps {self.speed_mps:g}"
        )
        return f"simulate {name}.mcap {drive} {options}"
