"""``fleetmap demo``: the whole chain on one computer, without any data."""

from __future__ import annotations

from pathlib import Path

import click

from fleetmap_cli.demonstration import demonstrate

_PATH = click.Path(path_type=Path)


@click.command()
@click.option(
    "--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Another seed is another street."
)
@click.option(
    "--length-m",
    type=click.FloatRange(min=30.0, max=500.0),
    default=150.0,
    show_default=True,
    help="Length of the street; the time needed grows with it.",
)
@click.option(
    "--output",
    type=_PATH,
    default=Path("fleetmap_demo.png"),
    show_default=True,
    metavar="OUT.png",
    help="Draw the picture here; an older one is replaced.",
)
@click.option(
    "--keep",
    type=_PATH,
    metavar="DIR",
    help="Keep recordings, map and trajectories in this new or empty folder, to go on with.",
)
def demo(seed: int, length_m: float, output: Path, keep: Path | None) -> None:
    """See the whole chain at work: no data, no server and no second terminal needed. Takes a minute or two.

    \b
    1. Two vehicles drive a simulated street; the second in the other lane, on another
       day, with another camera and without GNSS.
    2. The first drive becomes a map anchored in UTM.
    3. A map server, in a process of its own, takes the map over Zenoh and lists it over HTTP.
    4. The second vehicle, in another process, downloads the map and reads its UTM pose
       from its camera alone.
    5. Both are held against the truth, which is known because the street is simulated.
       Beside the map stands what a spline through its few GNSS fixes would give.

    Each stage prints the command that it runs: the same commands work on your own recordings. The picture shows
    both trajectories, the GNSS fixes and the landmarks from above. Nothing but the picture stays.

    \b
    Examples:
      fleetmap demo
      fleetmap demo --seed 7 --keep my_demo
    """
    demonstrate(seed=seed, length_m=length_m, picture=output, keep=keep)
