"""``fleetmap map``: turn a survey drive into a map anchored in UTM; with --watch, as an agent."""

from __future__ import annotations

import functools
import logging
from pathlib import Path

import click

from fleetmap.manifest import CalibrationRecord, Manifest
from fleetmap.transport import DEFAULT_ENDPOINT
from fleetmap_cli.mapping import DriveChoice, map_and_publish, map_recording
from fleetmap_cli.options import XYZ, ServerAccess, optional_server_options
from fleetmap_cli.watching import stop_on_signals, watch_folder
from fleetmap_mapper.setting_assignments import with_assignments
from fleetmap_mapper.settings import (
    CalibrationGroup,
    CalibrationMode,
    CellGroup,
    GnssGroup,
    GnssMode,
    MapperSettings,
)

_PATH = click.Path(path_type=Path)
_FILE = click.Path(path_type=Path, dir_okay=False)
_UNFIT = 3
_CALIBRATION: dict[bool | None, CalibrationMode] = {None: "auto", True: "refined", False: "recorded"}


@click.command("map")
@click.argument("recording", type=_PATH, required=False)
@click.option("--output", type=_PATH, metavar="FOLDER", help="Write the map package here.")
@click.option("--trajectory", type=_FILE, metavar="OUT.tum", help="Write the pose of every image (TUM text, UTM).")
@click.option(
    "--gnss",
    type=click.Choice(["none", "mapping", "final", "full"]),
    default="full",
    show_default=True,
    help="How fixes shape the map: 'none' places plain SLAM with one Sim(3) at the end; 'mapping' also aligns "
    "while mapping; 'final' is 'none' with a joint adjustment at the end; 'full' does both.",
)
@click.option("--map-id", metavar="ID", help="The map's id in the catalogue.  [default: the output folder's name]")
@click.option("--image-topic", metavar="TOPIC", help="Which camera, where the recording holds several.")
@click.option("--gnss-topic", metavar="TOPIC", help="Which receiver, where the recording holds several.")
@click.option(
    "--antenna-offset",
    type=XYZ,
    help="Antenna from the camera centre in metres: forward, left, up; used where the recording does not say.",
)
@click.option(
    "--mask",
    type=_FILE,
    metavar="MASK.png",
    help="Use only what is white in this picture of the images' size; black hides the own bonnet, for example.",
)
@click.option(
    "--refine-calibration/--recorded-calibration",
    default=None,
    help="Estimate focal length, centre and lens distortion together with the map (what the drive does not "
    "determine, nearly all of it on a straight road, stays as recorded), or never.  [default: where the drive "
    "contradicts the recorded calibration clearly; it is told]",
)
@click.option(
    "--budget-mb-per-km",
    type=click.FloatRange(min=0.0),
    default=CellGroup().budget_mb_per_km,
    show_default=True,
    help="How much of the map localizers are to fetch: landmarks and keyframes are chosen that help them most.  "
    "0 gives them everything.",
)
@click.option(
    "--set",
    "assignments",
    multiple=True,
    metavar="GROUP.NAME=VALUE",
    help="Change one setting of the mapper, such as a limit of the quality check; may be given several times, and "
    "has the last word.  'fleetmap report' lists the quality settings of a map.",
)
@click.option(
    "--seed", type=click.IntRange(0, 2**31 - 1), default=0, show_default=True, help="Of all random draws."
)
@click.option("--force", is_flag=True, help="Replace an existing output.")
@click.option("-v", "--verbose", is_flag=True, help="Say on stderr how fast it went, and where the time went.")
@click.option("--watch", type=_PATH, metavar="DIR", help="Map and publish every drive dropped into this folder.")
@optional_server_options(f"With --watch: where to publish.  [default: {DEFAULT_ENDPOINT}]")
@click.option("--poll-s", type=click.FloatRange(min=0.1), default=5.0, show_default=True, help="With --watch.")
def map_(
    recording: Path | None,
    output: Path | None,
    trajectory: Path | None,
    gnss: GnssMode,
    map_id: str | None,
    image_topic: str | None,
    gnss_topic: str | None,
    antenna_offset: tuple[float, float, float] | None,
    mask: Path | None,
    refine_calibration: bool | None,
    budget_mb_per_km: float,
    assignments: tuple[str, ...],
    seed: int,
    force: bool,
    verbose: bool,
    watch: Path | None,
    server: ServerAccess,
    poll_s: float,
) -> int:
    """Turn the survey drive RECORDING (one camera, GNSS) into a visual map anchored in UTM.

    Ends with exit code 3 if the map was written but its own quality check says it should not be published.

    \b
    Examples:
      fleetmap map survey.mcap --output my_map --trajectory survey.tum
      fleetmap map survey.mcap --output my_map --budget-mb-per-km 0.5
      fleetmap map survey.mcap --output my_map --set quality.min_posed_ratio=0.9
      fleetmap map --watch drives --server tcp/127.0.0.1:7447
    """
    if verbose:
        logging.getLogger("fleetmap_mapper").setLevel(logging.INFO)
    settings = MapperSettings(
        seed=seed,
        gnss=GnssGroup(mode=gnss),
        calibration=CalibrationGroup(mode=_CALIBRATION[refine_calibration]),
    )
    settings = with_assignments(settings, (f"cells.budget_mb_per_km={budget_mb_per_km}", *assignments))
    if settings.calibration.mode == "refined" and settings.gnss.mode == "mapping":
        raise click.UsageError("--refine-calibration needs an adjustment at the end: --gnss none, final or full")
    choice = DriveChoice(image_topic, gnss_topic, antenna_offset, mask)
    if watch is not None:
        if recording or output or trajectory or map_id or force:
            raise click.UsageError(
                "--watch names its maps after the drives; it takes no recording, output or map id"
            )
        run = functools.partial(map_and_publish, server=server, settings=settings, choice=choice)
        with stop_on_signals() as stop:
            watch_folder(watch, run, poll_s=poll_s, stop=stop)
        return 0
    if recording is None or output is None:
        raise click.UsageError("give a RECORDING and --output FOLDER, or --watch DIR")
    if server.is_given:
        raise click.UsageError("--server goes with --watch; send a finished map with 'fleetmap publish'")
    manifest = map_recording(
        recording,
        output,
        settings=settings,
        choice=choice,
        map_id=map_id,
        trajectory=trajectory,
        force=force,
    )
    return _report(manifest, output)


