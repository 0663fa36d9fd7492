"""``fleetmap jobs``: the drives that wait to be mapped, and how far the workers are."""

from __future__ import annotations

import json
import re
from typing import get_args

import click

from fleetmap.errors import InputError
from fleetmap.jobs import JobEntry, JobState
from fleetmap_cli.options import ServerAccess, server_options
from fleetmap_cli.tables import table, utc_text


@click.group()
def jobs() -> None:
    """See how far the mapping of uploaded drives is, and cancel or repeat it."""


@jobs.command("list")
@server_options
@click.option("--state", type=click.Choice(get_args(JobState)), help="Only jobs in this state.")
@click.option("--json", "as_json", is_flag=True, help="All that the server knows, as a JSON list.")
def list_(server: ServerAccess, state: JobState | None, as_json: bool) -> None:
    """List the mapping jobs, newest first.

    \b
    Example:
      fleetmap jobs list --server tcp/127.0.0.1:7447 --state running
    """
    with server.connect() as client:
        found = client.jobs(state=state)
    if as_json:
        click.echo(json.dumps([job.model_dump(mode="json") for job in found], indent=1))
    else:
        click.echo(table(_HEADINGS, [_row(job) for job in found], "no jobs"))


@jobs.command()
@click.argument("job_id", metavar="JOB")
@server_options
def cancel(job_id: str, server: ServerAccess) -> None:
    """Cancel a job: at once if it waits; a worker that is at it stops within seconds.

    \b
    Example:
      fleetmap jobs cancel 3f1c9a0be2d44c17
    """
    with server.connect() as client:
        job = client.cancel_job(_checked(job_id))
    click.echo(f"job {job.job_id}: {'being cancelled' if job.state == 'running' else job.state}")


@jobs.command()
@click.argument("job_id", metavar="JOB")
@server_options
def retry(job_id: str, server: ServerAccess) -> None:
    """Queue a job once more that failed or was cancelled.

    \b
    Example:
      fleetmap jobs retry 3f1c9a0be2d44c17
    """
    with server.connect() as client:
        job = client.retry_job(_checked(job_id))
    click.echo(f"job {job.job_id}: {job.state}")


def _checked(job_id: str) -> str:
    if not re.fullmatch("[0-9a-f]{8,64}", job_id):
        raise InputError(f"'{job_id}' is no job; 'fleetmap jobs list' shows what they are called")
    return job_id


_HEADINGS = ("job", "state", "map", "drive", "attempts", "worker", "changed (UTC)", "")


def _row(job: JobEntry) -> tuple[str, ...]:
    state: str = job.state
    if job.cancel_requested and not job.is_over:
        state = "being cancelled"
    elif job.state == "running" and job.stage:
        state = f"running: {job.stage} {job.percent} %"
    outcome = f"version {job.version[:12]}" if job.version is not None else job.reason
    return (
        job.job_id,
        state,
        job.map_id,
        job.drive[:12],
        str(job.attempts),
        job.worker,
        utc_text(job.updated_ns),
        outcome,
    )
