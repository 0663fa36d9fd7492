"""The pages about survey drives and the jobs that map them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fastapi.responses import HTMLResponse

from fleetmap.jobs import DriveEntry, DriveSummary, JobEntry, JobState
from fleetmap_server.http.footprint_figure import Road, footprint_figure
from fleetmap_server.http.html import Child, Html, element
from fleetmap_server.http.page_layout import facts, length, next_page, page, short_hash, size, table, utc

_VERDICT_CLASS = {"yes": "good", "yes, with warnings": None, "no": "bad"}
_STATE_CLASS = {"done": "good", "failed": "bad"}


def drives_page(entries: Sequence[DriveEntry], after: str | None) -> HTMLResponse:
    """A page of the list of drives; ``after`` is the cursor of the next one."""
    rows: list[list[Child]] = [
        [
            element("a", entry.name, href=f"/drives/{entry.sha256}"),
            utc(entry.received_ns),
            utc(entry.start_ns),
            length(entry.summary.length_m if entry.summary else None),
            size(entry.size_bytes),
            _verdict(entry.summary),
        ]
        for entry in entries
    ]
    headings = ("Drive", "Received", "Driven", "#Length", "#Size", "Good enough to map?")
    return page(
        "Survey drives",
        element("h1", "Survey drives"),
        table(headings, rows) if rows else element("p", "No drives yet; 'fleetmap upload' sends one."),
        next_page("/drives", after),
        here="/drives",
    )


def drive_page(entry: DriveEntry, jobs: Sequence[JobEntry]) -> HTMLResponse:
    """All about one drive."""
    title, summary = f"Survey drive {entry.name}", entry.summary
    return page(
        title,
        element("h1", title),
        facts(
            [
                ("SHA-256", element("span", entry.sha256, class_="hash")),
                ("Recording", element("a", size(entry.size_bytes), href=f"/blobs/{entry.sha256}")),
                ("Received", utc(entry.received_ns)),
                ("Driven", [utc(entry.start_ns), " to ", utc(entry.end_ns)]),
                *_facts(summary),
            ]
        ),
        element("h2", "Way driven"),
        footprint_figure(Road(title, entry.trajectory_lonlat)) or element("p", "Unknown."),
        element("h2", "Findings"),
        _findings(entry),
        element("h2", "Mapping jobs"),
        _jobs(jobs) if jobs else element("p", "None."),
        here="/drives",
    )


def jobs_page(jobs: Sequence[JobEntry], counts: Mapping[JobState, int], after: str | None) -> HTMLResponse:
    """A page of the list of jobs, newest first; ``after`` is the cursor of the next one."""
    return page(
        "Mapping jobs",
        element("h1", "Mapping jobs"),
        element("p", ", ".join(f"{count} {state}" for state, count in counts.items())),
        _jobs(jobs) if jobs else element("p", "No jobs yet; a drive that is uploaded becomes one."),
        next_page("/jobs", after),
        here="/jobs",
    )


def _verdict(summary: DriveSummary | None) -> Html | str:
    if summary is None:
        return "not looked at yet"
    return element("span", summary.verdict, class_=_VERDICT_CLASS[summary.verdict])


def _facts(summary: DriveSummary | None) -> list[tuple[str, Child]]:
    if summary is None:
        return []
    rate = "" if summary.image_rate_hz is None else f", {summary.image_rate_hz:.1f} per second"
    rows: list[tuple[str, Child]] = [
        ("Length", length(summary.length_m)),
        ("Images", f"{summary.image_count}{rate}"),
    ]
    if summary.camera_width_px is not None and summary.camera_height_px is not None:
        rows.append(("Camera", f"{summary.camera_width_px} x {summary.camera_height_px} px"))
    return [*rows, ("Good enough to map?", summary.reasons or _verdict(summary))]


def _findings(entry: DriveEntry) -> list[Child]:
    if entry.summary is None:
        return [element("p", "Nobody has looked at the recording yet.")]
    by = "the worker that mapped it" if entry.state == "checked" else "who sent it; a worker will look again"
    rows: list[list[Child]] = [
        [finding.aspect, element("span", finding.severity, class_=_severity_class(finding.severity)), finding.text]
        for finding in entry.summary.findings
    ]
    return [element("p", f"Found by {by}."), table(("Aspect", "Is", "Figures"), rows)]


def _severity_class(severity: str) -> str | None:
    return severity if severity in ("good", "bad") else None


def _jobs(jobs: Sequence[JobEntry]) -> Html:
    rows: list[list[Child]] = [
        [
            element("span", job.job_id, class_="hash"),
            element("span", _map_of(job), class_="keep"),
            element("a", short_hash(job.drive), href=f"/drives/{job.drive}"),
            [element("span", _state(job), class_=_STATE_CLASS.get(job.state)), f" {job.reason}"],
            utc(job.updated_ns),
            job.attempts,
            job.worker,
        ]
        for job in jobs
    ]
    headings = ("Job", "Map", "Drive", "State", "Last heard of", "#Attempts", "Worker")
    return table(headings, rows)


def _map_of(job: JobEntry) -> Child:
    if job.version is None:
        return job.map_id
    return element("a", job.map_id, href=f"/maps/{job.map_id}?version={job.version}")


def _state(job: JobEntry) -> str:
    if job.state != "running":
        return job.state
    stopping = ", asked to stop" if job.cancel_requested else ""
    return f"running: {job.stage} {job.percent} %{stopping}" if job.stage else f"running{stopping}"