def _refinement(calibration: CalibrationRecord) -> str:
    before, after = calibration.recorded, calibration.fitted
    sigma_px = calibration.centre_sigma_px
    lens = ", ".join(
        f"{old:.4f} -> {new:.4f} +- {sigma:.4f}"
        for old, new, sigma in zip(before.distortion, after.distortion, calibration.distortion_sigma, strict=True)
    )
    return (
        f"fx {before.fx_px:.1f} -> {after.fx_px:.1f} +- {calibration.focal_sigma_px:.1f} px, "
        f"fy {before.fy_px:.1f} -> {after.fy_px:.1f} +- {calibration.focal_sigma_px:.1f} px, "
        f"cx {before.cx_px:.1f} -> {after.cx_px:.1f} +- {sigma_px[0]:.1f} px, "
        f"cy {before.cy_px:.1f} -> {after.cy_px:.1f} +- {sigma_px[1]:.1f} px, "
        f"{after.distortion_model} {lens}"
    )


def _report(manifest: Manifest, output: Path) -> int:
    quality = manifest.quality
    residual = quality.gnss_residual_rms_m
    click.echo(f"map:           {output} (id {manifest.map_id}, EPSG:{manifest.anchor.epsg})")
    click.echo(f"images posed:  {quality.frames_posed} of {quality.frames_total}, {quality.length_m:.1f} m")
    click.echo(f"keyframes:     {quality.keyframes}, landmarks {quality.landmarks}")
    if manifest.localizable is not None:
        chosen = manifest.localizable
        click.echo(
            f"cells:         {chosen.size_bytes / 1e6:.2f} MB, {chosen.keyframes} keyframes and "
            f"{chosen.landmarks} landmarks for localizers"
        )
    click.echo(f"reprojection:  {quality.reprojection_rms_px:.2f} px RMS")
    if residual is not None:
        click.echo(
            f"GNSS residual: {residual:.3f} m RMS over {quality.gnss_fixes} fixes (--gnss {quality.gnss_mode})"
        )
    if quality.gnss_fixes_rejected:
        click.echo(f"GNSS outliers: {quality.gnss_fixes_rejected} fixes are far off and left out")
    if quality.clock_offset_removed and quality.clock_offset_s is not None:
        click.echo(
            f"clock offset:  camera {quality.clock_offset_s:+.3f} s from the receiver "
            f"(+- {quality.clock_offset_sigma_s:.3f} s), removed"
        )
    if quality.position_sigma_m is not None:
        click.echo(f"uncertainty:   {quality.position_sigma_m:.3f} m (horizontal, 1 sigma, median)")
    if quality.weak_stretches:
        click.echo(
            f"weak:          {quality.weak_length_m:.0f} m in {len(quality.weak_stretches)} stretches; "
            f"'fleetmap report {output}' shows them"
        )
    if quality.calibration is not None and quality.calibration.refined:
        click.echo(f"calibration:   refined, {_refinement(quality.calibration)}")
    for warning in (*quality.warnings, *quality.remarks):
        click.echo(f"warning: {warning}", err=True)
    if not quality.publishable:
        click.echo("warning: this map should not be published", err=True)
    return 0 if quality.publishable else _UNFIT
